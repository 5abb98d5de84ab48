"""The kernel against an independent solution of the equations of motion (scipy's DOP853, float64).

What the reference shares with the kernel, and what not, stands in `tests/support/flightmodel.py`.
"""

from collections.abc import Callable

import numpy as np
import pytest
from flightmodel import PERIOD, SUBSTEPS, Reference
from numpy.typing import NDArray

from srlrace.config import QuadConfig
from srlrace.sim.airframe import Airframe
from srlrace.sim.dynamics import advance
from srlrace.sim.quadrotor import integrate

Array = NDArray[np.float64]
DRONES, PERIODS = 100, 100  # 2 s of flight


@pytest.fixture(scope="module")
def flight(
    quad: QuadConfig,
    random_states: Callable[[int, int], Array],
    random_commands: Callable[[int, int], Array],
) -> tuple[Array, list[Array], Array]:
    """Start states, a command for each control period, and the reference's end states."""
    reference = Reference(quad)
    start = random_states(DRONES, 0)
    commands = [random_commands(DRONES, 1 + i) for i in range(PERIODS)]
    state = start
    for command in commands:
        state = reference.flown_period(state, command)
    return start, commands, state


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 2e-5), (np.float32, 5e-4)])
def test_two_seconds_of_random_actions(
    flight: tuple[Array, list[Array], Array], airframe: Airframe, dtype: type, tolerance: float
) -> None:
    start, commands, expected = flight
    state = start.astype(dtype)
    plant = np.ones((4, DRONES), dtype)
    plant[:3] = airframe.drag_acceleration()[:, None]
    for command in commands:
        advance(state, command.astype(dtype), plant, airframe.pack(dtype), PERIOD, SUBSTEPS)
    error = np.linalg.norm(state[:3] - expected[:3], axis=0)
    assert np.abs(expected[:3] - start[:3]).max() > 5  # the drones do fly
    assert error.max() < tolerance


def test_integrator_is_of_fourth_order(
    quad: QuadConfig, airframe: Airframe, random_states: Callable[[int, int], Array]
) -> None:
    start, duration = random_states(5, 3), 0.04
    rotors = np.random.default_rng(4).uniform(0, quad.thrust_max, (4, 5))
    expected = Reference(quad).flown(start, rotors, duration)
    drag = tuple(airframe.drag_acceleration())
    errors = []
    for count in (4, 8, 16):
        worst = 0.0
        for i in range(5):
            column = tuple(float(x) for x in start[:, i])
            parts = column[:3], column[3:6], column[6:10], column[10:13], column[13:]
            for _ in range(count):
                parts = integrate(*parts, tuple(rotors[:, i]), drag, airframe.pack(np.float64), duration / count)
            worst = max(worst, float(np.abs(np.concatenate(parts) - expected[:, i]).max()))
        errors.append(worst)
    assert 13 < errors[0] / errors[1] < 20
    assert 13 < errors[1] / errors[2] < 20
