"""Gradients of a policy's flights without noise with respect to its parameters, through the simulator.

They go back through a flight step by step: through simulator and observation by differences of a single step, through
the network by autograd. Two quantities are differentiated: the room that flights leave (`srlrace.learn.flights`), and
the time that they take. Xu et al., "Accelerated Policy Learning with Parallel Differentiable Simulation" (ICLR 2022)
learn whole tasks so, from a simulator that is differentiable itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.learn.flights import Flights, Floats
from srlrace.learn.policy import mean_action
from srlrace.task.race import ACTION_SIZE, STATE_SIZE, Race

SEEN = 13  # values of the state, the first ones, that an observation depends on: all but the rotors' thrusts
BLOCKS = 1 + STATE_SIZE + ACTION_SIZE  # a flight as it is, and with each value of its state and action moved a little
STATE_DIFFERENCE, ACTION_DIFFERENCE = 1e-4, 1e-4  # for the simulator, in the units of states and actions
SEEN_DIFFERENCE = 1e-3  # for the observation, which is float32
# Share of the gradient that is let through where an action is at its limit, and a larger one would change nothing:
# without any, an action that is far beyond it would never come back. Ours.
LEAK = 0.1
SLOWEST = 1.0  # m/s; who comes to the finish more slowly counts as if it were so fast


class Passage(NamedTuple):
    """One step of all flights, and its derivatives."""

    observation: torch.Tensor  # (n, d)
    action: torch.Tensor  # (n, 4), with the graph that leads back to the observation and the policy
    seen: Floats  # (n, SEEN, d): of the observation by the state
    by_state: Floats  # (n, 17, 17): of value j of the next state by value i, at [:, i, j]
    by_action: Floats  # (n, 4, 17): and by the actions


class FlightGradient:
    """n flights of a policy that are flown forwards with their derivatives, and gone back through."""

    def __init__(self, race: Race, policy: ActorCriticPolicy, n: int, steps: int, ease: float | None = None) -> None:
        """Prepare ``n`` flights of so many ``steps`` in the world of ``race``; ``ease`` is that of `Flights`."""
        self._policy, self.n, self._steps = policy, n, steps
        self._flights = Flights(race, n * BLOCKS, ease)

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

    def _go_back(self, passage: Passage, pull: Floats) -> Floats:
        """Add to the policy's gradient, and return the gradient (n, 17) with respect to the state before a step."""
        through = np.where(np.abs(passage.action.detach().numpy()) > 1.0, LEAK, 1.0)
        push = through * np.einsum("nij,nj->ni", passage.by_action, pull)
        passage.action.backward(torch.from_numpy(push.astype(np.float32)))
        before = np.einsum("nij,nj->ni", passage.by_state, pull)
        before[:, :SEEN] += np.einsum("nid,nd->ni", passage.seen, cast(torch.Tensor, passage.observation.grad).numpy())
        return before

    def _go_back_from(self, passages: list[Passage], step: NDArray[np.int64], gain: Floats) -> None:
        """Add the gradient of a mean over flights that falls by ``gain`` (n, 3) with the places after ``step`` (n,).

        A flight whose step is less than 0 does not count.
        """
        pull = np.zeros((self.n, STATE_SIZE))  # the gradient with respect to the state after a step
        for k in range(len(passages) - 1, -1, -1):
            here = step == k
            pull[here, :3] -= gain[here] / self.n
            pull = self._go_back(passages[k], pull)


class RoomGradient(FlightGradient):
    """Adds the gradient of what flights lack in room to the ``grad`` of a policy's parameters."""

    def __init__(self, race: Race, policy: ActorCriticPolicy, n: int, steps: int, ease: float | None = None) -> None:
        super().__init__(race, policy, n, steps, ease)
        self._probes = Flights(race, n * 4)

    @torch.enable_grad()
    def __call__(self, records: NDArray[Any], wanted: float, hopeless: float) -> Floats:
        """Fly from ``records`` (n, record size + 1), and go back.

        What a flight lacks is how far its room is below ``wanted``, m; where that is less than ``hopeless``, it does
        not count. The gradient is that of the mean over all flights. Returns the room (n,) of each.
        """
        n, flights = self.n, self._flights
        flights.begin(np.tile(records, (BLOCKS, 1)))
        passages: list[Passage] = []
        places, gaps, inside, inwards = [], [], [], []
        for _ in range(self._steps):
            passages.append(self._pass())
            places.append(flights.fleet.state[:3, :n].T.copy())
            gaps.append(flights.clearance(n))
            depth, slope = flights.passing(n)
            inside.append(depth.copy())
            inwards.append(slope.copy())
        rooms, one = np.minimum(gaps, inside), np.arange(n)
        room, closest = np.min(rooms, axis=0), np.argmin(rooms, axis=0)
        counted = (room < wanted) & (room > hopeless)
        slopes = self._slopes(records, np.stack(places)[closest, one])
        at_waypoint = (np.array(inside) < np.array(gaps))[closest, one]
        slopes[at_waypoint] = np.stack(inwards)[closest, one][at_waypoint]
        self._go_back_from(passages, np.where(counted, closest, -1), slopes)
        return room

    def _slopes(self, records: NDArray[Any], place: Floats) -> Floats:
        """How the room changes (n, 3) with the place (n, 3) of each drone, whose map is in its record."""
        probes, n = self._probes, self.n
        probes.begin(np.tile(records, (4, 1)))
        state = probes.fleet.state.reshape(STATE_SIZE, 4, n)
        state[:3] = place.T[:, None]
        axes = np.arange(3)
        state[axes, 1 + axes] += STATE_DIFFERENCE
        room = probes.clearance().reshape(4, n)
        return (room[1:] - room[:1]).T / STATE_DIFFERENCE


class TimeGradient(FlightGradient):
    """Adds the gradient of the time that flights take to the finish to the ``grad`` of a policy's parameters."""

    @torch.enable_grad()
    def __call__(self, records: NDArray[Any]) -> NDArray[np.bool_]:
        """Fly from ``records`` (n, record size + 1), and go back; returns which (n,) have finished without a crash.

        These count. The gradient is that of the mean over all flights, in s. How long a flight takes changes with
        where it is at the finish, along its velocity there; that waypoints are passed and seen at whole steps is left
        out, as a drone that is ahead of another on the same way stays so.
        """
        n, flights = self.n, self._flights
        flights.begin(np.tile(records, (BLOCKS, 1)))
        passages: list[Passage] = []
        crashed, end, gain = np.zeros(n, np.bool_), np.full(n, -1), np.zeros((n, 3))
        while len(passages) < self._steps and (end < 0).any():
            passages.append(self._pass())
            crashed |= flights.clearance(n) < 0.0
            new = flights.finished[:n] & (end < 0)
            velocity = flights.velocity[:n][new]
            end[new] = len(passages) - 1
            gain[new] = velocity / np.maximum((velocity**2).sum(1, keepdims=True), SLOWEST**2)
        counted = (end >= 0) & ~crashed
        self._go_back_from(passages, np.where(counted, end, -1), gain)
        return counted
