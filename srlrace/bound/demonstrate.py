"""Finding a demonstration: the flight that `srlrace.bound.demonstration` describes, from the time-optimal reference."""

from __future__ import annotations

import numpy as np

from srlrace.bound.accept import Rejected
from srlrace.bound.bending import bend
from srlrace.bound.demonstration import Demonstration, displacement_of, room_problem
from srlrace.bound.model import actuated_body, quick_body
from srlrace.bound.problem import problem_of
from srlrace.bound.solver import BoundError, settle
from srlrace.bound.trajectory import NODES, Array, Trajectory
from srlrace.bound.transcription import Nodes
from srlrace.schema import Config

SLOWER = 1.1  # the first guess takes as many times longer than the reference, which leaves the lag room


def find_demonstration(config: Config, reference: Trajectory) -> Demonstration:
    """Solve from the reference of the whole race; raises `BoundError` where that leads nowhere."""
    problem, displacement = room_problem(config), displacement_of(config)
    collective = reference.thrust.sum(axis=1, keepdims=True) / problem.quad.mass
    limit = np.array(problem.quad.body_rate_max)
    guess = Nodes(
        np.hstack([reference.state, np.vstack([reference.thrust, reference.thrust[-1:]])]),
        np.hstack([collective, np.clip(reference.state[1:, 10:13], -limit, limit)]),
        reference.step * SLOWER,
    )
    try:
        with quick_body(problem, actuated_body) as body:
            nodes = settle(problem, body, guess, set())
            if displacement > 0.0:
                nodes = bend(problem, body, nodes, displacement, config.randomization.min_height)
    except Rejected as failure:
        raise BoundError(f"no demonstration found: {failure}") from None
    return sample(config, nodes)


def sample(config: Config, nodes: Nodes) -> Demonstration:
    """Take states and actions where a policy of ``config`` would act, about every control period."""
    times = np.append(0.0, np.cumsum(nodes.steps))
    count = round(times[-1] / config.sim.control_period)
    at = np.linspace(0.0, times[-1], count + 1)
    path = nodes.state.copy()
    path[:, 6:10] = _continuous(path[:, 6:10])
    state = np.stack([np.interp(at, times, column) for column in path.T], axis=1)
    state[:, 6:10] /= np.linalg.norm(state[:, 6:10], axis=1, keepdims=True)
    middle = 0.5 * (at[1:] + at[:-1])
    held = nodes.control[np.searchsorted(times, middle, side="right") - 1]
    full = problem_of(config, "race")  # an action of 1 is what the quadrotor can, not what was left to it here
    action = np.hstack([2.0 * held[:, :1] / full.max_collective - 1.0, held[:, 1:] / np.array(full.quad.body_rate_max)])
    passing = np.ceil(times[NODES::NODES] / times[-1] * count - 1e-9).astype(np.int64)
    return Demonstration(state, action, passing, float(times[-1]))


def _continuous(quaternions: Array) -> Array:
    """Quaternions (n, 4) of length 1, each with the sign that is closer to the one before."""
    q = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(q * np.append(1.0, np.cumprod(flips))[:, None])
