"""One control step of all drones, fused into a single compiled kernel.

For each drone: action to command, dynamics, swept collision and passing, reward, end of episode,
reset, observation. Fusing pays: at 100 drones the whole step takes tens of microseconds, about as
much as a handful of separate numpy calls.

Between the ends of a step the path is taken as the chord: at 45 m/s^2, the most the airframe can do,
a 20 ms arc leaves its chord by a t^2 / 8 = 2 mm.
"""

from __future__ import annotations

import math

from srlrace.sim.compile import inline, kernel
from srlrace.sim.dynamics import advance_all
from srlrace.task.arrays import (
    CRASHED,
    DIVERGED,
    EPISODE_RETURN,
    EPISODES,
    FINISH_TIME,
    FINISHED,
    FLYING,
    GATES_PASSED,
    LENGTH,
    MIN_CLEARANCE,
    OUT_OF_BOUNDS,
    PATH_LENGTH,
    PEAK_BODY_RATE,
    PEAK_SPEED,
    TIMEOUT,
)
from srlrace.task.observation import observe
from srlrace.task.reset import (
    FAR,
    extend_trail,
    is_offered,
    remember,
    remember_crash,
    remember_failure,
    reset_drone,
    training_margin,
)
from srlrace.task.reward import body_rate, progress, reward_terms
from srlrace.world.field import nearest, pass_waypoint, swept_gap

SWEEP_WITHIN = 1.0  # m; farther from every surface, the gap at the step's end is reported unswept


@inline
def command_from_action(action, rules, scratch, i):
    """Turn an action in [-1, 1]^4, clipped, into collective thrust (m/s^2) and body rates (rad/s)."""
    scratch.command[0, i] = 0.5 * (min(max(action[i, 0], -1.0), 1.0) + 1.0) * rules.max_collective
    for axis in range(3):
        scratch.command[1 + axis, i] = min(max(action[i, 1 + axis], -1.0), 1.0) * rules.body_rate_max[axis]


@inline
def sense(fleet, rules, field, scratch, i):
    """Find the nearest obstacles of drone ``i``; return how many are in range and the gap to the nearest surface."""
    x, y, z = fleet.state[0, i], fleet.state[1, i], fleet.state[2, i]
    return nearest(x, y, z, fleet.map[i], *field, rules.reach, scratch.distance, scratch.index)


@inline
def observe_into(fleet, rules, field, scratch, i, out):
    """Sense and write the observation of drone ``i``; return its clearance, m."""
    _, gap = sense(fleet, rules, field, scratch, i)
    observe(fleet, rules, field, i, scratch.distance, scratch.index, out[i])
    return gap - rules.arm_length


@inline
def is_finite(state, i):
    """Whether every state value of drone ``i`` is finite."""
    total = 0.0
    for row in range(17):
        total += abs(state[row, i])
    return total < 1e12


@inline
def contain(fleet, rules, scratch, i):
    """Put a diverged drone back where its step began, at rest and upright, so that nothing non-finite is seen."""
    fleet.state[:, i] = 0.0
    fleet.state[6, i] = 1.0
    for axis in range(3):
        before = scratch.previous[axis, i]
        fleet.state[axis, i] = before if abs(before) < 1e12 else rules.start[axis]


@inline
def chord(fleet, scratch, i):
    """Both ends of the step of drone ``i``: x, y, z before and after."""
    state, before = fleet.state, scratch.previous
    return before[0, i], before[1, i], before[2, i], state[0, i], state[1, i], state[2, i]


@inline
def waypoint(fleet, w, i):
    """Position of waypoint ``w`` in the episode of drone ``i``."""
    return fleet.waypoints[w, 0, i], fleet.waypoints[w, 1, i], fleet.waypoints[w, 2, i]


@inline
def step_clearance(fleet, rules, field, scratch, gap, i):
    """Return the smallest gap between the drone's hull and any obstacle surface during the step, m."""
    x0, y0, z0, x1, y1, z1 = chord(fleet, scratch, i)
    length = math.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2 + (z1 - z0) ** 2)
    if gap < SWEEP_WITHIN + length:
        gap = min(gap, swept_gap(x0, y0, z0, x1, y1, z1, fleet.map[i], *field))
    return gap - rules.arm_length


