"""Writes the certificates that ship: of every map that the presets train on or are evaluated on.

Run it (``make certificates``) after a change of presets, simulator or pilot; it takes some minutes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator

from srlrace.config import Config
from srlrace.console import setup_logging
from srlrace.evaluation.suites import UNSEEN_MAPS
from srlrace.files import atomic_write
from srlrace.hydra_bridge import compose
from srlrace.task.certificate import BATCH, SHIPPED, Map, certificate_key, fly_paths
from srlrace.world.levels import FIRST_UNSEEN_SEED, generate_map

TRACKS = ("split_s", "split_s_cpc")  # with the obstacles of their presets, and without any
LEVELS = ("1", "2", "3")
TRAINING_MAPS = 1000  # of level=mixed: as many as the experiments train on, of which the preset's hundred are the first
logger = logging.getLogger("srlrace.evaluation")


def preset_maps() -> Iterator[tuple[Config, list[Map]]]:
    """Yield the maps of each preset, as many of the unseen ones as give `UNSEEN_MAPS` flyable ones and some more."""
    mixed = ["env=forest", "level=mixed", f"level.maps={TRAINING_MAPS}"]
    for overrides in (mixed, ["env=forest", "level=none"], *([f"env={t}"] for t in TRACKS)):
        config = compose(overrides)
        yield config, [generate_map(config.env, config.level, i) for i in range(config.level.maps)]
    config = compose(["env=split_s", "level=none"])
    yield config, [generate_map(config.env, config.level, 0)]
    for level in LEVELS:
        config = compose(["env=forest", f"level={level}"])
        first = FIRST_UNSEEN_SEED - config.level.map_seed
        unseen = range(first, first + -(-UNSEEN_MAPS // BATCH) * BATCH)
        yield config, [generate_map(config.env, config.level, i) for i in (*range(5), *unseen)]


def main() -> None:
    """Fly all of them and replace the file."""
    setup_logging()
    known: dict[str, float | None] = {}
    for config, maps in preset_maps():
        times = fly_paths(config, maps)
        flown = [time for time in times if time is not None]
        logger.info(
            "%s, level %s: %d of %d maps, %.1f to %.1f s",
            config.env.name, config.level.name, len(flown), len(maps), min(flown), max(flown),
        )  # fmt: skip
        keys = (certificate_key(config, drawn) for drawn in maps)
        known |= {key: None if time is None else round(time, 3) for key, time in zip(keys, times, strict=True)}
    atomic_write(SHIPPED, json.dumps(known, indent=0, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
