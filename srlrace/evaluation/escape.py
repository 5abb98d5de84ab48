"""Search for ways out of starts that hardly any sequence of actions survives, for training to learn from.

What is alike should be done alike, or a policy cannot learn it: so ways out that serve many starts are found first, by
the cross-entropy method, and each start gets a variation of one of them.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from srlrace.bound.escapes import ACTIONS, HOLD, Escapes, load_escapes, save_escapes
from srlrace.checks import check_single_map
from srlrace.config import Config, ConfigError
from srlrace.evaluation.starts import EXTREMES, fly_plans, random_plans
from srlrace.sim.airframe import GRAVITY, Airframe
from srlrace.task.arrays import FLYING
from srlrace.task.pilot import Steering
from srlrace.task.race import Field, Race, RaceMode, make_field
from srlrace.task.reset import records

STARTS, BATCH = 1_000_000, 20_000  # starts that are looked at, and at a time
SEED = 5  # of these starts; an evaluation draws others
LASTING = 0.6  # s: who hits what stands beside the start, or the floor, has done so by then
FIRST_LOOK, LOOK = 8, 64  # random sequences of actions that are flown from a start; from a hard one none of the first
HARD = 6  # and at most so many of all of them survive
COASTING = 0.7  # s: for so long after a way out the drone must be able to brake without hitting anything
BRAKING = 2.0  # 1/s: deceleration per speed
# The cross-entropy method: rounds, sequences a round, the share that the next round is drawn around; our choice.
ROUNDS, PLANS, ELITE, SPREAD = 8, 600, 16, 0.04
REFINING_ROUNDS, REFINING_PLANS, REFINING_SPREAD = 5, 200, 0.25
SAMPLE, COMMON_ROUNDS = 16, 12  # starts whose ways out are tried on all others, and how often
ENOUGH = 0.3  # m: more room than that is worth nothing
SERVES = 0.13  # m: a way out that leaves so much room serves a start, too; the rules ask for 0.1 m
LIKENESS = 0.1  # m of room that a mean squared difference of 1 from the common way out is worth

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

logger = logging.getLogger("srlrace.escape")


def show_escapes(config: Config, again: bool) -> tuple[Table, Path]:
    """Find ways out of hard starts for training, and keep them; returns what to print, and their file."""
    check_single_map(config, "--escapes")
    found = None if again else load_escapes(config)
    if found is None:
        found = find_escapes(config)
    path = save_escapes(config, found)
    table = Table(show_header=False, box=None)
    table.add_row("track", f"{config.env.name}, level {config.level.name}")
    table.add_row("ways out", f"of {len(found.start)} hard starts")
    table.add_row("kind", "what to do at first where hardly any sequence of actions survives")
    return table, path


def find_escapes(config: Config, starts: int = STARTS, seed: int = 0) -> Escapes:
    """Look at so many random starts, and find ways out of the hard ones; those without one are left out.

    Raises `ConfigError` where no start is hard and has one.
    """
    search = _Search(config, np.random.default_rng(seed))
    logger.info("looking at %d starts, which takes some minutes where they are many", starts)
    hard = search.hard_starts(starts)
    logger.info("%d of %d starts are hard", len(hard), starts)
    plans, room = search.ways_out(hard)
    found = room > 0.0
    logger.info("ways out of %d of %d hard starts", found.sum(), len(hard))
    if not found.any():
        raise ConfigError(f"--escapes: none of {starts} starts is hard and has a way out; there is nothing to show")
    race = search.race(hard[found])
    race.reset()
    return Escapes(records(race.fleet).astype(np.float64), plans[found])


@dataclass
class _Search:
    config: Config
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.field: Field = make_field(self.config, RaceMode.evaluation(SEED, np.arange(1)))
        self.period = self.config.sim.control_period
        self.steering = Steering(Airframe(self.config.quad), self.config.quad.body_rate_max)

    def race(self, starts: Indices) -> Race:
        return Race(self.config, RaceMode.evaluation(SEED, starts), self.field)

    def hard_starts(self, count: int) -> Indices:
        """Return those of the first ``count`` starts that few random sequences of actions survive."""
        hard = [self._hard(np.arange(first, min(first + BATCH, count))) for first in range(0, count, BATCH)]
        return np.concatenate(hard)

    def _hard(self, left: Indices) -> Indices:
        steps = round(LASTING / self.period)
        survived = np.zeros(len(left), np.int64)
        for look in range(LOOK):
            survived += fly_plans(self.race(left), random_plans(self.rng, steps, len(left))) >= steps
            stay = survived <= (0 if look < FIRST_LOOK else HARD)
            left, survived = left[stay], survived[stay]
            if len(left) == 0:
                break
        return left

    def fly(self, starts: Indices, plans: Floats) -> Floats:
        """Fly ways out (n, ACTIONS, 4), then brake; return the least room (n,) from obstacles and floor, m.

        Where the drone does not survive, less than 0: the more so, the sooner it ends.
        """
        race = self.race(starts)
        race.reset()
        steps = ACTIONS * HOLD + round(COASTING / self.period)
        alive, room, lived = np.ones(len(starts), bool), np.full(len(starts), np.inf), np.zeros(len(starts))
        for step in range(steps):
            if step < ACTIONS * HOLD:
                action = np.ascontiguousarray(plans[:, step // HOLD], np.float32)
            else:
                state = race.fleet.state
                action = self.steering.act(state, np.array([0.0, 0.0, GRAVITY]) - BRAKING * state[3:6].T)
            output = race.step(action)
            alive &= output.outcome == FLYING
            lived += alive
            floor = race.fleet.state[2] - race.rules.bounds[2]
            room = np.where(alive, np.minimum(room, np.minimum(output.clearance, floor)), room)
            if not alive.any():
                break
        return np.where(alive, room, lived / steps - 1.0)

    def cross_entropy(
        self, starts: Indices, mean: Floats, deviation: float, rounds: int, count: int, common: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Improve sequences (m, ACTIONS, 4) of each start; return the best ones and their room."""
        m, spread = len(starts), np.full(mean.shape, deviation)
        best, most = mean.copy(), np.full(m, -np.inf)
        for number in range(rounds):
            plans = mean[:, None] + spread[:, None] * self.rng.normal(size=(m, count, ACTIONS, 4))
            if number == 0 and common is None:
                plans = self.rng.choice(EXTREMES, size=plans.shape)
            plans = np.clip(plans, -1.0, 1.0)
            plans[:, 0] = mean
            room = np.minimum(self.fly(np.repeat(starts, count), plans.reshape(-1, ACTIONS, 4)), ENOUGH)
            score = room.reshape(m, count)
            if common is not None:
                score = score - LIKENESS * ((plans - common[:, None]) ** 2).mean((2, 3))
            order = np.argsort(-score, axis=1)[:, : max(count // ELITE, 8)]
            elite = np.take_along_axis(plans, order[:, :, None, None], 1)
            mean, spread = elite.mean(1), elite.std(1) + SPREAD
            better = score.max(1) > most
            best[better], most[better] = elite[better, 0], score.max(1)[better]
        return best, self.fly(starts, best)

    def ways_out(self, starts: Indices) -> tuple[Floats, Floats]:
        """Return a sequence (m, ACTIONS, 4) for each start, and the room that it leaves, m; less than 0 for none."""
        common = np.zeros((len(starts), ACTIONS, 4))
        left = np.arange(len(starts))
        for _ in range(COMMON_ROUNDS):
            if len(left) == 0:
                break
            sample = self.rng.choice(left, min(SAMPLE, len(left)), replace=False)
            found, _ = self.cross_entropy(starts[sample], np.zeros((len(sample), ACTIONS, 4)), 1.0, ROUNDS, PLANS)
            room = np.stack([self.fly(starts[left], np.repeat(way[None], len(left), 0)) for way in found])
            serves = room >= SERVES  # (sample, left)
            while (counts := serves.sum(1)).max() >= 2:
                widest = counts.argmax()
                served = serves[widest]
                common[left[served]] = found[widest]
                left, serves = left[~served], serves[:, ~served]
        logger.info("%d starts are served by no other's way out", len(left))
        if len(left):
            common[left], _ = self.cross_entropy(starts[left], common[left], 1.0, ROUNDS, PLANS)
        best, room = common.copy(), np.empty(len(starts))
        for first in range(0, len(starts), BATCH // REFINING_PLANS):
            part = slice(first, first + BATCH // REFINING_PLANS)
            best[part], room[part] = self.cross_entropy(
                starts[part], common[part], REFINING_SPREAD, REFINING_ROUNDS, REFINING_PLANS, common[part]
            )
        return best, room