@inline
def inside(state, bounds, margin, i):
    """Whether drone ``i`` is ``margin`` m inside the world; a box is convex: the step's end decides for the chord."""
    for axis in range(3):
        if state[axis, i] < bounds[axis] + margin or state[axis, i] > bounds[3 + axis] - margin:
            return False
    return True


@inline
def track_episode(fleet, scratch, clearance, rate, i):
    """Update what is tracked over the episode."""
    state, tally = fleet.state, fleet.tally
    speed = math.sqrt(state[3, i] ** 2 + state[4, i] ** 2 + state[5, i] ** 2)
    length = math.sqrt(
        (state[0, i] - scratch.previous[0, i]) ** 2
        + (state[1, i] - scratch.previous[1, i]) ** 2
        + (state[2, i] - scratch.previous[2, i]) ** 2
    )
    tally[MIN_CLEARANCE, i] = min(tally[MIN_CLEARANCE, i], clearance)
    tally[PEAK_SPEED, i] = max(tally[PEAK_SPEED, i], speed)
    tally[PATH_LENGTH, i] += length
    tally[PEAK_BODY_RATE, i] = max(tally[PEAK_BODY_RATE, i], rate)


@inline
def try_passing(fleet, rules, scratch, i):
    """Advance the target if the step passes it; return the fraction of the step at which it did, or -1."""
    w = rules.sequence[fleet.target[i]]
    fraction = pass_waypoint(*chord(fleet, scratch, i), *waypoint(fleet, w, i), rules.passing_radius)
    if fraction >= 0.0:
        fleet.passing_time[fleet.target[i], i] = (fleet.steps[i] - 1 + fraction) * rules.dt
        fleet.target[i] += 1
    return fraction


@inline
def target_progress(fleet, rules, scratch, target, i):
    """Metres gained towards ``target``, the one that was valid when the step began."""
    w = rules.sequence[target]
    return progress(*chord(fleet, scratch, i), *waypoint(fleet, w, i))


@inline
def judge(fleet, rules, field, memory, scratch, out, gap, i):
    """Decide how the step of drone ``i`` ended: collision, bounds, passing, horizon. Return the outcome."""
    clearance = step_clearance(fleet, rules, field, scratch, gap, i)
    out.clearance[i] = clearance
    track_episode(fleet, scratch, clearance, body_rate(fleet.state, i), i)
    margin = training_margin(fleet, rules, i)
    if clearance < rules.keep_out + margin - rules.arm_length:
        return CRASHED
    if not inside(fleet.state, rules.bounds, margin, i):
        return OUT_OF_BOUNDS
    fraction = try_passing(fleet, rules, scratch, i)
    if fraction >= 0.0:
        if fleet.target[i] == rules.sequence.shape[0]:
            out.time[i] = (fleet.steps[i] - 1 + fraction) * rules.dt
            return FINISHED
        if rules.memory_starts > 0.0 and is_offered(fleet, rules, i):
            remember(fleet, memory, i)
        if memory.trail.shape[0] > 0:
            extend_trail(fleet, memory, i)
    if fleet.steps[i] >= fleet.last_step[i]:
        return TIMEOUT
    return FLYING


@inline
def copy_column(source, target, i):
    """Copy what belongs to drone ``i``, value by value: an array assignment would allocate."""
    for row in range(target.shape[0]):
        target[row, i] = source[row, i]


@inline
def close_episode(fleet, out, outcome, i):
    """Copy what was tracked over the episode to the output, and enter real starts into the ledger."""
    copy_column(fleet.tally, out.final_tally, i)
    copy_column(fleet.passing_time, out.final_passing_time, i)
    out.final_target[i] = fleet.target[i]
    if fleet.staged[i]:
        return
    out.ledger[EPISODES] += 1.0
    out.ledger[outcome] += 1.0
    out.ledger[LENGTH] += fleet.steps[i]
    out.ledger[GATES_PASSED] += fleet.target[i]
    if outcome == FINISHED:
        out.ledger[FINISH_TIME] += out.time[i]


