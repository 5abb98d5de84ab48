"""The optimum against the thrust-to-weight ratio: a table in Markdown and a figure (``make thrust-figure``).

Solutions come from the store; those that are missing are solved, in about two seconds each.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from srlrace.bound.command import solve
from srlrace.bound.problem import Problem, problem_of
from srlrace.bound.store import load, save
from srlrace.bound.trajectory import Reference
from srlrace.config import Config
from srlrace.console import out
from srlrace.hydra_bridge import compose
from srlrace.sim.airframe import GRAVITY

# From the preset's ratio (4.61) upwards and downwards, each solution the first guess of the next.
WALKS = (5.5, 6.64), (4.0, 3.3, 2.5, 2.0, 1.5)
TRACKS = {"forest": "Forest, from rest", "split_s": "Split-S, flying lap"}
PAPER = {"forest": 7.31, "split_s": 6.49}  # s, the paper's Table II


def curve(track: str) -> list[tuple[float, float]]:
    """Return pairs of thrust-to-weight and T_ref, s, of a track without obstacles, by rising ratio."""
    config = compose([f"env={track}", "level=none"])
    preset = problem_of(config)
    first = load(preset) or _solved(config, preset, None)
    found = {preset.max_collective / GRAVITY: first.time}
    for walk in WALKS:
        near = first
        for ratio in walk:
            thrust = round(ratio * config.quad.mass * GRAVITY / 4, 6)
            problem = problem_of(replace(config, quad=replace(config.quad, thrust_max=thrust)))
            near = load(problem) or _solved(config, problem, near)
            found[ratio] = near.time
    return sorted(found.items())


def _solved(config: Config, problem: Problem, near: Reference | None) -> Reference:
    from srlrace.bound.solver import continue_from  # needs CasADi

    reference = continue_from(problem, near.trajectory) if near else solve(config, problem, restarts=1)
    save(problem, reference)
    return reference


def main(figure: Path) -> None:
    """Print the table and draw the figure."""
    curves = {track: curve(track) for track in TRACKS}
    out.print(f"| thrust-to-weight | {' | '.join(TRACKS.values())} |\n| --- | --- | --- |")
    for rows in zip(*curves.values(), strict=True):
        out.print(f"| {rows[0][0]:.2f} | {' | '.join(f'{time:.2f} s' for _, time in rows)} |")
    for track, pairs in curves.items():
        ratios, times = np.log(pairs).T  # close to a power law
        place = float(np.exp(np.interp(-np.log(PAPER[track]), -times, ratios)))
        out.print(f"the paper's {PAPER[track]} s ({track}) is optimal at {place:.2f}")
    draw(curves, figure)


def draw(curves: dict[str, list[tuple[float, float]]], figure: Path) -> None:
    """Draw time over thrust-to-weight, with the paper's times as dotted lines."""
    from matplotlib.figure import Figure

    page = Figure(figsize=(6.4, 3.6), layout="constrained")
    axes = page.add_subplot()
    for (track, pairs), color, marker in zip(curves.items(), ("#0072b2", "#d55e00"), "os", strict=True):
        ratios, times = np.array(pairs).T
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
