"""Suites: what a policy is evaluated on.

Initial conditions depend on the suite's maps and the episode's number alone: every method meets the same ones,
disturbed or not (common random numbers), and no training draws them.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from srlrace.config import Config, ConfigError, LevelConfig
from srlrace.evaluation.disturbance import DisturbedRace, periods
from srlrace.runs import RunError
from srlrace.schema import EVALUATION_SEED, VALIDATION_SEED, DisturbanceConfig
from srlrace.suites import NOMINAL, OWN_MAPS, disturbance_of, maps_of
from srlrace.task.certificate import certified_field, unseen_maps
from srlrace.task.race import Race, RaceMode
from srlrace.world.field import ObstacleField
from srlrace.world.levels import FIRST_UNSEEN_SEED

UNSEEN_MAPS = 100  # per level


@dataclass(frozen=True)
class Suite:
    """What a policy is evaluated on: a configuration to fly in, the seeds of its maps, and what is disturbed.

    ``seed`` is that of the starts and the displaced waypoints.
    """

    name: str
    config: Config
    map_seeds: tuple[int, ...]
    field: ObstacleField
    disturbance: DisturbanceConfig = NOMINAL
    seed: int = EVALUATION_SEED

    def race(self, episodes: NDArray[np.int64]) -> Race:
        """Return a race of these episodes, a drone each, not reset yet."""
        mode = RaceMode.evaluation(self.seed, episodes)
        if self.disturbance == NOMINAL:
            return Race(self.config, mode, self.field)
        return DisturbedRace(self.config, mode, self.field, self.disturbance)


def preset_level(name: str) -> LevelConfig:
    """Return the obstacle level that ``level=NAME`` means."""
    from srlrace.hydra_bridge import compose

    return compose([f"level={name}"]).level


def make_suite(config: Config, name: str) -> Suite:
    """Build a suite for a run's configuration: its own maps, or certified ones that no training has seen.

    Initial conditions are those of ``randomization=init`` whatever the training drew. Raises `RunError` for a suite
    that there is not, or that this run cannot fly.
    """
    from srlrace.hydra_bridge import compose

    try:
        disturbance = disturbance_of(name)
        periods(disturbance.delay, config.sim.control_period)
    except (ConfigError, ValueError) as error:
        raise RunError(str(error)) from None
    maps = maps_of(name)
    level = preset_level(maps.removeprefix("level")) if maps.startswith("level") else config.level
    flown = dataclasses.replace(config, level=level, randomization=compose(["randomization=init"]).randomization)
    seeds = _train_seeds(config) if maps in OWN_MAPS else _unseen_seeds(flown, name)
    field = certified_field(flown, [seed - level.map_seed for seed in seeds])
    starts = VALIDATION_SEED if maps == "validation" else EVALUATION_SEED
    return Suite(name, flown, seeds, field, disturbance, starts)


def _train_seeds(config: Config) -> tuple[int, ...]:
    """The seeds of a training's maps; of one with fresh maps, those offered in its last rollout."""
    level, algo = config.level, config.algo
    rollout = algo.n_envs * algo.n_steps
    last = (math.ceil(algo.total_steps / rollout) - 1) * rollout  # steps when it began
    first = last // level.fresh_steps if level.fresh_steps else 0
    return tuple(level.map_seed + number % FIRST_UNSEEN_SEED for number in range(first, first + level.maps))


def _unseen_seeds(config: Config, suite: str) -> tuple[int, ...]:
    if not config.level.spacings:
        raise RunError(f"suite {suite}: level {config.level.name} draws no maps, so that there are no unseen ones")
    return unseen_maps(config, UNSEEN_MAPS)
