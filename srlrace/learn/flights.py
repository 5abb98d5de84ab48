"""Flights without noise that no crash ends, and how much room they leave.

The *room* of a flight is how much closer to an obstacle or a wall the drone could have been at any step without a
crash; less than 0 after one. Where waypoints count as well, it is also how far inside its sphere each was passed, or,
less than 0, how narrowly it was missed.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import kernel
from srlrace.sim.dynamics import advance
from srlrace.task.race import STATE_SIZE, Race, RaceMode, commands
from srlrace.task.reset import put_records, records
from srlrace.task.step import sense, try_passing

OVER = 1e3  # m, the room of a flight that has finished
FREE = 0.5  # m: who has more room than this at first is not in danger because of where he starts
SLOW = 1.5  # times what half of the flights take to the finish: whole flights that take longer are cut short
AFTER = 3  # control periods for which flights from close places go on after they have come closest
HOPELESS = 0.25  # m: places from where a flight gets deeper than this into something are no close places
NOT_LOST = 0.8  # times the depth that is hopeless: a flight from a close place that gets deeper does not count
MISSED = 0.3  # m; who passes a waypoint's sphere at a greater distance is not on the way into it

Floats = NDArray[np.float64]
Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # a policy: mean actions (n, 4) for observations (n, d)
Watch = Callable[[NDArray[np.float32], NDArray[np.bool_]], None]  # sees observations (n, d), and which drones still fly


@kernel
def measure_room(fleet: Any, rules: Any, field: Any, scratch: Any, room: Any) -> None:
    """Write how much closer each drone could be to obstacles and walls without a crash, m, to ``room`` (n,)."""
    for i in range(room.shape[0]):
        _, gap = sense(fleet, rules, field, scratch, i)
        room[i] = gap - rules.keep_out
        for axis in range(3):
            low, high = rules.bounds[axis], rules.bounds[3 + axis]
            room[i] = min(room[i], fleet.state[axis, i] - low, high - fleet.state[axis, i])


@kernel
def pass_targets(fleet: Any, rules: Any, scratch: Any) -> None:
    """Advance the targets of drones that have passed theirs, coming from ``scratch.previous``."""
    for i in range(fleet.target.shape[0]):
        if fleet.target[i] < rules.sequence.shape[0]:
            try_passing(fleet, rules, scratch, i)


@kernel
def measure_passing(fleet: Any, rules: Any, scratch: Any, target: Any, inside: Any, slope: Any) -> None:
    """Write how far inside its sphere each drone passed a waypoint in the last step, m, to ``inside`` (n,).

    A waypoint counts in the step in which the drone comes closest to it: the ``target`` (n,) of the step's beginning,
    and the one before, as long as the drone is in its sphere. Where there is none, it is `OVER`. ``slope`` (n, 3) is
    how it changes with the place.
    """
    for i in range(inside.shape[0]):
        inside[i] = OVER
        for back in range(2):
            if not 0 <= target[i] - back < rules.sequence.shape[0]:
                continue
            w = rules.sequence[target[i] - back]
            along, length, distance = 0.0, 0.0, 0.0
            for axis in range(3):
                way = fleet.state[axis, i] - scratch.previous[axis, i]
                off = fleet.waypoints[w, axis, i] - scratch.previous[axis, i]
                along, length, distance = along + way * off, length + way * way, distance + off * off
            if along <= 0.0 or along > length or (back == 1 and distance > rules.passing_radius**2):
                continue
            distance = math.sqrt(max(distance - along * along / length, 1e-12))
            depth = rules.passing_radius - distance
            if -MISSED < depth < inside[i]:
                inside[i] = depth
                for axis in range(3):
                    way = fleet.state[axis, i] - scratch.previous[axis, i]
                    off = fleet.waypoints[w, axis, i] - scratch.previous[axis, i]
                    slope[i, axis] = (off - way * along / length) / distance


class Flights(Race):
    """n flights without noise that no crash ends, from records of `srlrace.task.reset` that end with their target.

    With ``ease``, m, waypoints count, too: how far inside its sphere one was passed, plus the ease, is room.
    """

    def __init__(self, race: Race, n: int, ease: float | None = None) -> None:
        """Take settings and field from ``race``, and sizes as they are in evaluation."""
        mode = RaceMode.evaluation(0, np.zeros(n, np.int64))
        super().__init__(race.config, mode, race.field, dtype=np.float64)
        self._ease = ease
        self._inside, self._slope = np.full(n, OVER), np.zeros((n, 3))

    def others(self, n: int) -> Flights:
        """Return so many flights like these."""
        return Flights(self, n, self._ease)

    def begin(self, records: NDArray[Any]) -> None:
        """Put all drones where their records (n, record size + 1) say."""
        put_records(self.fleet, records[:, :-1])
        self.fleet.target[:] = records[:, -1]
        self._inside[:] = OVER

    @property
    def finished(self) -> NDArray[np.bool_]:
        """Which drones (n,) have passed the last target."""
        return self.fleet.target >= len(self.rules.sequence)

    @property
    def velocity(self) -> Floats:
        """Mean velocities (n, 3) during the last step, m/s."""
        return (self.fleet.state[:3] - self._scratch.previous[:3]).T / self.rules.dt

    def see(self) -> NDArray[np.float32]:
        """Observations (n, d), overwritten by the next call."""
        return cast(NDArray[np.float32], self.observe(self.fleet.state))

    def clearance(self, first: int | None = None) -> Floats:
        """Room (n,) of all drones, or of so many first ones, to obstacles and walls where they are, m."""
        room = np.empty(self.n if first is None else first)
        measure_room(self.fleet, self.rules, self.field.arrays, self._scratch, room)
        room[self.finished[: len(room)]] = OVER
        return room

    def passing(self, first: int | None = None) -> tuple[Floats, Floats]:
        """Room (n,) in the spheres of the waypoints that were passed in the last step, and its slope (n, 3)."""
        return self._inside[:first] + (self._ease or 0.0), self._slope[:first]

    def room(self, first: int | None = None) -> Floats:
        """Room (n,) of all drones, or of so many first ones, after the last step, m."""
        return np.minimum(self.clearance(first), self.passing(first)[0])

    def fly(self, action: NDArray[Any]) -> None:
        """Fly one control period with actions (n, 4), clipped."""
        rules, scratch, state = self.rules, self._scratch, self.fleet.state
        scratch.command[:] = commands(rules, np.clip(action, -1.0, 1.0)).T
        scratch.previous[:3] = state[:3]
        advance(state, scratch.command, self.fleet.plant, rules.airframe, rules.dt, rules.substeps)
        target = self.fleet.target.copy()
        pass_targets(self.fleet, rules, scratch)
        if self._ease is not None:
            measure_passing(self.fleet, rules, scratch, target, self._inside, self._slope)


def drawn_starts(race: Race, n: int, first: int = 0, widened: bool = True) -> NDArray[Any]:
    """Draw ``n`` starts (n, record size) of a training that none of its episodes has, from the ``first`` one on.

    Unless they are ``widened``, from ranges as they are in evaluation.
    """
    config = race.config
    if not widened:
        curriculum = dataclasses.replace(config.curriculum, start_margin=0.0, obstacle_margin=0.0)
        config = dataclasses.replace(config, curriculum=curriculum)
    members = config.algo.n_envs + first + np.arange(n)
    mode = RaceMode(config.seed, members, autoreset=False, curriculum=True)
    drawn = Race(config, mode, race.field)
    drawn.rules = drawn.rules._replace(
        gate_starts=0.0, memory_starts=0.0, retry_starts=0.0, hard_starts=0.0, escape_starts=0.0
    )
    drawn.reset()
    return records(drawn.fleet)


def at_first_target(starts: NDArray[Any]) -> NDArray[Any]:
    """Return records of starts (n, record size) as `Flights` takes them."""
    return np.pad(starts, ((0, 0), (0, 1)))


def least_room(flights: Flights, act: Act, records: NDArray[Any], steps: int) -> Floats:
    """Return the least room (n,) of a policy's flights of so many ``steps`` from ``records``, m."""
    flights.begin(records)
    room = np.full(flights.n, OVER)
    for _ in range(steps):
        flights.fly(act(flights.see()))
        room = np.minimum(room, flights.room())
    return room


