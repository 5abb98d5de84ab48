"""Presets composed from conf/, and evaluations and run folders with made-up numbers in the documented formats."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from srlrace import hydra_bridge
from srlrace.config import Config, run_id, to_dict
from srlrace.report.collect import Evaluation, Run
from srlrace.runs import State

HEADER = (
    "episode,seed,map,outcome,time_s,lap_time_s,last_gate_time_s,gates_passed,min_clearance_m,mean_speed_mps,"
    "peak_speed_mps,path_length_m,peak_body_rate_radps"
)


@pytest.fixture(scope="session")
def lab() -> SimpleNamespace:
    """What tests of the report need: the presets, and makers of evaluations, runs and run folders."""
    return SimpleNamespace(
        compose=lru_cache(hydra_bridge.compose),
        evaluation=evaluation,
        run=run,
        with_seed=with_seed,
        write_run=write_run,
    )


def evaluation(times: list[float | None], suite: str = "train_map", maps: list[int] | None = None) -> Evaluation:
    """An evaluation whose flights took these times; None is a crash."""
    count = len(times)
    finished = np.array([time is not None for time in times])
    return Evaluation(
        suite=suite,
        seed=7,
        horizon_s=20.0,
        newest=0.0,
        episode=np.arange(count),
        map_seed=np.array(maps or [0] * count),
        finished=finished,
        crashed=~finished,
        time_s=np.array([np.nan if time is None else time for time in times]),
        total_time_s=np.array([np.nan if time is None else time for time in times]),
        outcome=np.where(finished, "finished", "crashed"),
        gates_passed=np.where(finished, 9, 4),
        min_clearance_m=np.full(count, 0.5),
    )


def run(config: Config, *evaluations: Evaluation, state: State = State.FINISHED) -> Run:
    """A run as `collect` returns it."""
    return Run(run_id(config), Path("nowhere"), config, state, {each.suite: each for each in evaluations})


def with_seed(config: Config, seed: int, **algo: object) -> Config:
    """The configuration with another seed, and algorithm settings if any are given."""
    return replace(config, seed=seed, algo=replace(config.algo, **algo))  # type: ignore[arg-type]


def write_run(root: Path, config: Config, flights: dict[str, list[float | None]]) -> Path:
    """Write a run folder in the documented format: ``flights`` are times per suite, None a crash."""
    folder = root / run_id(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    (folder / "run.json").write_text(json.dumps({"format": 1, "state": "finished"}))
    (folder / "policy.safetensors").write_bytes(b"")
    for suite, times in flights.items():
        target = folder / "eval" / suite
        target.mkdir(parents=True)
        maps = 1 if suite == "train_map" else 10
        rows = [_line(i, 1_000_000 + i % maps, time, bool(config.env.laps)) for i, time in enumerate(times)]
        (target / "episodes.csv").write_text("\n".join([HEADER, *rows]) + "\n")
        (target / "summary.json").write_text(json.dumps({"format": 1, "suite": suite, "evaluation_seed": 7}))
    return folder


def _line(episode: int, map_seed: int, time: float | None, laps: bool) -> str:
    outcome = "crashed" if time is None else "finished"
    times = ("", "") if time is None else (str(time + 1.0 if laps else time), str(time) if laps else "")
    return ",".join([str(episode), "7", str(map_seed), outcome, *times, "", "9", "0.5", "9.0", "14.0", "60.0", "6.0"])
