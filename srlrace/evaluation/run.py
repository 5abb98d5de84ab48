"""Evaluating a run: fly, write the tables, and record."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from srlrace.config import to_dict
from srlrace.evaluation.episodes import episode_rows, rows_csv, summarise
from srlrace.evaluation.flights import fly
from srlrace.evaluation.suites import Suite, make_suite
from srlrace.files import atomic_write, naming, remove_leftovers, write_sealed
from srlrace.learn.policy import load_policy
from srlrace.locks import hold
from srlrace.provenance import versions
from srlrace.recording import Flight, RecordingWriter
from srlrace.runs import TABLE_DIGEST, RunError, RunFolder
from srlrace.task.reward import TERMS


def recorded_count(record: str, episodes: int) -> int:
    """Return how many episodes ``--record`` asks for: all, none, or a number."""
    if record in ("all", "none"):
        return episodes if record == "all" else 0
    if record.isdecimal():
        return min(int(record), episodes)
    raise RunError(f"record: got {record!r}, takes all, none or a number of episodes")


def write_recording(path: Path, run: RunFolder, suite: Suite, flights: Iterator[Flight], episodes_csv: bytes) -> None:
    """Write the flights of an evaluation as one MCAP."""
    metadata = {"run": run.id, "suite": suite.name, "evaluation_seed": str(suite.seed), **versions()}
    config_json = json.dumps(to_dict(suite.config), indent=1).encode()
    track = suite.config.env
    with (
        naming(path),
        RecordingWriter(
            path,
            metadata=metadata,
            reward_terms=TERMS,
            horizon=track.horizon,
            config_json=config_json,
            passing_radius=track.passing_radius,
        ) as writer,
    ):
        for flight in flights:
            writer.write(flight)
        writer.finish(episodes_csv)


def evaluate_run(run: RunFolder, episodes: int, suite: str = "train_map", record: str = "all") -> dict[str, Any]:
    """Evaluate a run's policy and write ``eval/<suite>/``; return the summary.

    Raises `RunError` for a bad request or while another process is at it, and `srlrace.files.FileError` for a policy
    that cannot be used.
    """
    if episodes < 1:
        raise RunError(f"episodes: got {episodes}, takes a whole number of at least 1")
    recorded = recorded_count(record, episodes)
    config = run.load_config()
    torch.set_num_threads(config.algo.threads)
    policy = load_policy(config, run.path / "policy.safetensors")
    prepared = make_suite(config, suite)
    folder = run.file("eval", suite)
    folder.mkdir(parents=True, exist_ok=True)
    with hold(run.file("eval", f".{suite}.lock"), f"the evaluation of {run.id} on {suite}"):
        remove_leftovers(folder)
        race, history = fly(policy, prepared, episodes, recorded)
        rows = episode_rows(prepared, race)
        table = rows_csv(rows)
        recording = run.file("eval", suite, "trajectories.mcap")
        if history:
            write_recording(recording, run, prepared, history.flights(prepared, race, rows), table)
        else:
            recording.unlink(missing_ok=True)  # it would show another evaluation's flights
        atomic_write(folder / "episodes.csv", table)
        # Last, since the others count only with a summary that carries their checksum.
        seal = {TABLE_DIGEST: hashlib.sha256(table).hexdigest()}
        return write_sealed(folder / "summary.json", summarise(run.id, prepared, rows) | seal)
