"""Recordings in readers that share no code with the writer: the TypeScript library, and Rerun's in Rust."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from srlrace.recording import Flight
from srlrace.recording.schema import STATE_COLUMNS

READERS = Path(__file__).parents[2] / "readers"
RERUN = Path(sys.executable).with_name("rerun")
LIMIT = 60  # s


Run = Callable[..., subprocess.CompletedProcess[str]]


def run(*command: str | Path, home: str | None = None) -> subprocess.CompletedProcess[str]:
    words, env = list(map(str, command)), {**os.environ, **({"HOME": home, "XDG_CONFIG_HOME": home} if home else {})}
    return subprocess.run(words, capture_output=True, text=True, timeout=LIMIT, check=False, env=env)


@pytest.fixture(scope="module")
def typescript(recording: Path) -> dict[str, Any]:
    """All of the recording as the TypeScript library sees it."""
    node = shutil.which("node")
    if node is None or not (READERS / "node_modules").is_dir():
        pytest.skip("needs node, and `npm ci --prefix tests/readers`")
    done = run(node, READERS / "read_recording.mjs", recording)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def test_typescript_reads_the_same_states(typescript: dict[str, Any], flights: Sequence[Flight]) -> None:
    states = typescript["messages"]["/state"]
    for array, fields in STATE_COLUMNS.items():
        found = [[state[field] for field in fields] for state in states]
        expected = np.concatenate([getattr(flight, array).reshape(len(flight.time), -1) for flight in flights])
        np.testing.assert_array_equal(found, expected)
    rewards = [[state["reward_progress"], state["reward_safety"], state["reward_collision"]] for state in states]
    np.testing.assert_array_equal(rewards, np.concatenate([flight.reward_terms for flight in flights]))


def test_typescript_reads_the_rest(typescript: dict[str, Any], flights: Sequence[Flight]) -> None:
    positions = np.concatenate([flight.position_w for flight in flights])
    found = [[pose["pose"]["position"][axis] for axis in "xyz"] for pose in typescript["messages"]["/drone/pose"]]
    np.testing.assert_array_equal(found, positions)
    stamps = [pose["timestamp"] for pose in typescript["messages"]["/drone/pose"]]
    logged = [int(pose["log_time"]) for pose in typescript["messages"]["/drone/pose"]]
    assert [int(stamp["seconds"]) * 10**9 + stamp["nanos"] for stamp in stamps] == logged
    episodes = [(int(e["episode"]), e["outcome"], int(e["map"])) for e in typescript["messages"]["/episode"]]
    assert episodes == [(flight.episode, flight.outcome, flight.map_seed) for flight in flights]
    assert [len(scene["entities"]) for scene in typescript["messages"]["/scene"]] == [3, 3, 3]
    assert typescript["library"] == "srlrace"
    assert typescript["metadata"] == {"srlrace": {"run": "forest-srl-s1", "seed": "1"}}
    assert typescript["attachments"]["config.json"] == '{"seed": 1}\n'
    assert typescript["attachments"]["episodes.csv"].startswith("episode,")


def test_typescript_finds_every_message_through_the_index(typescript: dict[str, Any]) -> None:
    assert typescript["indexed"] == typescript["messages"]
    assert typescript["counts"] == {topic: len(messages) for topic, messages in typescript["messages"].items()}


@pytest.fixture(scope="module")
def rerun(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Rerun's command line, in a home of its own where it has introduced itself and collects nothing."""
    if not RERUN.exists():
        pytest.skip("needs the rerun-sdk package in the same environment")
    home = str(tmp_path_factory.mktemp("home"))
    run(RERUN, "analytics", "disable", home=home)
    return partial(run, RERUN, home=home)


def test_rerun_finds_nothing_to_complain_about(rerun: Run, recording: Path) -> None:
    done = rerun("mcap", "check", "--full", recording)
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split() for line in done.stdout.splitlines() if "/" in line and line.count("—") == 1]
    topics = ("/episode", "/scene", "/state", "/drone/pose")
    assert {row[3]: (row[0], row[2]) for row in rows} == dict.fromkeys(topics, ("ok", "3")), done.stdout


def test_rerun_would_complain(rerun: Run, recording: Path, tmp_path: Path) -> None:
    """It exits with 0 all the same, so what it prints is what counts."""
    broken = tmp_path / "broken.mcap"
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken.write_bytes(data)
    assert "CRC" in rerun("mcap", "check", "--full", broken).stderr
