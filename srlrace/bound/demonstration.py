"""A flight to learn from: as fast as the simulated quadrotor can fly a track, with room for errors.

T_ref's model has neither rotor lag nor a rate controller, and its flight touches every limit: nobody can follow it.
This one has both, holds its commands as a policy does, and stays clear of what it must not touch by more than the rules
ask. What it leaves of thrust and body rates is for corrections.
"""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srlrace.bound.problem import Problem, problem_of
from srlrace.bound.store import SHIPPED, cache_folder, first_sound, keep
from srlrace.files import FileError, read_limited
from srlrace.schema import Config

REVISION = 1  # of the method: a change that moves results makes older ones obsolete
# m, kept from obstacles beyond the rules' keep-out: ours. A policy follows a flight to about the first; where waypoints
# are displaced, the flight has to give way to that, too.
CLEARANCE, CLEARANCE_DISPLACED = 0.12, 0.2
RADIUS_SHARE = 2.0 / 3.0  # of the passing radius: ours
THRUST_SHARE = 0.95  # of each rotor's thrust: ours
RATE_SHARE = 0.9  # of the body rates that can be commanded: ours
LIMIT = 2**20  # bytes of a file: a flight of a minute
FOLDER_NAME = "demonstrations"
FOLDER = SHIPPED / FOLDER_NAME


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A flight from the track's start, sampled where commands change."""

    state: NDArray[np.float64]  # (n + 1, 17), as the simulator's
    action: NDArray[np.float64]  # (n, 4), as a policy's: within [-1, 1]
    passing: NDArray[np.int64]  # (targets,) index of the first state after passing each target
    duration: float  # s; n control periods, or up to half a period more or less


def displacement_of(config: Config) -> float:
    """How far waypoints are displaced per axis in an episode, m; 0 where they stay in their places."""
    some = config.env.displaced_waypoints > 0 or config.randomization.every_waypoint
    return config.randomization.waypoint_displacement if some else 0.0


def room_problem(config: Config) -> Problem:
    """The race from rest that a demonstration solves: farther from obstacles, closer to waypoints, weaker rotors."""
    problem = problem_of(config, "race")
    clearance, quad = CLEARANCE_DISPLACED if displacement_of(config) > 0.0 else CLEARANCE, problem.quad
    rates = (quad.body_rate_max[0] * RATE_SHARE, quad.body_rate_max[1] * RATE_SHARE, quad.body_rate_max[2] * RATE_SHARE)
    return replace(
        problem,
        keep_out=problem.keep_out + clearance if problem.obstacles else problem.keep_out,
        passing_radius=problem.passing_radius * RADIUS_SHARE,
        quad=replace(quad, thrust_max=quad.thrust_max * THRUST_SHARE, body_rate_max=rates),
    )


def demonstration_key(config: Config) -> str:
    """Name of the demonstration of a training configuration: a hash of all that it depends on."""
    quad, displacement = config.quad, displacement_of(config)
    extra: tuple[object, ...] = (REVISION, config.sim.control_period, quad.rotor_time_constant, quad.rate_gains)
    if displacement > 0.0:
        extra += (displacement, config.randomization.min_height)
    return hashlib.sha256(f"{room_problem(config).key} {extra}".encode()).hexdigest()[:16]


def load_demonstration(config: Config) -> Demonstration | None:
    """Return the demonstration of a configuration, shipped or found here; None where there is none that is sound."""
    targets = len(problem_of(config, "race").waypoints)
    return first_sound(demonstration_key(config), (FOLDER,), FOLDER_NAME, lambda path: _read(path, targets))


def save_demonstration(config: Config, found: Demonstration, folder: Path | None = None) -> Path:
    """Keep a demonstration for later commands; returns its file."""
    return keep(
        folder or cache_folder() / FOLDER_NAME,
        demonstration_key(config),
        state=found.state.astype(np.float32),
        action=found.action.astype(np.float32),
        passing=found.passing,
        duration=found.duration,
    )


def _read(path: Path, targets: int) -> Demonstration:
    with np.load(io.BytesIO(read_limited(path, LIMIT)), allow_pickle=False) as data:
        state, action = np.asarray(data["state"], np.float64), np.asarray(data["action"], np.float64)
        passing, duration = np.asarray(data["passing"], np.int64), float(data["duration"])
    n = len(action)
    fits = state.shape == (n + 1, 17) and action.shape == (n, 4) and passing.shape == (targets,) and n >= targets
    finite = fits and np.isfinite(state).all() and np.isfinite(action).all() and 0.0 < duration < np.inf
    unit = finite and np.allclose(np.linalg.norm(state[:, 6:10], axis=1), 1.0, atol=1e-3)
    if not unit or (np.diff(passing, prepend=0) < 1).any() or passing[-1] > n:
        raise FileError(f"cannot read {path}: not a demonstration")
    return Demonstration(state, action, passing, duration)
