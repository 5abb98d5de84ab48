"""Time-optimal references to compare flight times with; looked up, never solved, so that no solver is needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from srlrace.bound.problem import Problem, problem_of
from srlrace.bound.store import reference_time, unseen_times
from srlrace.report.collect import Evaluation
from srlrace.report.presets import row_config
from srlrace.schema import Config
from srlrace.suites import OWN_MAPS, maps_of

OPEN = "T_ref and the gap to it are of the track without obstacles"
UNDISTURBED = "T_ref and the gap to it are of the undisturbed quadrotor"


@dataclass(frozen=True)
class Comparison:
    """Flights held against the time-optimal reference."""

    t_ref_s: float | None  # of the maps that were flown, s; None: not solved
    flown_s: float | None  # mean time of the flights compared with it, s; None: of all that finished
    notes: tuple[str, ...] = ()  # what is to be said about it


def compare(config: Config, suite: str, evaluations: Sequence[Evaluation]) -> Comparison:
    """Look up T_ref of a configuration on a suite: the flying lap on lap tracks, else the time from rest.

    On unseen maps each finished flight is held against T_ref of its own map, seed by seed as the mean time is taken;
    flights on maps that are not solved are left out on both sides. Where nothing is solved with obstacles, T_ref is
    that of the track without them; None where that is not solved either.
    """
    maps = maps_of(suite)
    found = _compare(config, maps, evaluations)
    disturbed = maps != suite and found.t_ref_s is not None
    return replace(found, notes=(*found.notes, UNDISTURBED)) if disturbed else found


def _compare(config: Config, maps: str, evaluations: Sequence[Evaluation]) -> Comparison:
    if maps.startswith("level"):
        times = _unseen(config, maps)
        if any(time is not None for time in times.values()):
            return _on_unseen(times, evaluations)
    elif maps in OWN_MAPS and config.level.maps == 1 and (solved := _of_track(config, True)) is not None:
        return Comparison(solved, None)
    free = _of_track(config, False)
    return Comparison(free, None, (OPEN,) if free is not None else ())


def _on_unseen(times: dict[int, float | None], evaluations: Sequence[Evaluation]) -> Comparison:
    """Hold flights against T_ref, s, of their maps by map seed."""
    solved = {seed: time for seed, time in times.items() if time is not None}
    references, flown, maps = [], [], set[int]()
    for evaluation in evaluations:
        maps |= set(evaluation.map_seed.tolist())
        compared = evaluation.finished & np.isin(evaluation.map_seed, list(solved))
        if compared.any():
            references.append(np.mean([solved[seed] for seed in evaluation.map_seed[compared].tolist()]))
            flown.append(evaluation.time_s[compared].mean())
    if not references:
        return Comparison(float(np.mean(list(solved.values()))), None, (f"T_ref is the mean over {len(solved)} maps",))
    note = "T_ref is the mean over finished flights, each held against that of its map"
    if missing := len(maps - solved.keys()):
        note += f"; {missing} of the {len(maps)} maps are not solved, and their flights left out of the gap"
    return Comparison(float(np.mean(references)), float(np.mean(flown)), (note,))


@lru_cache(maxsize=256)
def _unseen(config: Config, maps: str) -> dict[int, float | None]:
    level = row_config((f"level={maps.removeprefix('level')}",)).level
    return unseen_times(problem_of(config, obstacles=False), level)


def _of_track(config: Config, obstacles: bool) -> float | None:
    return _solved(problem_of(config, obstacles=obstacles))


@lru_cache(maxsize=256)
def _solved(problem: Problem) -> float | None:
    """T_ref: configurations that differ in reward or learner pose one problem."""
    return reference_time(problem)
