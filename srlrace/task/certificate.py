"""Certificates that maps are flyable: a flight through each, in this simulator, under the rules of the race.

A pilot with full knowledge follows the map's clear path. Where it passes all waypoints in time and touches nothing, the
map is feasible for this airframe, and the time of that flight is its certificate. The reverse does not hold: a faster
or bolder pilot may fly a map that this one cannot.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from srlrace.config import Config, RandomizationConfig, to_dict
from srlrace.files import read_json
from srlrace.task.arrays import FINISHED, FLYING
from srlrace.task.pilot import PACES, Pilot, plan
from srlrace.world.field import ObstacleField
from srlrace.world.flyable import Array, clear_path
from srlrace.world.levels import FIRST_UNSEEN_SEED, generate_map
from srlrace.world.obstacles import Obstacle

SHIPPED = Path(__file__).parent / "certificates.json"
DRAWS = 50  # attempts at a training map, and draws per wanted unseen map, before giving up
DIGITS = 6  # of a coordinate in the key, m: the last bits of a cosine differ between machines
BATCH = 32  # unseen maps examined at once
HORIZON = 20.0  # s, given to every flight whatever an episode is given: ours, that of the presets

Map = tuple[Obstacle, ...]


def certify(config: Config, maps: Sequence[Map]) -> list[float | None]:
    """Return the time of a flight through each map, s, or None where none was found.

    The certificates of the maps that come with the presets are on file; others are flown now, about 0.3 s each.
    """
    known = {**_shipped(), **_session}
    keys = [certificate_key(config, drawn) for drawn in maps]
    missing = {key: drawn for key, drawn in zip(keys, maps, strict=True) if key not in known}
    if missing:
        _session.update(zip(missing, fly_paths(config, list(missing.values())), strict=True))
    return [{**known, **_session}[key] for key in keys]


_session: dict[str, float | None] = {}  # flown since the program started


@cache
def _shipped() -> dict[str, float | None]:
    return {str(key): None if time is None else float(time) for key, time in read_json(SHIPPED).items()}


def certificate_key(config: Config, drawn: Map) -> str:
    """Return a hash of all that a flight depends on: track, map, margin, quadrotor and time stepping."""
    solids = [[round(x, DIGITS) for x in (*o.origin, *o.pitch, o.sphere_radius)] + [*o.count] for o in drawn]
    parts = [to_dict(part) for part in (config.env, config.quad, config.sim)]
    for part in parts:
        part.pop("name", None)
        part.pop("horizon", None)
    text = json.dumps([*parts, config.level.safety_margin, sorted(solids)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fly_paths(config: Config, maps: Sequence[Map]) -> list[float | None]:
    """Fly the clear path of each map, slower where a faster flight failed; return the times, s, None for a failure."""
    clearance = config.keep_out
    paths = [clear_path(config.env, drawn, clearance) for drawn in maps]
    times: list[float | None] = [None] * len(maps)
    for pace in PACES:
        todo = [i for i, path in enumerate(paths) if path is not None and times[i] is None]
        if todo:
            flown = _fly(config, [maps[i] for i in todo], [paths[i] or [] for i in todo], pace)
            times = [flown.get(todo.index(i), t) if i in todo else t for i, t in enumerate(times)]
    return times


def _fly(config: Config, maps: Sequence[Map], paths: Sequence[Sequence[Array]], pace: float) -> dict[int, float]:
    """Fly all maps side by side, each from rest at the start; return the times of those that finished, s."""
    from srlrace.task.race import Race, RaceMode  # the race asks for certificates itself

    still = RandomizationConfig("none", 0.0, 0.0, 0.0)
    quiet = dataclasses.replace(config, randomization=still, env=dataclasses.replace(config.env, horizon=HORIZON))
    low, high = config.env.bounds_low, config.env.bounds_high
    field = ObstacleField.of_maps(maps, low, high, config.observation.obstacles, config.observation.range)
    race = Race(quiet, RaceMode.evaluation(0, np.arange(len(maps))), field)
    race.reset()
    race.fleet.map[:] = np.arange(len(maps))
    pilot = Pilot(config, [plan(path, pace, config.sim.control_period) for path in paths])
    times: dict[int, float] = {}
    flying = np.ones(len(maps), np.bool_)
    for step in range(race.rules.horizon_steps):
        out = race.step(pilot.act(race.fleet.state, step))
        ended = flying & (out.outcome != FLYING)
        times |= {int(i): float(out.time[i]) for i in np.nonzero(ended & (out.outcome == FINISHED))[0]}
        flying &= ~ended
        if not flying.any():
            break
    return times


def certified_field(config: Config, map_indices: Sequence[int]) -> ObstacleField:
    """Draw maps of the configuration's level, each anew until one is certified flyable, and pack them.

    The first draw of nearly every map is flyable, so that it stays what its seed alone says. Raises ValueError where
    hardly any draw is. A layout without random trees is its owner's choice, and taken as it is.
    """
    track, sight = config.env, config.observation
    maps = [generate_map(track, config.level, i) for i in map_indices]
    if config.level.spacings:
        _replace_refused(config, maps, map_indices)
    return ObstacleField.of_maps(maps, track.bounds_low, track.bounds_high, sight.obstacles, sight.range)


def _replace_refused(config: Config, maps: list[Map], map_indices: Sequence[int]) -> None:
    for attempt in range(1, DRAWS + 1):
        refused = [k for k, time in enumerate(certify(config, maps)) if time is None]
        if not refused:
            return
        for k in refused:
            maps[k] = generate_map(config.env, config.level, map_indices[k], attempt)
    raise ValueError(_hopeless(config, f"map seed {config.level.map_seed + map_indices[refused[0]]}"))


def unseen_maps(config: Config, count: int) -> tuple[int, ...]:
    """Seeds of the first `count` maps of the level that are certified flyable and that no training draws.

    Raises ValueError where hardly any draw is flyable.
    """
    level = config.level
    first = max(FIRST_UNSEEN_SEED, level.map_seed + FIRST_UNSEEN_SEED)
    seeds: list[int] = []
    for start in range(first, first + DRAWS * count, BATCH):
        batch = range(start, start + BATCH)
        times = certify(config, [generate_map(config.env, level, seed - level.map_seed) for seed in batch])
        seeds += [seed for seed, time in zip(batch, times, strict=True) if time is not None]
        if len(seeds) >= count:
            return tuple(seeds[:count])
    raise ValueError(_hopeless(config, f"only {len(seeds)} of {DRAWS * count} maps"))


def _hopeless(config: Config, what: str) -> str:
    return f"level {config.level.name} on {config.env.name}: no flight through {what} was found; make it less dense"