def before_closest(
    flights: Flights, act: Act, records: NDArray[Any], lead: int, watch: Watch = lambda *_: None
) -> tuple[Floats, Floats]:
    """Fly a policy from ``records`` to the finish, or until it crashes.

    Returns the least room (n,), m, and where each drone was ``lead`` steps before that, or at its start if that was
    later: (n, record size + 1). The slowest flights are cut short.
    """
    flights.begin(records)
    room, found = np.full(flights.n, OVER), records.astype(np.float64)
    over = np.zeros(flights.n, np.bool_)
    passed = deque([(flights.fleet.state.copy(), flights.fleet.target.copy())], lead + 1)
    step, last = 0, flights.rules.horizon_steps
    while step < last and over.mean() < 0.99:
        observation = flights.see()
        watch(observation, ~over)
        flights.fly(act(observation))
        step += 1
        now = flights.room()
        closer = (now < room) & ~over
        room[closer] = now[closer]
        passed.append((flights.fleet.state.copy(), flights.fleet.target.copy()))
        state, target = passed[0]
        found[closer, :STATE_SIZE], found[closer, -1] = state[:, closer].T, target[closer]
        over |= (now < 0.0) | flights.finished
        if flights.finished.mean() >= 0.5:
            last = min(last, round(SLOW * step))
    return room, found


def close_places(
    flights: Flights,
    act: Act,
    starts: NDArray[Any],
    steps: int,
    enough: float,
    hopeless: float = HOPELESS,
    watch: Watch = lambda *_: None,
) -> tuple[Floats, Floats, Floats]:
    """Fly a policy from ``starts``, and find the places from which it has less than ``enough`` room, but is not lost.

    Returns the least room (n,) of all flights, m, the places (k, record size + 1), from which flights of so many
    ``steps`` lead past where they come closest, and the least room (k,) of these. A flight is lost that gets deeper
    than ``hopeless``, m.
    """
    room, places = before_closest(flights, act, starts, max(steps - AFTER, 0), watch)
    places = places[room < enough]
    left = least_room(flights.others(len(places)), act, places, steps)
    kept = (left < enough) & (left > -hopeless)
    return room, places[kept], left[kept]


def close_starts(
    flights: Flights, act: Act, starts: NDArray[Any], steps: int, enough: float, hopeless: float
) -> tuple[NDArray[Any], Floats]:
    """Fly so many ``steps`` from ``starts``, and find those that are dangerous themselves, but not lost.

    These have little room at once, and less than ``enough`` in one of the steps: (k, record size + 1). Returns the
    least room (k,) of each, m, too. Lost is who gets deeper than ``hopeless``, m.
    """
    everywhere = flights.others(len(starts))
    everywhere.begin(starts)
    starts = starts[everywhere.clearance() < FREE]
    room = least_room(flights.others(len(starts)), act, starts, steps)
    kept = (room < enough) & (room > -hopeless)
    return starts[kept], room[kept]
