"""The solver and the simulator agree: references flown open loop by the race's own vehicle, judged by its own rules."""

import dataclasses

import numpy as np
import pytest

from srlrace.bound.problem import problem_of
from srlrace.bound.replay import replay
from srlrace.bound.store import load
from srlrace.hydra_bridge import compose


@pytest.mark.parametrize(
    "words",
    [
        ["env=forest", "level=none"],
        ["env=forest", "level=1"],
        ["env=forest", "level=2"],
        ["env=forest", "level=3"],
        ["env=split_s", "level=none"],
        ["env=split_s"],
    ],
)
def test_the_simulator_flies_the_reference(words):
    config = compose(words)
    problem = problem_of(config)
    reference = load(problem)
    flown = replay(problem, reference.trajectory)
    assert np.isfinite(flown.passing_times).all()
    assert (np.diff(flown.passing_times) > 0).all()
    assert flown.passing_times[-1] == pytest.approx(reference.time, abs=0.01)
    assert flown.clearance >= config.level.safety_margin
    assert flown.drift < 0.02


def test_another_vehicle_does_not():
    """The replay can fail: with 2 % less thrust than was planned with, waypoints are missed."""
    problem = problem_of(compose(["env=forest", "level=none"]))
    reference = load(problem)
    heavier = dataclasses.replace(problem, quad=dataclasses.replace(problem.quad, mass=problem.quad.mass * 1.02))
    assert np.isnan(replay(heavier, reference.trajectory).passing_times).any()
