"""Schedulers at work for a test: commands that find them, waiting, and what their runs must look like."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
STEPS = 1_500_000  # of a training that lasts long enough to be interrupted


@dataclass
class Engine:
    """A scheduler at work: what finds it, and commands that run with it."""

    variables: dict[str, str]
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """What commands find."""
        return {**os.environ, **self.variables, "PATH": PATH}

    def run(self, *words: str, check: bool = True, timeout: float = 900) -> str:
        """Run a command; returns its output, errors included."""
        done = subprocess.run(words, env=self.environment, capture_output=True, text=True,
                              timeout=timeout, check=False)  # fmt: skip
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    def srlrace(self, *words: str, check: bool = True) -> str:
        """Run ``srlrace``."""
        return self.run(sys.executable, "-m", "srlrace", *words, check=check)

    def start(self, *words: str) -> subprocess.Popen[bytes]:
        """Start a command and leave it running."""
        process = subprocess.Popen(words, env=self.environment, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.DEVNULL, start_new_session=True)  # fmt: skip
        self.processes.append(process)
        return process


def await_(condition: Callable[[], object], seconds: float = 600.0) -> None:
    """Wait until something is so; fail when it never is."""
    give_up = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < give_up, "it did not come about"
        time.sleep(0.2)


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def needs(programs: tuple[str, ...], modules: tuple[str, ...]) -> None:
    """Skip where something is missing, saying what."""
    if not os.environ.get("SRLRACE_CLUSTER"):
        pytest.skip("takes minutes and starts daemons; run by: make cluster")
    missing = [name for name in programs if not shutil.which(name, path=PATH)] + [
        name for name in modules if not find_spec(name)
    ]
    if missing:
        pytest.skip(f"{', '.join(missing)} not here")


def attempts(run: Path) -> int:
    """How often a training was started or continued."""
    return len(json.loads((run / "run.json").read_text())["attempts"])


def assert_same(runs: Path, reference: Path, count: int) -> None:
    """The same ids, the same policies and the same flights, to the byte; and no step trained twice."""
    names = sorted(path.parent.name for path in runs.glob("*/policy.safetensors"))
    assert names == sorted(path.parent.name for path in reference.glob("*/policy.safetensors"))[:count]
    for name in names:
        for file in ("config.json", "policy.safetensors", "eval/train_map/episodes.csv"):
            if not file.startswith("eval") or (runs / name / "eval").exists():
                assert (runs / name / file).read_bytes() == (reference / name / file).read_bytes(), f"{name}/{file}"
        steps = [line.partition(",")[0] for line in (runs / name / "progress.csv").read_text().splitlines()]
        assert steps == [
            line.partition(",")[0] for line in (reference / name / "progress.csv").read_text().splitlines()
        ]


def steps(run: Path) -> list[str]:
    """The first column of ``progress.csv``: each rollout once, whoever collected it."""
    lines = (run / "progress.csv").read_text().splitlines() if (run / "progress.csv").exists() else []
    return [line.partition(",")[0] for line in lines]


def at_work(runs: Path, seed: int) -> bool:
    """Whether a run's training has begun and not ended."""
    begun = any(len(steps(run)) > 1 for run in runs.glob(f"*-s{seed}-*"))
    return begun and not any(runs.glob(f"*-s{seed}-*/policy.safetensors"))


def console_lines(page: str, heading: str) -> list[str]:
    """The commands of the first console block below a heading of the docs."""
    text = (ROOT / "docs" / page).read_text().partition(f"## {heading}\n")[2]
    block = text.partition("```console\n")[2].partition("```")[0]
    return [shlex.join(shlex.split(line.removeprefix("$ "), comments=True)) for line in block.splitlines()]


def processes(*words: str) -> list[int]:
    """The processes whose command line has all of these words in it."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if all(word in line for word in words):
            found.append(int(path.parent.name))
    return found


def family(pid: int) -> list[int]:
    """A process and all that came from it."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        children.setdefault(parent, []).append(int(path.parent.name))
    members = [pid]
    for member in members:
        members += children.get(member, [])
    return members


def kill(pids: list[int]) -> None:
    """Kill processes that may be gone."""
    for pid in pids:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
