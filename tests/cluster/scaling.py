"""What a sweep costs besides the runs: 16 tiny runs by 1 and by 2 workers, and folders of ten thousand runs.

Run by ``make cluster-scaling``; wall-clock and CPU time are both said, and the load, since machines are seldom idle.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table
from synthetic import synthesize

from srlrace.runs import list_runs

RUNS = 16
BY_HAND = 4  # of them, to compare with
STEPS = "50000"  # two rollouts: the start of a process is nearly all of it
MANY = 10_000

Measured = tuple[float, float]


def measured(*commands: tuple[str, ...]) -> Measured:
    """Run commands one after another; returns their wall-clock and CPU time, s."""
    before, began = os.times(), time.monotonic()
    for words in commands:
        subprocess.run([sys.executable, "-m", "srlrace", *words], check=True, capture_output=True)
    after = os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    return time.monotonic() - began, cpu


def by_hand(root: Path) -> Measured:
    """Some of the runs without a sweep: what each takes by itself."""
    words = ("env=forest", "level=none", f"algo.total_steps={STEPS}", "--runs", str(root))
    wall, cpu = measured(*(("train", f"seed={seed}", *words) for seed in range(BY_HAND)))
    options = ("--episodes", "50", "--record", "none", "--runs", str(root))
    evaluations = measured(*(("eval", run.id, *options) for run in list_runs(root)))
    return wall + evaluations[0], cpu + evaluations[1]


def sweep(root: Path, jobs: int) -> Measured:
    """All of them, by so many workers."""
    words = ("--seeds", str(RUNS), "--steps", STEPS, "--record", "none", "--jobs", str(jobs), "--runs", str(root))
    return measured(("sweep", "smoke", *words))


def folders(place: Path) -> dict[str, Measured]:
    """What is done with ten thousand runs."""
    root = place / "many"
    synthesize(root, MANY)
    tasks = {
        f"list {MANY} runs": ("runs",),
        f"report {MANY} runs": ("report",),
        "plan the paper's study": ("sweep", "paper", "--dry-run"),
    }
    return {what: measured((*words, "--runs", str(root))) for what, words in tasks.items()}


def workers(place: Path) -> dict[str, Measured]:
    """What a sweep costs, and what a second worker gains; by hand first and last, since the load changes."""
    hand = [by_hand(place / "first")]
    times = {f"{RUNS} runs, {jobs} worker(s)": sweep(place / str(jobs), jobs) for jobs in (1, 2)}
    hand.append(by_hand(place / "last"))
    return {f"{BY_HAND} runs by hand": (sum(wall for wall, _ in hand) / 2, sum(cpu for _, cpu in hand) / 2)} | times


def main() -> None:
    """Measure what was asked for, ``folders`` or ``workers`` or both, and print a table."""
    parts = [part for part in (folders, workers) if part.__name__ in (sys.argv[1:] or ("folders", "workers"))]
    table, console = Table("what", "wall-clock, s", "CPU, s"), Console()
    with tempfile.TemporaryDirectory() as place:
        for part in parts:
            for what, figures in part(Path(place)).items():
                table.add_row(what, *(f"{figure:.1f}" for figure in figures))
    console.print(table)
    console.print(f"{os.cpu_count()} cores, load {', '.join(f'{load:.1f}' for load in os.getloadavg())}")


if __name__ == "__main__":
    main()
