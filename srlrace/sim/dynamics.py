"""The batched simulator kernel: every drone advanced by one control period, in place."""

from __future__ import annotations

from typing import Any

from srlrace.sim.compile import kernel
from srlrace.sim.quadrotor import step


@kernel
def advance(state: Any, command: Any, plant: Any, airframe: Any, dt: float, substeps: int) -> None:
    """Advance all drones by `dt` seconds in `substeps` RK4 steps, in place.

    state (17, n): position [m, world], velocity [m/s, world], attitude w, x, y, z (body to world),
    body rates [rad/s, body], rotor thrusts [N]. command (4, n): collective [m/s^2] and body rates [rad/s],
    held for the whole period. plant (4, n): drag along the body axes [1/s] and thrust gain [-].
    airframe: `Airframe.pack`. All of one float type, C-contiguous.
    """
    h = dt / substeps
    for i in range(state.shape[1]):
        p = state[0, i], state[1, i], state[2, i]
        v = state[3, i], state[4, i], state[5, i]
        q = state[6, i], state[7, i], state[8, i], state[9, i]
        w = state[10, i], state[11, i], state[12, i]
        f = state[13, i], state[14, i], state[15, i], state[16, i]
        u = command[0, i], command[1, i], command[2, i], command[3, i]
        drag = plant[0, i], plant[1, i], plant[2, i]
        for _ in range(substeps):
            p, v, q, w, f = step(p, v, q, w, f, u, drag, plant[3, i], airframe, h)
        state[0, i], state[1, i], state[2, i] = p
        state[3, i], state[4, i], state[5, i] = v
        state[6, i], state[7, i], state[8, i], state[9, i] = q
        state[10, i], state[11, i], state[12, i] = w
        state[13, i], state[14, i], state[15, i], state[16, i] = f
