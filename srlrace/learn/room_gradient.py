"""The gradient of the room that a policy's flights leave, through the simulator.

Flights go without noise from given states, through whatever is in their way. The *room* of a flight is how much closer
to an obstacle or a wall the drone could have been at any step without a crash; less than 0 after one. Its gradient with
respect to the policy's parameters goes back through the flight step by step: through simulator and observation by
differences of a single step, through the network by autograd. Xu et al., "Accelerated Policy Learning with Parallel
Differentiable Simulation" (ICLR 2022) learn whole tasks so, from a simulator that is differentiable itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.learn.policy import mean_action
from srlrace.sim.compile import kernel
from srlrace.sim.dynamics import advance
from srlrace.task.race import ACTION_SIZE, STATE_SIZE, Race, RaceMode, commands
from srlrace.task.reset import put_records
from srlrace.task.step import sense, try_passing

SEEN = 13  # values of the state, the first ones, that an observation depends on: all but the rotors' thrusts
BLOCKS = 1 + STATE_SIZE + ACTION_SIZE  # a flight as it is, and with each value of its state and action moved a little
STATE_DIFFERENCE, ACTION_DIFFERENCE = 1e-4, 1e-4  # for the simulator, in the units of states and actions
SEEN_DIFFERENCE = 1e-3  # for the observation, which is float32
# Share of the gradient that is let through where an action is at its limit, and a larger one would change nothing:
# without any, an action that is far beyond it would never come back. Ours.
LEAK = 0.1
OVER = 1e3  # m, the room of a flight that has finished
SLOW = 1.5  # times what half of the flights take to the finish: whole flights that take longer are cut short

Floats = NDArray[np.float64]
Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # a policy: mean actions (n, 4) for observations (n, d)


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


class Flights(Race):
    """n flights without noise that no crash ends, from records of `srlrace.task.reset` that end with their target."""

    def __init__(self, race: Race, n: int) -> None:
        """Take settings and field from ``race``, and sizes as they are in evaluation."""
        mode = RaceMode.evaluation(0, np.zeros(n, np.int64))
        super().__init__(race.config, mode, race.field, dtype=np.float64)

    def begin(self, records: NDArray[Any]) -> None:
        """Put all drones where their records (n, record size + 1) say."""
        put_records(self.fleet, records[:, :-1])
        self.fleet.target[:] = records[:, -1]

    @property
    def finished(self) -> NDArray[np.bool_]:
        """Which drones (n,) have passed the last target."""
        return self.fleet.target >= len(self.rules.sequence)

    def see(self) -> NDArray[np.float32]:
        """Observations (n, d), overwritten by the next call."""
        return cast(NDArray[np.float32], self.observe(self.fleet.state))

    def room(self, first: int | None = None) -> Floats:
        """Room (n,) of all drones, or of so many first ones, where they are, m."""
        room = np.empty(self.n if first is None else first)
        measure_room(self.fleet, self.rules, self.field.arrays, self._scratch, room)
        room[self.finished[: len(room)]] = OVER
        return room

    def fly(self, action: NDArray[Any]) -> None:
        """Fly one control period with actions (n, 4), clipped."""
        rules, scratch, state = self.rules, self._scratch, self.fleet.state
        scratch.command[:] = commands(rules, np.clip(action, -1.0, 1.0)).T
        scratch.previous[:3] = state[:3]
        advance(state, scratch.command, self.fleet.plant, rules.airframe, rules.dt, rules.substeps)
        pass_targets(self.fleet, rules, scratch)


def least_room(flights: Flights, act: Act, records: NDArray[Any], steps: int) -> Floats:
    """Return the least room (n,) of a policy's flights of so many ``steps`` from ``records``, m."""
    flights.begin(records)
    room = np.full(flights.n, OVER)
    for _ in range(steps):
        flights.fly(act(flights.see()))
        room = np.minimum(room, flights.room())
    return room


def before_closest(flights: Flights, act: Act, records: NDArray[Any], lead: int) -> tuple[Floats, Floats]:
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
        flights.fly(act(flights.see()))
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


class Passage(NamedTuple):
    """One step of all flights, and its derivatives."""

    observation: torch.Tensor  # (n, d)
    action: torch.Tensor  # (n, 4), with the graph that leads back to the observation and the policy
    seen: Floats  # (n, SEEN, d): of the observation by the state
    by_state: Floats  # (n, 17, 17): of value j of the next state by value i, at [:, i, j]
    by_action: Floats  # (n, 4, 17): and by the actions


