"""A reference flown open loop through the race's own simulator, and judged by the race's own rules.

Nothing of the solver is used: the vehicle is `srlrace.sim`, the swept tests are `srlrace.world`'s. The rate controller
would steer back to the plan; with next to no gain and commands as much larger, what is left of it is its mixer, and the
rotors turn as planned whatever becomes of the flight.
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

TICKS = 128  # commands in a shooting interval: one every 0.2 ms or so
SUBSTEPS = 64  # RK4 steps in each: 0.003 ms
# The rotor lag cannot be zero; RK4 follows one of 2.5 steps like an exponential whatever the step, so that the whole
# flight is late by the same 0.008 ms. Were the lag another one in each segment, their difference would leave a spin.
STEPS_PER_LAG = 2.5
GAIN = 1e-6  # 1/s: a rate error of 1 rad/s then moves a torque by one part in a hundred million


@dataclass(frozen=True, eq=False)
class Replay:
    """What became of a reference in the simulator."""

    position: Array  # (ticks + 1, 3) m, world
    passing_times: Array  # (waypoints,) s, NaN from the first one that was missed
    clearance: float  # m, smallest gap between the drone's hull and any surface, swept; inf without obstacles
    drift: float  # m, largest distance from the reference


def replay(problem: Problem, trajectory: Trajectory) -> Replay:
    """Fly a reference through the simulator with next to no rotor lag."""
    plan = between_nodes(problem, trajectory, 2 * TICKS)  # its odd states are the middles of the ticks
    wrench = trajectory.thrust @ Airframe(problem.quad).mixer().T
    # What the rotors did before decides how late their first move is: hover, or the end of the lap before.
    before = trajectory.thrust[-1] if problem.lap else np.full(4, Airframe(problem.quad).hover_thrust)
    state = np.concatenate([trajectory.state[0], before])[:, None].copy()
    plant = np.append(problem.drag, 1.0)[:, None].copy()
    places = [state[:3, 0].copy()]
    lag = STEPS_PER_LAG * float(trajectory.step.max()) / TICKS / SUBSTEPS
    packed = Airframe(replace(problem.quad, rotor_time_constant=lag, rate_gains=(GAIN,) * 3)).pack(np.float64)
    for k, step in enumerate(trajectory.steps):
        dt = step / TICKS
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
    """The collective, m/s^2, and body rates, rad/s, at which a controller of `GAIN` asks for a wrench, N and N m."""
    inertia = np.array(problem.quad.inertia)
    torque = wrench[1:] - np.cross(rate, inertia * rate)
    return np.concatenate([[wrench[0] / problem.quad.mass], rate + torque / (inertia * GAIN)])


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
