"""The batched simulator kernel: every drone advanced by one control period, in place."""

from __future__ import annotations

from typing import Any

from srlrace.sim.airframe import SIZE
from srlrace.sim.compile import inline, kernel
from srlrace.sim.quadrotor import integrate, rotor_targets
from srlrace.sim.vector import lanes, load, store


@inline
def load3(array: Any, row: int, start: int, count: int) -> Any:
    """Rows `row` to `row` + 2 of a block of drones."""
    return load(array, row, start, count), load(array, row + 1, start, count), load(array, row + 2, start, count)


@inline
def load4(array: Any, row: int, start: int, count: int) -> Any:
    """Rows `row` to `row` + 3 of a block of drones."""
    x, y, z = load3(array, row, start, count)
    return x, y, z, load(array, row + 3, start, count)


@inline
def store3(array: Any, row: int, start: int, count: int, value: Any) -> None:
    """Write rows `row` to `row` + 2 of a block of drones."""
    store(array, row, start, count, value[0])
    store(array, row + 1, start, count, value[1])
    store(array, row + 2, start, count, value[2])


@inline
def store4(array: Any, row: int, start: int, count: int, value: Any) -> None:
    """Write rows `row` to `row` + 3 of a block of drones."""
    store3(array, row, start, count, value)
    store(array, row + 3, start, count, value[3])


@inline
def advance_all(state: Any, command: Any, plant: Any, airframe: Any, dt: float, substeps: int) -> None:
    """Advance all drones by `dt` seconds in `substeps` RK4 steps, in place; the rate controller runs at each.

    state (17, n): position [m, world], velocity [m/s, world], attitude w, x, y, z (body to world),
    body rates [rad/s, body], rotor thrusts [N]. command (4, n): collective [m/s^2] and body rates [rad/s],
    held for the whole period. plant (4, n): drag along the body axes [1/s] and thrust gain [-].
    airframe: `Airframe.pack`. All of one float type (float32 or float64), C-contiguous. A drone with a non-finite
    state or a NaN command ends non-finite, alone. Raises ValueError on other shapes.
    """
    n = state.shape[1]
    if state.shape[0] != 17 or command.shape != (4, n) or plant.shape != (4, n) or airframe.size != SIZE:
        raise ValueError("advance needs state (17, n), command (4, n), plant (4, n) and an Airframe's packed constants")
    h = dt / substeps
    for start in range(0, n, lanes(state)):
        count = n - start
        p, v = load3(state, 0, start, count), load3(state, 3, start, count)
        q, w, f = load4(state, 6, start, count), load3(state, 10, start, count), load4(state, 13, start, count)
        asked = load4(command, 0, start, count)
        drag, gain = load3(plant, 0, start, count), load(plant, 3, start, count)
        for _ in range(substeps):
            target = rotor_targets(w, asked, gain, airframe)
            p, v, q, w, f = integrate(p, v, q, w, f, target, drag, airframe, h)
        store3(state, 0, start, count, p)
        store3(state, 3, start, count, v)
        store4(state, 6, start, count, q)
        store3(state, 10, start, count, w)
        store4(state, 13, start, count, f)


@kernel
def advance(state: Any, command: Any, plant: Any, airframe: Any, dt: float, substeps: int) -> None:
    """Do what `advance_all` does, called from Python."""
    advance_all(state, command, plant, airframe, dt, substeps)
