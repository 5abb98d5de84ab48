"""Files cut short and with flipped bits: what was there before, or one clear error, never another number."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kinds import words

from srlrace.config import to_dict
from srlrace.files import FileError
from srlrace.learn.checkpoint import load_checkpoint
from srlrace.learn.policy import load_policy, state_arrays
from srlrace.recording import CorruptRecording, read_episodes, read_metadata, read_states
from srlrace.report.collect import read_evaluation
from srlrace.runs import RunError, RunFolder

ERRORS = (FileError, RunError, CorruptRecording)


@pytest.fixture(scope="module")
def run(zygote, tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("damaged")
    runs = ("--runs", place / "runs")
    options = {"out": place / "out", "set": {"srlrace.learn.train:SAVE_EVERY": 0.0}}
    assert zygote.run(["train", *words("short"), *runs], ["eval", "--episodes", "3", *runs], **options).status == 0
    [folder] = (place / "runs").iterdir()
    return folder


def policy(folder: Path) -> Any:
    weights = state_arrays(load_policy(RunFolder(folder).load_config(), folder / "policy.safetensors"))
    return {name: array.tobytes() for name, array in weights.items()}


def checkpoint(folder: Path) -> Any:
    """Every generation's content, by its steps; those from before count as well."""
    kept = load_checkpoint(folder / "checkpoint")
    assert kept is not None
    return kept.steps, {name: array.tobytes() for name, array in kept.arrays.items()}, kept.facts


def settings(folder: Path) -> Any:
    return to_dict(RunFolder(folder).load_config())


def episodes(folder: Path) -> Any:
    run = RunFolder(folder)
    evaluation = read_evaluation(run, "train_map", run.load_config())
    return {name: np.asarray(value).tobytes() for name, value in vars(evaluation).items() if name != "newest"}


def recording(folder: Path) -> Any:
    path = folder / "eval/train_map/trajectories.mcap"
    return read_states(path).to_json(), read_episodes(path).to_json(), read_metadata(path)


READERS: dict[str, Callable[[Path], Any]] = {
    "config.json": settings,
    "policy.safetensors": policy,
    "checkpoint/000000000000384.safetensors": checkpoint,
    "checkpoint/000000000000384.json": checkpoint,
    "eval/train_map/episodes.csv": episodes,
    "eval/train_map/trajectories.mcap": recording,
}


@pytest.mark.parametrize("name", READERS)
def test_damage_is_an_error_or_harmless(run, tmp_path, chance, much, say, name):
    folder = tmp_path / run.name
    shutil.copytree(run, folder)
    path, read = folder / name, READERS[name]
    data = path.read_bytes()
    allowed = [read(folder)]
    if read is checkpoint:
        path.unlink()
        allowed.append(read(folder))  # the generation before it
        assert allowed[1][0] == 256
    said = []
    damaged = [data[: len(data) * percent // 100] for percent in range(0, 100, much(10, 1))]
    damaged += [flipped(data, chance.randrange(8 * len(data))) for _ in range(much(60, 1000))]
    for content in damaged:
        path.write_bytes(content)
        try:
            found = read(folder)
        except ERRORS as error:
            said.append(str(error))
        else:
            assert found in allowed
    assert not any("\n" in error for error in said)
    assert len(said) >= 0.9 * len(damaged) or read is checkpoint
    say(f"{name}: {len(damaged)} damaged copies, {len(said)} refused, the others harmless or the generation before")


def flipped(data: bytes, bit: int) -> bytes:
    copy = bytearray(data)
    copy[bit // 8] ^= 1 << bit % 8
    return bytes(copy)


@pytest.mark.parametrize(("name", "look"), [
    ("eval/train_map/summary.json", lambda run: run.evaluations), ("run.json", lambda run: run.info),
])  # fmt: skip
def test_damaged_facts_count_as_none(run, tmp_path, chance, much, name, look):
    """So that lists show no wrong number, and a sweep evaluates anew."""
    folder = tmp_path / run.name
    shutil.copytree(run, folder)
    path = folder / name
    data, whole = path.read_bytes(), look(RunFolder(folder))
    damaged = [flipped(data, chance.randrange(8 * len(data))) for _ in range(much(50, 1000))]
    damaged += [data[: len(data) * percent // 100] for percent in range(0, 100, much(10, 1))]
    damaged.append(data.replace(b'"seal"', b'"seam"'))  # the checksum itself
    for content in damaged:
        path.write_bytes(content)
        assert look(RunFolder(folder)) in ({}, whole)
