"""How episodes start: at the track's start with random offsets; in training also elsewhere along the track."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import inline
from srlrace.task.arrays import (
    EPISODE_RETURN,
    MIN_CLEARANCE,
    PATH_LENGTH,
    PEAK_BODY_RATE,
    PEAK_SPEED,
    Fleet,
    Floats,
    Memory,
    Rules,
)
from srlrace.task.random import symmetric, uniform
from srlrace.world.field import nearest

START_TRIES = 64  # a start is redrawn while it touches an obstacle; at level 3 one draw in four does
FAR = 1e6  # m, the clearance of an episode that has not met an obstacle


@inline
def draw_map(fleet, rules, i):
    """Draw one of the maps that are offered now."""
    drawn = min(int(uniform(fleet.streams, i) * rules.maps), rules.maps - 1)
    fleet.map[i] = (rules.first_map + drawn) % rules.slots


@inline
def is_offered(fleet, rules, i):
    """Whether new episodes may get the map of drone ``i``: one that is about to go is not worth remembering."""
    return (fleet.map[i] - rules.first_map + rules.slots) % rules.slots < rules.maps


@inline
def draw_waypoints(fleet, rules, i):
    """Displace as many waypoints as the rules say, chosen without replacement, never below the minimum height."""
    count = rules.waypoints.shape[0]
    left = rules.displaced
    for w in range(count):
        chosen = rules.displacement > 0.0 and uniform(fleet.streams, i) * (count - w) < left
        for axis in range(3):
            fleet.waypoints[w, axis, i] = rules.waypoints[w, axis]
            if chosen:
                fleet.waypoints[w, axis, i] += symmetric(fleet.streams, i, rules.displacement)
        if chosen:
            left -= 1
            fleet.waypoints[w, 2, i] = max(fleet.waypoints[w, 2, i], rules.bounds[2] + rules.min_height)


@inline
def training_margin(fleet, rules, i):
    """Return how much further than in the race drone ``i`` must now keep away from obstacles and walls, in training."""
    return rules.margin if fleet.steps[i] >= rules.margin_steps else 0.0


@inline
def draw_position(fleet, rules, field, scratch, i):
    """Draw the position until it is clear of obstacles; the last of `START_TRIES` draws stands.

    Around the start, or around the waypoint before the target.
    """
    state = fleet.state
    before = rules.sequence[fleet.target[i] - 1] if fleet.target[i] > 0 else -1
    for _ in range(START_TRIES):
        for axis in range(3):
            centre = fleet.waypoints[before, axis, i] if before >= 0 else rules.start[axis]
            state[axis, i] = centre + symmetric(fleet.streams, i, rules.start_position)
        state[2, i] = max(state[2, i], rules.bounds[2] + rules.min_height)
        _, gap = nearest(
            state[0, i], state[1, i], state[2, i], fleet.map[i], *field, rules.reach, scratch.distance, scratch.index
        )
        if gap > rules.keep_out + training_margin(fleet, rules, i):
            break


@inline
def write_euler(state, i, roll, pitch, yaw):
    """Set the quaternion from yaw, pitch, roll (rotations about z, y', x'')."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    state[6, i] = cr * cp * cy + sr * sp * sy
    state[7, i] = sr * cp * cy - cr * sp * sy
    state[8, i] = cr * sp * cy + sr * cp * sy
    state[9, i] = cr * cp * sy - sr * sp * cy


@inline
def draw_attitude(fleet, rules, i):
    """Draw roll, pitch and yaw, or four quaternion components as Flightmare does; zero spread is upright."""
    half_width = rules.start_attitude
    a = symmetric(fleet.streams, i, half_width)
    b = symmetric(fleet.streams, i, half_width)
    c = symmetric(fleet.streams, i, half_width)
    if not rules.quaternion_draw or half_width == 0.0:
        write_euler(fleet.state, i, a, b, c)
        return
    w = symmetric(fleet.streams, i, half_width)
    inverse = 1.0 / math.sqrt(max(w * w + a * a + b * b + c * c, 1e-12))
    fleet.state[6, i] = w * inverse
    fleet.state[7, i] = a * inverse
    fleet.state[8, i] = b * inverse
    fleet.state[9, i] = c * inverse


@inline
def draw_motion(fleet, rules, i):
    """Draw the velocity; body rates start at zero and the rotors at hover thrust."""
    for axis in range(3):
        fleet.state[3 + axis, i] = symmetric(fleet.streams, i, rules.start_velocity)
        fleet.state[10 + axis, i] = 0.0
    for rotor in range(4):
        fleet.state[13 + rotor, i] = rules.hover_thrust


@inline
def draw_plant(fleet, rules, i):
    """Draw drag (one factor for the three axes) and thrust gain around their nominal values."""
    factor = 1.0 + symmetric(fleet.streams, i, rules.drag_spread)
    for axis in range(3):
        fleet.plant[axis, i] = rules.drag[axis] * factor
    fleet.plant[3, i] = 1.0 + symmetric(fleet.streams, i, rules.thrust_spread)


@inline
def clear_episode(fleet, i):
    """Forget what was tracked over the episode before."""
    fleet.passing_time[:, i] = 0.0
    fleet.first_target[i] = fleet.target[i]
    fleet.tally[MIN_CLEARANCE, i] = FAR
    fleet.tally[PEAK_SPEED, i] = 0.0
    fleet.tally[PATH_LENGTH, i] = 0.0
    fleet.tally[PEAK_BODY_RATE, i] = 0.0
    fleet.tally[EPISODE_RETURN, i] = 0.0


@inline
def start_fresh(fleet, rules, field, scratch, target, i):
    """Start an episode near the track's start, or near the waypoint before ``target``."""
    fleet.staged[i] = target > 0
    fleet.target[i] = target
    fleet.steps[i] = 0
    draw_map(fleet, rules, i)
    draw_waypoints(fleet, rules, i)
    draw_position(fleet, rules, field, scratch, i)
    draw_motion(fleet, rules, i)
    draw_attitude(fleet, rules, i)
    draw_plant(fleet, rules, i)


def record_size(waypoints: int) -> int:
    """Return the number of values of a remembered passing: state, plant, waypoints, steps, map."""
    return 17 + 4 + 3 * waypoints + 2


@inline
def write_record(fleet, row, i):
    """Write down the state of drone ``i``."""
    for j in range(17):
        row[j] = fleet.state[j, i]
    for j in range(4):
        row[17 + j] = fleet.plant[j, i]
    at = 21
    for w in range(fleet.waypoints.shape[0]):
        for axis in range(3):
            row[at] = fleet.waypoints[w, axis, i]
            at += 1
    row[at] = fleet.steps[i]
    row[at + 1] = fleet.map[i]


def records(fleet: Fleet) -> Floats:
    """Return the states of all drones, (n, record size), as `write_record` writes them."""
    flown = [fleet.steps[None], fleet.map[None]]
    return np.concatenate([fleet.state, fleet.plant, fleet.waypoints.reshape(-1, fleet.steps.size), *flown]).T


def put_records(fleet: Fleet, rows: Floats) -> None:
    """Put the drones of a fleet where others were: the inverse of `records`; targets stay as they are."""
    fleet.state[:], fleet.plant[:] = rows[:, :17].T, rows[:, 17:21].T
    fleet.waypoints[:] = rows[:, 21:-2].T.reshape(fleet.waypoints.shape)
    fleet.steps[:], fleet.map[:] = rows[:, -2], rows[:, -1]


def nominal_records(rules: Rules, state: Floats, steps: int) -> Floats:
    """Records, as `write_record` writes them, of states (n, 17) of the nominal quadrotor on the first map.

    No waypoint is displaced; ``steps`` have been flown, or as many as the horizon leaves.
    """
    clock = min(steps, rules.horizon_steps - 1)
    rest = np.concatenate([rules.drag, [1.0], rules.waypoints.ravel(), [clock, 0]])
    return np.hstack([state, np.tile(rest, (len(state), 1))])


@inline
def read_record(fleet, row, i):
    """Put drone ``i`` where another one was."""
    for j in range(17):
        fleet.state[j, i] = row[j]
    for j in range(4):
        fleet.plant[j, i] = row[17 + j]
    at = 21
    for w in range(fleet.waypoints.shape[0]):
        for axis in range(3):
            fleet.waypoints[w, axis, i] = row[at]
            at += 1
    fleet.steps[i] = int(row[at])
    fleet.map[i] = int(row[at + 1])


@inline
def remember(fleet, memory, i):
    """Write the state of drone ``i``, which has just passed a waypoint, to the ring of its new target."""
    k = fleet.target[i]
    row = memory.record[k, memory.count[k] % memory.record.shape[1]]
    memory.count[k] += 1
    write_record(fleet, row, i)


@inline
def begin_trail(fleet, memory, i):
    """Note where the episode of drone ``i`` begins, as its last two passings."""
    for row in memory.trail[i]:
        write_record(fleet, row, i)
        row[-1] = fleet.target[i]


@inline
def extend_trail(fleet, memory, i):
    """Note where drone ``i`` has just passed a waypoint, and forget its passing before the last."""
    before, last = memory.trail[i, 0], memory.trail[i, 1]
    for j in range(last.shape[0]):
        before[j] = last[j]
    write_record(fleet, last, i)
    last[-1] = fleet.target[i]


@inline
def remember_crash(memory, i):
    """Write where drone ``i``, which has just crashed, was at its passing before the last to the ring of hard ones."""
    row, trail = memory.hard[memory.hards[0] % memory.hard.shape[0]], memory.trail[i, 0]
    memory.hards[0] += 1
    for j in range(row.shape[0]):
        row[j] = trail[j]


@inline
def rehearse(fleet, rules, memory, i):
    """Start an episode from a random one of the hard passings, and cut it off when it should be past the danger."""
    size = min(memory.hards[0], memory.hard.shape[0])
    row = memory.hard[min(int(uniform(fleet.streams, i) * size), size - 1)]
    fleet.staged[i] = True
    fleet.rehearsing[i] = True
    fleet.target[i] = int(row[-1])
    read_record(fleet, row, i)
    fleet.last_step[i] = min(fleet.steps[i] + rules.hard_steps, rules.horizon_steps)


def forget_maps(memory: Memory, kept: NDArray[np.bool_]) -> None:
    """Drop the remembered passings on maps that are not ``kept`` (slots,); the others stay in the order of passing."""
    for k in range(len(memory.count)):
        _thin(memory.record[k], memory.count[k : k + 1], kept, column=-1)
    _thin(memory.hard, memory.hards, kept, column=-2)


def _thin(ring: Floats, count: NDArray[np.int64], kept: NDArray[np.bool_], column: int) -> None:
    """Drop the rows of a ring whose map, in ``column``, is not ``kept``; ``count`` (1,) is how often it was written."""
    size = min(int(count[0]), len(ring))
    rows = ring[(count[0] - size + np.arange(size)) % max(len(ring), 1)]
    staying = rows[kept[rows[:, column].astype(np.int64)]]
    if len(staying) < size:
        ring[: len(staying)] = staying
        count[0] = len(staying)


@inline
def start_remembered(fleet, memory, k, i):
    """Start an episode from a random entry of the ring of target ``k``."""
    size = min(memory.count[k], memory.record.shape[1])
    row = memory.record[k, min(int(uniform(fleet.streams, i) * size), size - 1)]
    fleet.staged[i] = True
    fleet.target[i] = k
    read_record(fleet, row, i)


@inline
def remembered_target(fleet, memory, i):
    """Draw one of the targets that have remembered passings, uniformly; -1 when there is none."""
    available = 0
    for k in range(memory.count.shape[0]):
        available += memory.count[k] > 0
    if available == 0:
        return -1
    nth = min(int(uniform(fleet.streams, i) * available), available - 1)
    for k in range(memory.count.shape[0]):
        if memory.count[k] > 0:
            if nth == 0:
                return k
            nth -= 1
    return -1


@inline
def remember_failure(fleet, memory, i):
    """Write how the start of drone ``i``, whose episode has just failed, was drawn to the ring of failed starts."""
    at = memory.failures[0] % memory.failed.shape[1]
    memory.failures[0] += 1
    memory.failed[0, at] = fleet.start_streams[0, i]
    memory.failed[1, at] = fleet.start_streams[1, i]


@inline
def start_again(fleet, rules, field, memory, scratch, i):
    """Start as a random one of the remembered failures did: its random numbers, drawn again."""
    size = min(memory.failures[0], memory.failed.shape[1])
    at = min(int(uniform(fleet.streams, i) * size), size - 1)
    key, position = fleet.streams[0, i], fleet.streams[1, i]
    fleet.streams[0, i], fleet.streams[1, i] = memory.failed[0, at], memory.failed[1, at]
    start_fresh(fleet, rules, field, scratch, 0, i)
    fleet.streams[0, i], fleet.streams[1, i] = key, position
    fleet.staged[i] = True


@inline
def start_hard(fleet, rules, i):
    """Start an episode from a random one of the hard starts that a way out is known of."""
    size = rules.escapes.shape[0]
    fleet.escape[i] = min(int(uniform(fleet.streams, i) * size), size - 1)
    fleet.staged[i] = True
    fleet.target[i] = 0
    read_record(fleet, rules.escapes[fleet.escape[i]], i)


@inline
def reset_drone(fleet, rules, field, memory, scratch, i):
    """Start a new episode of drone ``i``.

    From a remembered passing, near a waypoint, before an earlier crash, at the start of a failed episode, at a hard
    start with a known way out, or at a start of its own.
    """
    staged = rules.gate_starts + rules.memory_starts
    again = rules.retry_starts + rules.hard_starts
    known = again + rules.escape_starts
    draw = uniform(fleet.streams, i) if staged + known > 0.0 else 1.0
    fleet.rehearsing[i] = False
    fleet.escape[i] = -1
    fleet.last_step[i] = rules.horizon_steps
    k = remembered_target(fleet, memory, i) if draw < rules.memory_starts else -1
    if k >= 0:
        start_remembered(fleet, memory, k, i)
    elif draw >= 1.0 - rules.retry_starts and memory.failures[0] > 0:
        start_again(fleet, rules, field, memory, scratch, i)
    elif 1.0 - again <= draw < 1.0 - rules.retry_starts and memory.hards[0] > 0:
        rehearse(fleet, rules, memory, i)
    elif 1.0 - known <= draw < 1.0 - again and rules.escapes.shape[0] > 0:
        start_hard(fleet, rules, i)
    else:
        target = int(uniform(fleet.streams, i) * rules.sequence.shape[0]) if draw < staged else 0
        fleet.start_streams[0, i], fleet.start_streams[1, i] = fleet.streams[0, i], fleet.streams[1, i]
        start_fresh(fleet, rules, field, scratch, min(target, rules.sequence.shape[0] - 1), i)
    clear_episode(fleet, i)
    if memory.trail.shape[0] > 0:
        begin_trail(fleet, memory, i)
