"""The arrays of a race, grouped by how they change; the kernels take these groups whole.

Drone index last: an array of k values for n drones has shape (k, n). Floats are float32 in training
and evaluation; the same kernels run in float64.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

# How an episode ended; FLYING while it has not.
OUTCOMES = ("flying", "finished", "crashed", "out_of_bounds", "timeout", "diverged")
FLYING, FINISHED, CRASHED, OUT_OF_BOUNDS, TIMEOUT, DIVERGED = range(len(OUTCOMES))

# Rows of Fleet.tally: what is summed or tracked over an episode.
TALLY = ("min_clearance", "peak_speed", "path_length", "peak_body_rate", "episode_return")
MIN_CLEARANCE, PEAK_SPEED, PATH_LENGTH, PEAK_BODY_RATE, EPISODE_RETURN = range(len(TALLY))

# Entries of Output.ledger: sums over the episodes that ended since it was last emptied.
LEDGER = ("episodes", *OUTCOMES[1:], "finish_time", "length", "gates_passed")
EPISODES, FINISH_TIME, LENGTH, GATES_PASSED = 0, len(OUTCOMES), len(OUTCOMES) + 1, len(OUTCOMES) + 2


class Rules(NamedTuple):
    """Constant during a race."""

    dt: float  # s, control period
    substeps: int
    horizon_steps: int
    sequence: NDArray[np.int64]  # (k,) waypoint of each target, in passing order
    waypoints: Floats  # (w, 3) m, world, nominal
    start: Floats  # (3,) m, world
    bounds: Floats  # (6,) m: low x, y, z, high x, y, z
    passing_radius: float  # m
    arm_length: float  # m
    keep_out: float  # m, arm length plus safety margin: closer to a surface is a crash
    margin: float  # m, by which training keeps further from surfaces, and from walls
    margin_steps: int  # of an episode before it does
    airframe: Floats  # packed `srlrace.sim.airframe.Airframe`
    hover_thrust: float  # N per rotor
    max_collective: float  # m/s^2
    body_rate_max: Floats  # (3,) rad/s
    drag: Floats  # (3,) 1/s, nominal
    weights: Floats  # (terms,)
    blocks: NDArray[np.int64]  # codes of the observation's blocks
    targets: int
    nearest: int  # N
    reach: float  # m, range in which obstacles are seen
    rays: int
    directions: Floats  # (2, rays) unit vectors of the rays, in the axes of the observation
    ray_scale: float  # m
    ray_walls: bool  # rays end at the world's walls, too
    facing: bool  # the observation's x axis points to the target, not along the world's
    maps: int  # that resets draw from
    first_map: int  # of them; the others follow, from the last slot on to the first
    slots: int  # places for maps
    start_position: float  # m, half width
    start_velocity: float  # m/s, half width
    start_attitude: float  # rad, half width
    quaternion_draw: bool
    min_height: float  # m above the floor
    displaced: int  # waypoints displaced per episode
    displacement: float  # m, half width
    drag_spread: float
    thrust_spread: float
    gate_starts: float  # share of resets near a random waypoint
    memory_starts: float  # share of resets from a remembered passing
    retry_starts: float  # share of resets from the start of an earlier episode that failed
    hard_starts: float  # share of resets from where a drone was two passings before it crashed
    hard_steps: int  # after which a flight from there ends
    hard_late: bool  # there are such resets after a flight that was late, too
    escape_starts: float  # share of resets from one of `escapes`
    escapes: Floats  # (m, record size): hard starts that a teacher knows a way out of
    autoreset: bool
    wind: Floats  # (3, n) m/s, world; (3, 0) in still air


class Fleet(NamedTuple):
    """Changes at every step or reset: together with `Memory` the whole state of a race."""

    state: Floats  # (17, n): position, velocity, quaternion, body rates, rotor thrusts
    plant: Floats  # (4, n): drag 1/s along the body axes, thrust gain
    waypoints: Floats  # (w, 3, n) m, world: as flown in this episode
    passing_time: Floats  # (k, n) s since the start; 0 where not passed in this episode
    tally: Floats  # (len(TALLY), n)
    target: NDArray[np.int32]  # (n,) index into Rules.sequence
    first_target: NDArray[np.int32]  # (n,) target at the start of the episode
    steps: NDArray[np.int32]  # (n,) since the start
    last_step: NDArray[np.int32]  # (n,) at which the episode is cut off
    map: NDArray[np.int32]  # (n,)
    staged: NDArray[np.bool_]  # (n,) started elsewhere than at the start: not counted in the ledger
    parked: NDArray[np.bool_]  # (n,) episode over and no autoreset
    streams: NDArray[np.uint64]  # (2, n) random numbers
    start_streams: NDArray[np.uint64]  # (2, n) as they were before the episode's start was drawn
    rehearsing: NDArray[np.bool_]  # (n,) started from a hard passing
    escape: NDArray[np.int32]  # (n,) index into Rules.escapes of the episode's start; -1 for any other start


class Memory(NamedTuple):
    """What resets remember of earlier episodes.

    States in which they passed a waypoint, one ring per target; starts of failed ones, one ring; where drones were two
    passings before they crashed, one ring. A record ends with its target where its ring does not say it.
    """

    record: Floats  # (k, capacity, record size)
    count: NDArray[np.int64]  # type: ignore[assignment]  # (k,) passings ever written to each ring; hides tuple.count
    failed: NDArray[np.uint64]  # (2, capacity) streams from which such a start was drawn
    failures: NDArray[np.int64]  # (1,) failed starts ever written
    trail: Floats  # (n, 2, record size + 1): each drone at its last two passings, or at its start
    hard: Floats  # (capacity, record size + 1): passings that were followed by another one and a crash
    hards: NDArray[np.int64]  # (1,) such passings ever written


class Output(NamedTuple):
    """Written by every step, read by whoever called it."""

    observation: Floats  # (n, d): of the next episode where one ended
    terminal_observation: Floats  # (n, d): valid where an episode ended
    reward: Floats  # (n,)
    reward_terms: Floats  # (terms, n), weighted
    clearance: Floats  # (n,) m, smallest gap between drone and obstacle surface during the step, or at the reset
    outcome: NDArray[np.int8]  # (n,) index into OUTCOMES
    time: Floats  # (n,) s since the start, interpolated for a finish
    final_tally: Floats  # (len(TALLY), n): valid where an episode ended
    final_passing_time: Floats  # (k, n): valid where an episode ended
    final_target: NDArray[np.int32]  # (n,): valid where an episode ended
    ledger: NDArray[np.float64]  # (len(LEDGER) + terms,): outcomes of episodes from the start only; terms of every step


class Scratch(NamedTuple):
    """Room to work in, meaningless between steps."""

    command: Floats  # (4, n)
    previous: Floats  # (3, n) m, positions before the step
    distance: Floats  # (N,) m
    index: NDArray[np.int32]  # type: ignore[assignment]  # (N,); hides tuple.index
