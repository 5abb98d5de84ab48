"""A reference flown open loop through the race's own simulator, and judged by the race's own rules.

Nothing of the solver is used: the vehicle is `srlrace.sim`, the swept tests are `srlrace.world`'s. The commands are the
planned collective and, through the rate controller turned around, the planned body rates and torques; no state is fed
back to the plan.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import Array, Trajectory, between_nodes
from srlrace.sim.airframe import Airframe
from srlrace.sim.dynamics import advance
from srlrace.world.field import ObstacleField, pass_waypoint, swept_gap

TICKS = 32  # commands in a shooting interval: one every 0.8 ms or so
SUBSTEPS = 8  # RK4 steps in each: 0.1 ms
# RK4 cannot follow a lag much shorter than its step: its factor 1 - z + z^2/2 - z^3/6 + z^4/24, z = step / lag, is
# least, 0.27, at z = 1.6. With that the thrust is 2 % off its target after three steps, 0.3 ms.
STEP_PER_LAG = 1.596


@dataclass(frozen=True, eq=False)
class Replay:
    """What became of a reference in the simulator."""

    position: Array  # (ticks + 1, 3) m, world
    passing_times: Array  # (waypoints,) s, NaN from the first one that was missed
    clearance: float  # m, smallest gap between the drone's hull and any surface, swept; inf without obstacles
    drift: float  # m, largest distance from the reference


def replay(problem: Problem, trajectory: Trajectory) -> Replay:
    """Fly a reference through the simulator with the rotor lag as short as its step allows, 0.06 ms."""
    plan = between_nodes(problem, trajectory, 2 * TICKS)  # its odd states are the middles of the ticks
    wrench = trajectory.thrust @ Airframe(problem.quad).mixer().T
    state = np.concatenate([trajectory.state[0], trajectory.thrust[0]])[:, None].copy()
    plant = np.append(problem.drag, 1.0)[:, None].copy()
    places = [state[:3, 0].copy()]
    for k, step in enumerate(trajectory.steps):
        dt = step / TICKS
        quad = replace(problem.quad, rotor_time_constant=dt / SUBSTEPS / STEP_PER_LAG)
        packed = Airframe(quad).pack(np.float64)
        for tick in range(TICKS):
            command = _command(problem, plan[k, 2 * tick + 1, 10:13], wrench[k])
            advance(state, command[:, None].copy(), plant, packed, dt, SUBSTEPS)
            places.append(state[:3, 0].copy())
    position = np.array(places)
    planned = np.vstack([plan[:, :-1:2].reshape(-1, 13), plan[-1:, -1]])[:, :3]
    ticks = np.append(0.0, np.cumsum(np.repeat(trajectory.steps / TICKS, TICKS)))
    drift = float(np.linalg.norm(position - planned, axis=1).max())
    return Replay(position, _passings(problem, position, ticks), _clearance(problem, position), drift)


def _command(problem: Problem, rate: Array, wrench: Array) -> Array:
    """The collective, m/s^2, and body rates, rad/s, at which the rate controller asks for a wrench, N and N m."""
    inertia, gains = np.array(problem.quad.inertia), np.array(problem.quad.rate_gains)
    torque = wrench[1:] - np.cross(rate, inertia * rate)
    return np.concatenate([[wrench[0] / problem.quad.mass], rate + torque / (inertia * gains)])


def _passings(problem: Problem, position: Array, ticks: Array) -> Array:
    """When each waypoint is passed, one after the other, by the rule of the race."""
    times, target = np.full(len(problem.waypoints), np.nan), 0
    for k in range(len(position) - 1):
        if target == len(times):
            break
        share = pass_waypoint(*position[k], *position[k + 1], *problem.waypoints[target], problem.passing_radius)
        if share >= 0:
            times[target] = ticks[k] + share * (ticks[k + 1] - ticks[k])
            target += 1
    return times


def _clearance(problem: Problem, position: Array) -> float:
    if not problem.obstacles:
        return float("inf")
    field = ObstacleField.of_maps([problem.obstacles], problem.bounds_low, problem.bounds_high, 1, 1.0, np.float64)
    gaps = [swept_gap(*a, *b, 0, *field.arrays) for a, b in itertools.pairwise(position)]
    return float(min(gaps)) - problem.quad.arm_length
