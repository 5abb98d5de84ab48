"""The optimum against the thrust-to-weight ratio: a table in Markdown and a figure (``make thrust-figure``).

Solutions come from the store; those that are missing are solved, in about five seconds each.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from srlrace.bound.command import solve
from srlrace.bound.problem import problem_of
from srlrace.bound.store import load, save
from srlrace.console import out
from srlrace.hydra_bridge import compose
from srlrace.sim.airframe import GRAVITY

RATIOS = (1.5, 2.0, 2.5, 3.3, 4.0, 5.5, 6.64)
TRACKS = {"forest": "Forest, from rest", "split_s": "Split-S, flying lap"}
PAPER = {"forest": 7.31, "split_s": 6.49}  # s, the paper's Table II
RESTARTS = 1


def optimum(track: str, ratio: float | None) -> tuple[float, float]:
    """Return thrust-to-weight and T_ref, s, of a track without obstacles; None: the preset's ratio."""
    config = compose([f"env={track}", "level=none"])
    if ratio is not None:
        thrust = round(ratio * config.quad.mass * GRAVITY / 4, 6)
        config = replace(config, quad=replace(config.quad, thrust_max=thrust))
    problem = problem_of(config)
    reference = load(problem)
    if reference is None:
        reference = solve(config, problem, RESTARTS)
        save(problem, reference)
    return problem.max_collective / GRAVITY, reference.time


def main(figure: Path) -> None:
    """Print the table and draw the figure."""
    curves = {track: sorted(optimum(track, ratio) for ratio in (None, *RATIOS)) for track in TRACKS}
    out.print(f"| thrust-to-weight | {' | '.join(TRACKS.values())} |\n| --- | --- | --- |")
    for rows in zip(*curves.values(), strict=True):
        out.print(f"| {rows[0][0]:.2f} | {' | '.join(f'{time:.2f} s' for _, time in rows)} |")
    for track, curve in curves.items():
        ratios, times = np.array(curve).T
        place = float(np.interp(-PAPER[track], -times, ratios))
        out.print(f"the paper's {PAPER[track]} s ({track}) is optimal at {place:.2f}")
    draw(curves, figure)


def draw(curves: dict[str, list[tuple[float, float]]], figure: Path) -> None:
    """Draw time over thrust-to-weight, with the paper's times as dotted lines."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = page.add_subplot()
    for (track, curve), color, marker in zip(curves.items(), ("#0072b2", "#d55e00"), "os", strict=True):
        ratios, times = np.array(curve).T
        axes.plot(ratios, times, color=color, marker=marker, label=TRACKS[track])
        axes.axhline(PAPER[track], color=color, linestyle=":", linewidth=1)
        axes.annotate(f"paper: {PAPER[track]} s", (6.6, PAPER[track]), color=color, ha="right", va="bottom")
    axes.set_xlabel("thrust-to-weight ratio")
    axes.set_ylabel("time-optimal reference (s)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    page.savefig(figure, dpi=160)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
