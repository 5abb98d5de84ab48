"""How good a policy was in the course of its training: the policies kept along the way, evaluated like the last one."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import torch

from srlrace.evaluation.episodes import CRASHES, episode_rows, summarise
from srlrace.evaluation.flights import fly
from srlrace.evaluation.suites import make_suite
from srlrace.files import remove_leftovers, write_sealed
from srlrace.learn.policy import load_policy
from srlrace.locks import hold
from srlrace.runs import RunError, RunFolder

SNAPSHOT = re.compile(r"([1-9][0-9]{0,11})\.safetensors")  # named after the training's steps


def snapshots(run: RunFolder) -> dict[int, Path]:
    """Return the policies kept along a run's training by the steps after which they were kept, in order."""
    names = (path.name for path in run.file("snapshots").glob("*.safetensors"))
    found = sorted(int(match[1]) for match in map(SNAPSHOT.fullmatch, names) if match)
    return {steps: run.file("snapshots", f"{steps}.safetensors") for steps in found}


def evaluate_snapshots(run: RunFolder, episodes: int, suite: str = "train_map") -> list[dict[str, Any]]:
    """Fly every snapshot on the frozen initial conditions of a suite; write and return ``learning.json``'s rows.

    A row holds steps, finished and crashed episodes, and the mean time of the finished ones in s, or None. Raises
    `RunError` where there are none or another process is at it, and `srlrace.files.FileError` for a damaged one.
    """
    kept = snapshots(run)
    if not kept:
        raise RunError(f"{run.id}: no snapshots; training keeps them, published runs leave them out")
    config = run.load_config()
    torch.set_num_threads(config.algo.threads)
    prepared = make_suite(config, suite)
    rows = []
    folder = run.file("eval", suite)
    folder.mkdir(parents=True, exist_ok=True)
    with hold(run.file("eval", f".{suite}.lock"), f"the evaluation of {run.id} on {suite}"):
        remove_leftovers(folder)
        for steps, path in kept.items():
            race, _ = fly(load_policy(config, path), prepared, episodes, 0)
            summary = summarise(run.id, prepared, episode_rows(prepared, race))
            outcomes = summary["outcomes"]
            crashed = sum(outcomes[name] for name in CRASHES)
            flown = {"finished": outcomes["finished"], "crashed": crashed, "time_s": summary["time_mean_s"]}
            rows.append({"steps": steps, **flown})
        head = {"format": 1, "suite": suite, "episodes": episodes, "evaluation_seed": prepared.seed}
        write_sealed(folder / "learning.json", {**head, "snapshots": rows})
    return rows