@inline
def step_drone(fleet, rules, field, memory, scratch, out, weights, i):
    """Everything of a step that comes after the dynamics, for drone ``i``."""
    fleet.steps[i] += 1
    out.time[i] = fleet.steps[i] * rules.dt
    target = fleet.target[i]
    count, gain, rate = 0, 0.0, 0.0
    outcome = DIVERGED
    if is_finite(fleet.state, i):
        count, gap = sense(fleet, rules, field, scratch, i)
        gain = target_progress(fleet, rules, scratch, target, i)
        rate = body_rate(fleet.state, i)
        outcome = judge(fleet, rules, field, memory, scratch, out, gap, i)
    else:
        contain(fleet, rules, scratch, i)
        sense(fleet, rules, field, scratch, i)
        out.clearance[i] = FAR
    collided = outcome == CRASHED or outcome == OUT_OF_BOUNDS or outcome == DIVERGED
    total_time = out.time[i]
    finished = outcome == FINISHED
    reward = reward_terms(
        weights, gain, rate, scratch.distance, count, collided, finished, total_time, rules.dt, out.reward_terms, i
    )
    out.reward[i] = reward
    out.outcome[i] = outcome
    fleet.tally[EPISODE_RETURN, i] += reward
    for k in range(weights.shape[0]):
        out.ledger[GATES_PASSED + 1 + k] += out.reward_terms[k, i]
    if outcome == FLYING:
        observe(fleet, rules, field, i, scratch.distance, scratch.index, out.observation[i])
        return
    observe(fleet, rules, field, i, scratch.distance, scratch.index, out.terminal_observation[i])
    close_episode(fleet, out, outcome, i)
    if rules.retry_starts > 0.0 and outcome != FINISHED and not fleet.staged[i]:
        remember_failure(fleet, memory, i)
    hard = collided or (rules.hard_late and outcome == TIMEOUT)
    if memory.trail.shape[0] > 0 and hard and not fleet.rehearsing[i] and is_offered(fleet, rules, i):
        remember_crash(memory, i)
    if rules.autoreset:
        reset_drone(fleet, rules, field, memory, scratch, i)
        observe_into(fleet, rules, field, scratch, i, out.observation)
    else:
        fleet.parked[i] = True


@inline
def drift(state, wind, factor, dt):
    """Add ``factor`` times the wind to the velocities, and what it carries in ``dt`` s to the positions."""
    for i in range(wind.shape[1]):
        for axis in range(3):
            state[axis, i] += dt * wind[axis, i]
            state[3 + axis, i] += factor * wind[axis, i]


@kernel
def step_all(action, fleet, rules, field, memory, scratch, out, weights):
    """Advance every drone by one control step; ``action`` is (n, 4), ``weights`` (terms,) as of now."""
    n = fleet.state.shape[1]
    for i in range(n):
        command_from_action(action, rules, scratch, i)
        copy_column(fleet.state, scratch.previous, i)
    drift(fleet.state, rules.wind, -1.0, 0.0)
    advance_all(fleet.state, scratch.command, fleet.plant, rules.airframe, rules.dt, rules.substeps)
    drift(fleet.state, rules.wind, 1.0, rules.dt)
    for i in range(n):
        if not fleet.parked[i]:
            step_drone(fleet, rules, field, memory, scratch, out, weights, i)


@kernel
def reset_all(fleet, rules, field, memory, scratch, out):
    """Start a new episode of every drone and observe it."""
    for i in range(fleet.state.shape[1]):
        fleet.parked[i] = False
        reset_drone(fleet, rules, field, memory, scratch, i)
        out.clearance[i] = observe_into(fleet, rules, field, scratch, i, out.observation)


@kernel
def observe_all(fleet, rules, field, scratch, out):
    """Write what every drone sees in its present state to ``out`` (n, d)."""
    for i in range(fleet.state.shape[1]):
        observe_into(fleet, rules, field, scratch, i, out)