class RoomGradient:
    """Adds the gradient of what flights lack in room to the ``grad`` of a policy's parameters."""

    def __init__(self, race: Race, policy: ActorCriticPolicy, n: int, steps: int) -> None:
        """Prepare ``n`` flights of so many ``steps`` in the world of ``race``."""
        self._policy, self.n, self._steps = policy, n, steps
        self._flights, self._probes = Flights(race, n * BLOCKS), Flights(race, n * 4)

    @torch.enable_grad()
    def __call__(self, records: NDArray[Any], wanted: float, hopeless: float) -> Floats:
        """Fly from ``records`` (n, record size + 1), and go back.

        What a flight lacks is how far its room is below ``wanted``, m; where that is less than ``hopeless``, it does
        not count. The gradient is that of the mean over all flights. Returns the room (n,) of each.
        """
        n, flights = self.n, self._flights
        flights.begin(np.tile(records, (BLOCKS, 1)))
        passages: list[Passage] = []
        places, rooms = [], []
        for _ in range(self._steps):
            passages.append(self._pass())
            places.append(flights.fleet.state[:3, :n].T.copy())
            rooms.append(flights.room(n))
        room, closest = np.min(rooms, axis=0), np.argmin(rooms, axis=0)
        counted = (room < wanted) & (room > hopeless)
        slopes = self._slopes(records, np.stack(places)[closest, np.arange(n)])
        pull = np.zeros((n, STATE_SIZE))  # the gradient with respect to the state after a step
        for step in range(self._steps - 1, -1, -1):
            here = counted & (closest == step)
            pull[here, :3] -= slopes[here] / n
            pull = self._go_back(passages[step], pull)
        return room

    def _pass(self) -> Passage:
        """Fly one step, and differentiate it."""
        n, flights = self.n, self._flights
        state = flights.fleet.state.reshape(STATE_SIZE, BLOCKS, n)
        state[:] = state[:, :1]
        flights.fleet.target[:] = np.tile(flights.fleet.target[:n], BLOCKS)
        moved = np.arange(SEEN)
        state[moved, 1 + moved] += SEEN_DIFFERENCE
        seen = flights.see().reshape(BLOCKS, n, -1)[: 1 + SEEN].astype(np.float64)
        observation = torch.from_numpy(seen[0].astype(np.float32)).requires_grad_()
        action = mean_action(self._policy, observation)
        state[:] = state[:, :1]
        moved = np.arange(STATE_SIZE)
        state[moved, 1 + moved] += STATE_DIFFERENCE
        told = np.clip(action.detach().numpy().astype(np.float64), -1.0, 1.0)
        inwards = np.where(told > 0.0, -1.0, 1.0)
        actions = np.tile(told, (BLOCKS, 1, 1))
        moved = np.arange(ACTION_SIZE)
        actions[1 + STATE_SIZE + moved, :, moved] += ACTION_DIFFERENCE * inwards.T
        flights.fly(actions.reshape(-1, ACTION_SIZE))
        change = (state[:, 1:] - state[:, :1]).transpose(2, 1, 0)
        by_action = change[:, STATE_SIZE:] / ACTION_DIFFERENCE * inwards[:, :, None]
        return Passage(
            observation=observation,
            action=action,
            seen=((seen[1:] - seen[:1]) / SEEN_DIFFERENCE).transpose(1, 0, 2),
            by_state=change[:, :STATE_SIZE] / STATE_DIFFERENCE,
            by_action=by_action,
        )

    def _slopes(self, records: NDArray[Any], place: Floats) -> Floats:
        """How the room changes (n, 3) with the place (n, 3) of each drone, whose map is in its record."""
        probes, n = self._probes, self.n
        probes.begin(np.tile(records, (4, 1)))
        state = probes.fleet.state.reshape(STATE_SIZE, 4, n)
        state[:3] = place.T[:, None]
        axes = np.arange(3)
        state[axes, 1 + axes] += STATE_DIFFERENCE
        room = probes.room().reshape(4, n)
        return (room[1:] - room[:1]).T / STATE_DIFFERENCE

    def _go_back(self, passage: Passage, pull: Floats) -> Floats:
        """Add to the policy's gradient, and return the gradient (n, 17) with respect to the state before a step."""
        through = np.where(np.abs(passage.action.detach().numpy()) > 1.0, LEAK, 1.0)
        push = through * np.einsum("nij,nj->ni", passage.by_action, pull)
        passage.action.backward(torch.from_numpy(push.astype(np.float32)))
        before = np.einsum("nij,nj->ni", passage.by_state, pull)
        before[:, :SEEN] += np.einsum("nid,nd->ni", passage.seen, cast(torch.Tensor, passage.observation.grad).numpy())
        return before
