"""Time-optimal references to compare flight times with; looked up, never solved, so that no solver is needed."""

from __future__ import annotations

from functools import lru_cache

from srlrace.bound.problem import problem_of
from srlrace.bound.store import mean_unseen_time, reference_time
from srlrace.schema import Config


@lru_cache(maxsize=256)
def cell_reference(config: Config, suite: str) -> float | None:
    """Return T_ref of a configuration on a suite, s: the flying lap on lap tracks, else the time from rest.

    For a suite of unseen maps it is the mean over a sample of them. Where that is not solved with obstacles, it is that
    of the track without them; None where that is not solved either.
    """
    solved = _solved(config, suite)
    return reference_time(problem_of(config, obstacles=False)) if solved is None else solved


def reference_notes(config: Config, suite: str) -> tuple[str, ...]:
    """Return a remark on a T_ref that leaves the obstacles out."""
    if _solved(config, suite) is not None or cell_reference(config, suite) is None:
        return ()
    return ("T_ref and the gap to it are of the track without obstacles",)


@lru_cache(maxsize=256)
def _solved(config: Config, suite: str) -> float | None:
    if suite != "train_map":
        return mean_unseen_time(problem_of(config, obstacles=False), suite)
    return reference_time(problem_of(config)) if config.level.maps == 1 else None
