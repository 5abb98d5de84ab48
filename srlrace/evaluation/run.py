"""Evaluating a run: fly, write the tables, and record."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from srlrace.config import to_dict
from srlrace.evaluation.episodes import episode_rows, rows_csv, summarise
from srlrace.evaluation.flights import fly
from srlrace.evaluation.suites import EVALUATION_SEED, Suite, make_suite
from srlrace.files import atomic_write
from srlrace.learn.policy import load_policy
from srlrace.provenance import versions
from srlrace.recording import Flight, RecordingWriter
from srlrace.runs import RunError, RunFolder
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
    metadata = {"run": run.id, "suite": suite.name, "evaluation_seed": str(EVALUATION_SEED), **versions()}
    config_json = json.dumps(to_dict(suite.config), indent=1).encode()
    track = suite.config.env
    with RecordingWriter(
        path,
        metadata=metadata,
        reward_terms=TERMS,
        horizon=track.horizon,
        config_json=config_json,
        passing_radius=track.passing_radius,
    ) as writer:
        for flight in flights:
            writer.write(flight)
        writer.finish(episodes_csv)


def evaluate_run(run: RunFolder, episodes: int, suite: str = "train_map", record: str = "all") -> dict[str, Any]:
    """Evaluate a run's policy and write ``eval/<suite>/``; return the summary.

    Raises `RunError` for a bad request and `srlrace.files.FileError` for a policy that cannot be used.
    """
    if episodes < 1:
        raise RunError(f"episodes: got {episodes}, takes a whole number of at least 1")
    recorded = recorded_count(record, episodes)
    config = run.load_config()
    torch.set_num_threads(config.algo.threads)
    policy = load_policy(config, run.path / "policy.safetensors")
    prepared = make_suite(config, suite)
    race, history = fly(policy, prepared, episodes, recorded)
    rows = episode_rows(prepared, race)
    folder = run.file("eval", suite)
    folder.mkdir(parents=True, exist_ok=True)
    table = rows_csv(rows)
    recording = folder / "trajectories.mcap"
    if history:
        write_recording(recording, run, prepared, history.flights(prepared, race, rows), table)
    else:
        recording.unlink(missing_ok=True)  # it would show another evaluation's flights
    summary = summarise(run.id, prepared, rows)
    atomic_write(folder / "episodes.csv", table)
    atomic_write(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    return summary
