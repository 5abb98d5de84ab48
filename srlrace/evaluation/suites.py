"""Suites: what a policy is evaluated on.

Initial conditions depend on the suite and the episode's number alone: every method meets the same
ones (common random numbers), and no training draws them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from srlrace.config import Config, LevelConfig
from srlrace.runs import RunError
from srlrace.schema import SUITES
from srlrace.task.certificate import certified_field, unseen_maps
from srlrace.world.field import ObstacleField

EVALUATION_SEED = 20_240_401  # first word of every evaluation stream; ours, arbitrary, never a training seed
UNSEEN_MAPS = 100  # per level


@dataclass(frozen=True)
class Suite:
    """What a policy is evaluated on: a configuration to fly in, and the seeds of its maps."""

    name: str
    config: Config
    map_seeds: tuple[int, ...]
    field: ObstacleField


def preset_level(name: str) -> LevelConfig:
    """Return the obstacle level that ``level=NAME`` means."""
    from srlrace.hydra_bridge import compose

    return compose([f"level={name}"]).level


def make_suite(config: Config, name: str) -> Suite:
    """Build a suite for a run's configuration: its own maps, or certified ones that no training has seen.

    Initial conditions are those of ``randomization=init`` whatever the training drew.
    """
    from srlrace.hydra_bridge import compose

    if name not in SUITES:
        raise RunError(f"suite: got {name!r}, takes one of {', '.join(SUITES)}")
    level = config.level if name == "train_map" else preset_level(name.removeprefix("level"))
    flown = dataclasses.replace(config, level=level, randomization=compose(["randomization=init"]).randomization)
    if name == "train_map":
        seeds = tuple(range(level.map_seed, level.map_seed + level.maps))
    else:
        seeds = unseen_maps(flown, UNSEEN_MAPS)
    return Suite(name, flown, seeds, certified_field(flown, [seed - level.map_seed for seed in seeds]))
