"""Steps of a policy towards more room where its flights come close to something, between the steps of PPO.

Where a flight is nearly lost, most actions are at their limit, noise changes little, and what it changes saves nobody:
PPO has nothing to learn from there. The gradient of the room that is left has (`srlrace.learn.flight_gradient`;
docs/training.md says what it brings).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.bound.escapes import Escapes
from srlrace.learn.flight_gradient import RoomGradient
from srlrace.learn.flights import HOPELESS, NOT_LOST, Act, Flights, at_first_target, close_places, drawn_starts
from srlrace.task.race import Race

# All ours.
FLIGHTS = 128  # whose gradient makes a step
NEARLY = 0.02  # m: places with up to so much more room than is wanted are flown, too
LOOK_EVERY = 50  # steps from one look at whole flights to the next
FINAL_RATE = 0.1  # of the step size at first, at the end
MAX_NORM = 0.2  # of a gradient; longer ones are made so short


class RoomAscent:
    """Adam's steps along the room gradient, every ``curriculum.room_every`` rollouts of a training.

    ``hard`` (k, record size + 1) are the places that are flown from now: on each, not long before a flight comes close.
    """

    def __init__(self, race: Race, policy: ActorCriticPolicy, act: Act, escapes: Escapes | None) -> None:
        """``act`` are the mean actions of the ``policy``, fast; ``escapes`` hold further starts."""
        curriculum, algo = race.config.curriculum, race.config.algo
        self._curriculum, self._seed, self._total = curriculum, race.config.seed, algo.total_steps
        self._rollout = algo.n_envs * algo.n_steps
        self._race, self._act = race, act
        starts = drawn_starts(race, curriculum.room_starts)
        if escapes is not None:
            starts = np.vstack([escapes.start, starts])
        self._starts = at_first_target(starts)
        self._ahead = max(round(curriculum.room_time / race.config.sim.control_period), 1)
        self._all = Flights(race, len(self._starts))
        self._gradient = RoomGradient(race, policy, FLIGHTS, self._ahead)
        self._parameters = [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]
        self.optimizer = torch.optim.Adam(self._parameters, lr=curriculum.room_rate)
        self.hard = np.zeros((0, self._starts.shape[1]))

    def begin_rollout(self, steps: int) -> None:
        """Take a step if one is due when so many of the training's ``steps`` are done."""
        begin, end = self._curriculum.room_begin, self._curriculum.room_end
        age = steps // self._rollout - math.ceil(begin * self._total / self._rollout)  # rollouts since the first
        done = steps / self._total
        if age < 0 or done >= end or age % self._curriculum.room_every:
            return
        if age % (self._curriculum.room_every * LOOK_EVERY) == 0:
            self._look()
        if len(self.hard):
            rate = self._curriculum.room_rate * FINAL_RATE ** ((done - begin) / (end - begin))
            self._step(rate, np.random.default_rng([self._seed, steps]))

    def _look(self) -> None:
        """Find the places from which the policy has little room, but is not lost."""
        enough = self._curriculum.room_wanted + NEARLY
        _, self.hard, _ = close_places(self._all, self._act, self._starts, self._ahead, enough)

    def _step(self, rate: float, rng: np.random.Generator) -> None:
        chosen = rng.choice(len(self.hard), FLIGHTS, replace=len(self.hard) < FLIGHTS)
        self.optimizer.zero_grad()
        self._gradient(self.hard[chosen], self._curriculum.room_wanted, -NOT_LOST * HOPELESS)
        torch.nn.utils.clip_grad_norm_(self._parameters, MAX_NORM)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        self.optimizer.zero_grad()

    def restore_hard(self, hard: NDArray[Any]) -> None:
        """Take over the places that are flown from a checkpoint; `ValueError` where they cannot be."""
        like = self.hard
        if hard.dtype != like.dtype or hard.ndim != 2 or hard.shape[1] != like.shape[1] or not np.isfinite(hard).all():
            raise ValueError("hard places are not records of this race")
        for column, end in ((-1, len(self._race.rules.sequence)), (-2, self._race.rules.slots)):
            if not ((hard[:, column] >= 0) & (hard[:, column] < end)).all():
                raise ValueError("hard places have a target or a map that is not one of this race")
        self.hard = hard
