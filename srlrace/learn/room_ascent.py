"""Steps of a policy towards more room on the way from hard starts, between those of PPO.

Where a start is nearly lost, most actions are at their limit, noise changes little, and what it changes saves nobody:
PPO has nothing to learn from there. The gradient of the room that is left has (`srlrace.learn.room_gradient`;
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
from srlrace.learn.room_gradient import Flights, RoomGradient, least_room
from srlrace.task.race import Race, RaceMode
from srlrace.task.reset import records

# All ours.
FLIGHTS = 128  # whose gradient makes a step
NEARLY = 0.05  # m: starts with up to so much more room than is wanted are flown, too
HOPELESS = 0.25  # m: those that end deeper than this in something are not
COUNTED = 0.2  # m: nor do they count
LOOK_EVERY = 50  # steps from one look at all starts to the next
FINAL_RATE = 0.1  # of the step size at first, at the end
MAX_NORM = 0.2  # of a gradient; longer ones are made so short


class RoomAscent:
    """Adam's steps along the room gradient, every ``curriculum.room_every`` rollouts of a training.

    ``hard`` (k,) are the starts that are flown now, as indices into all that are known.
    """

    def __init__(self, race: Race, policy: ActorCriticPolicy, escapes: Escapes | None) -> None:
        curriculum, algo = race.config.curriculum, race.config.algo
        self._curriculum, self._seed, self._total = curriculum, race.config.seed, algo.total_steps
        self._rollout = algo.n_envs * algo.n_steps
        self._policy = policy
        self._starts = drawn_starts(race)
        if escapes is not None:
            self._starts = np.vstack([escapes.start, self._starts])
        self._flown = max(round(curriculum.room_time / race.config.sim.control_period), 1)
        self._all = Flights(race, len(self._starts))
        self._gradient = RoomGradient(race, policy, FLIGHTS, self._flown)
        self._parameters = [*policy.mlp_extractor.policy_net.parameters(), *policy.action_net.parameters()]
        self.optimizer = torch.optim.Adam(self._parameters, lr=curriculum.room_rate)
        self.hard = np.zeros(0, np.int64)

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
        """Find the starts from which the policy has little room, but is not lost."""
        room = least_room(self._all, self._policy, self._starts, self._flown)
        self.hard = np.flatnonzero((room < self._curriculum.room_wanted + NEARLY) & (room > -HOPELESS))

    def _step(self, rate: float, rng: np.random.Generator) -> None:
        chosen = rng.choice(self.hard, FLIGHTS, replace=len(self.hard) < FLIGHTS)
        self.optimizer.zero_grad()
        self._gradient(self._starts[chosen], self._curriculum.room_wanted, -COUNTED)
        torch.nn.utils.clip_grad_norm_(self._parameters, MAX_NORM)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        self.optimizer.zero_grad()

    def restore_hard(self, hard: NDArray[Any]) -> None:
        """Take over the starts that are flown from a checkpoint; `ValueError` where they cannot be."""
        if hard.dtype != np.int64 or hard.ndim != 1 or not ((hard >= 0) & (hard < len(self._starts))).all():
            raise ValueError("hard starts are not some of those that are known")
        self.hard = hard


def drawn_starts(race: Race) -> NDArray[Any]:
    """Draw starts of a training (``curriculum.room_starts``, record size) that none of its episodes has."""
    config = race.config
    members = config.algo.n_envs + np.arange(config.curriculum.room_starts)
    mode = RaceMode(config.seed, members, autoreset=False, curriculum=True)
    drawn = Race(config, mode, race.field)
    drawn.rules = drawn.rules._replace(
        gate_starts=0.0, memory_starts=0.0, retry_starts=0.0, hard_starts=0.0, escape_starts=0.0
    )
    drawn.reset()
    return records(drawn.fleet)
