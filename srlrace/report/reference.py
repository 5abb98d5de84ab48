"""Time-optimal references to compare flight times with; looked up, never solved, so that no solver is needed."""

from __future__ import annotations

from functools import lru_cache

from srlrace.bound.problem import problem_of
from srlrace.bound.store import mean_unseen_time, reference_time
from srlrace.schema import Config
from srlrace.suites import maps_of


@lru_cache(maxsize=256)
def cell_reference(config: Config, suite: str) -> float | None:
    """Return T_ref of a configuration on a suite, s: the flying lap on lap tracks, else the time from rest.

    For a suite of unseen maps it is the mean over a sample of them, whatever the disturbance. Where that is not solved
    with obstacles, it is that of the track without them; None where that is not solved either.
    """
    solved = _solved(config, suite)
    return reference_time(problem_of(config, obstacles=False)) if solved is None else solved


def reference_notes(config: Config, suite: str) -> tuple[str, ...]:
    """Return remarks on a T_ref that leaves the obstacles or a disturbance out."""
    if cell_reference(config, suite) is None:
        return ()
    bare, disturbed = _solved(config, suite) is None, maps_of(suite) != suite
    return (
        *(["T_ref and the gap to it are of the track without obstacles"] if bare else []),
        *(["T_ref and the gap to it are of the undisturbed quadrotor"] if disturbed else []),
    )


@lru_cache(maxsize=256)
def _solved(config: Config, suite: str) -> float | None:
    maps = maps_of(suite)
    if maps != "train_map":
        return mean_unseen_time(problem_of(config, obstacles=False), maps)
    return reference_time(problem_of(config)) if config.level.maps == 1 else None
