"""Time-optimal references to compare flight times with; looked up, never solved, so that no solver is needed."""

from __future__ import annotations

from functools import lru_cache

from srlrace.bound.problem import problem_of
from srlrace.bound.store import mean_unseen_time, reference_time
from srlrace.schema import Config


@lru_cache(maxsize=256)
def cell_reference(config: Config, suite: str) -> float | None:
    """Return T_ref of a configuration on a suite, s: the flying lap on lap tracks, else the time from rest.

    For a suite of unseen maps it is the mean over a sample of them. None where it has not been solved.
    """
    if suite != "train_map":
        return mean_unseen_time(problem_of(config, obstacles=False), suite)
    return reference_time(problem_of(config)) if config.level.maps == 1 else None
