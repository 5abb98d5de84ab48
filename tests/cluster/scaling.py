"""What a sweep costs besides the runs: 16 tiny runs with 1 and 2 workers, and folders of ten thousand runs.

Run by ``make cluster-scaling``; wall-clock and CPU time are both said, since machines are seldom idle.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from srlrace.config import run_id, to_dict
from srlrace.hydra_bridge import compose

REFERENCE = Path(__file__).parents[2] / "runs" / "reference"
RUNS = 16
STEPS = "50000"  # two rollouts: the start of a process is nearly all of it
MANY = 10_000


def srlrace(*words: str) -> tuple[float, float]:
    """Run a command; returns its wall-clock and CPU time, s."""
    before, began = os.times(), time.monotonic()
    subprocess.run([sys.executable, "-m", "srlrace", *words], check=True, capture_output=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.monotonic() - began, cpu


def sweep(folder: Path, jobs: int) -> tuple[float, float]:
    """Sixteen runs by so many workers."""
    words = ("--seeds", str(RUNS), "--steps", STEPS, "--record", "none", "--jobs", str(jobs))
    return srlrace("sweep", "smoke", *words, "--runs", str(folder))


def synthesize(folder: Path, count: int) -> None:
    """Folders as sweeps leave them: the files of a published run, under the ids of other seeds."""
    source = next(REFERENCE.glob("forest-srl-s0-*"))
    config = compose(["env=forest", "randomization=init"])
    for seed in range(count):
        settings = replace(config, seed=seed)
        run = folder / run_id(settings)
        shutil.copytree(source, run)
        (run / "config.json").write_text(json.dumps(to_dict(settings)))
        (run / "run.json").write_text(json.dumps({"steps": config.algo.total_steps, "train_wall_s": 300.0}))


def main() -> None:
    """Measure, and print the table."""
    table = Table("what", "wall-clock, s", "CPU, s")
    with tempfile.TemporaryDirectory() as place:
        many = Path(place) / "many"
        synthesize(many, MANY)
        measured: dict[str, Callable[[], tuple[float, float]]] = {
            f"list {MANY} runs": lambda: srlrace("runs", "--runs", str(many)),
            f"report {MANY} runs": lambda: srlrace("report", "--runs", str(many)),
            "plan what is missing": lambda: srlrace("sweep", "paper", "--dry-run", "--runs", str(many)),
            "one train, for comparison": lambda: srlrace(
                "train", "level=none", f"algo.total_steps={STEPS}", "--runs", f"{place}/one"
            ),
            f"{RUNS} runs, 1 worker": lambda: sweep(Path(place) / "1", 1),
            f"{RUNS} runs, 2 workers": lambda: sweep(Path(place) / "2", 2),
        }
        for what, measure in measured.items():
            table.add_row(what, *(f"{figure:.1f}" for figure in measure()))
    Console().print(table)


if __name__ == "__main__":
    main()
