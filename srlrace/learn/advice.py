"""What a regulator along a demonstrated flight would do, in a compiled kernel (see `srlrace.learn.teacher`)."""

from __future__ import annotations

from srlrace.sim.compile import inline, kernel

ERRORS = 16  # position, velocity, rotation vector (body), body rates, rotor thrusts: deviations from the flight
# Beyond these errors the regulator has nothing to say: 1 m per axis, 5 m/s, 1.2 rad. Ours.
TUBE_POSITION, TUBE_SPEED, TUBE_ANGLE = 1.0, 5.0, 1.2
DISPLACED = 0.15  # m per axis: nor where this waypoint or the next is displaced by more; half the passing radius
# What part of the flight a drone is at: the closest in position and velocity, a metre counting as 6 m/s. Ours.
PHASE_POSITION, PHASE_SPEED = 9.0, 0.25  # weights of squares, 1/m^2 and s^2/m^2
AROUND = 2  # samples before and after a segment that count as its own


@inline
def is_displaced(fleet, rules, target, i):
    """Whether the waypoint of ``target`` is displaced in the episode of drone ``i``."""
    w = rules.sequence[min(target, rules.sequence.shape[0] - 1)]
    off = 0.0
    for axis in range(3):
        off = max(off, abs(fleet.waypoints[w, axis, i] - rules.waypoints[w, axis]))
    return off > DISPLACED


@inline
def closest(fleet, states, first, last, i):
    """Return the sample from ``first`` to before ``last`` that drone ``i`` is closest to."""
    best, least = first, 1e18
    for k in range(first, last):
        place, speed = 0.0, 0.0
        for axis in range(3):
            place += (fleet.state[axis, i] - states[k, axis]) ** 2
            speed += (fleet.state[3 + axis, i] - states[k, 3 + axis]) ** 2
        distance = PHASE_POSITION * place + PHASE_SPEED * speed
        if distance < least:
            best, least = k, distance
    return best


@inline
def measure(fleet, nominal, error, i):
    """Write the error (16,) of drone ``i`` from a state; return whether it is within the tube."""
    s = fleet.state
    for j in range(6):
        error[j] = s[j, i] - nominal[j]
    w, x, y, z = nominal[6], -nominal[7], -nominal[8], -nominal[9]
    turned = w * s[6, i] - x * s[7, i] - y * s[8, i] - z * s[9, i]
    sign = 2.0 if turned >= 0.0 else -2.0
    error[6] = sign * (w * s[7, i] + x * s[6, i] + y * s[9, i] - z * s[8, i])
    error[7] = sign * (w * s[8, i] - x * s[9, i] + y * s[6, i] + z * s[7, i])
    error[8] = sign * (w * s[9, i] + x * s[8, i] - y * s[7, i] + z * s[6, i])
    for j in range(7):
        error[9 + j] = s[10 + j, i] - nominal[10 + j]
    near = max(abs(error[0]), abs(error[1]), abs(error[2])) < TUBE_POSITION
    speed = error[3] ** 2 + error[4] ** 2 + error[5] ** 2
    angle = error[6] ** 2 + error[7] ** 2 + error[8] ** 2
    return near and speed < TUBE_SPEED**2 and angle < TUBE_ANGLE**2


@kernel
def advise_escapes(fleet, actions, hold, worth, action, weight):
    """Write the way out (n, 4) for every drone on one, and how much it counts (n,); leave the others as they are.

    ``actions`` (m, k, 4) are each held for ``hold`` control periods from the start on.
    """
    for i in range(fleet.steps.shape[0]):
        part = fleet.steps[i] // hold
        if fleet.escape[i] < 0 or part >= actions.shape[1]:
            continue
        weight[i] = worth
        for j in range(4):
            action[i, j] = actions[fleet.escape[i], part, j]


@kernel
def advise_all(fleet, rules, plan, error, worth, action, weight):
    """Write the regulator's action (n, 4), and ``worth`` (n,), where it is to be followed; not elsewhere."""
    states, actions, gains, ranges = plan
    for i in range(fleet.state.shape[1]):
        target = fleet.target[i]
        if target >= ranges.shape[0]:  # finished, and parked
            continue
        if is_displaced(fleet, rules, target, i) or is_displaced(fleet, rules, target + 1, i):
            continue
        k = closest(fleet, states, ranges[target, 0], ranges[target, 1], i)
        if not measure(fleet, states[k], error, i):
            continue
        weight[i] = worth
        for j in range(4):
            value = actions[k, j]
            for e in range(ERRORS):
                value -= gains[k, j, e] * error[e]
            action[i, j] = min(max(value, -1.0), 1.0)
