"""Obstacle levels: generated forests, drawn by pure functions of track, level and map index."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srlrace.config import LevelConfig, SpacingConfig, TrackConfig
from srlrace.world.obstacles import Obstacle, cylinder, from_config

# Keeps the draws of a map apart from every other random stream that starts from the same small seed.
MAP_STREAM = 0x7EE5
FIRST_UNSEEN_SEED = 1_000_000  # of the maps for evaluation; training draws its maps far below


def generate_map(track: TrackConfig, level: LevelConfig, map_index: int, attempt: int = 0) -> tuple[Obstacle, ...]:
    """Draw map `map_index` of a level: its trees, then the obstacles of the level and of the track.

    The map's seed is ``level.map_seed + map_index`` and its density ``level.spacings[map_index % len]``. Higher
    attempts draw it anew, for where the first cannot be flown. The same arguments give the same map on every machine.
    """
    fixed = tuple(from_config(o) for o in (*level.obstacles, *track.obstacles))
    if not level.spacings:
        return fixed
    seed = MAP_STREAM, level.map_seed + map_index
    rng = np.random.default_rng((*seed, attempt) if attempt else seed)
    spacing = level.spacings[map_index % len(level.spacings)]
    places = _keep_clear(_jittered_lattice(track, spacing, rng), track, level.clear_radius + level.tree_radius)
    floor, ceiling = track.bounds_low[2], track.bounds_high[2]
    middle, height = 0.5 * (floor + ceiling), ceiling - floor
    return tuple(cylinder((float(x), float(y), middle), level.tree_radius, height) for x, y in places) + fixed


def _jittered_lattice(track: TrackConfig, spacing: SpacingConfig, rng: np.random.Generator) -> NDArray[np.float64]:
    """Tree positions (m, 2): a square lattice, turned and shifted at random, each point moved within a disc.

    Two lattice neighbours end up between pitch - 2 jitter and pitch + 2 jitter apart. Unlike dart throwing,
    which fills up until nothing more fits at the smallest distance, the density is that of the lattice.
    """
    angle = rng.uniform(0.0, 0.5 * math.pi)
    shift = rng.uniform(-0.5, 0.5, 2)
    low, high = np.array(track.bounds_low[:2]), np.array(track.bounds_high[:2])
    half = math.ceil(float(np.linalg.norm(high - low)) / 2 / spacing.pitch) + 2
    steps = np.arange(-half, half + 1)
    lattice = (np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2) + shift) * spacing.pitch
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    places = lattice @ turn.T + 0.5 * (low + high) + _in_disc(len(lattice), spacing.jitter, rng)
    return places[np.all((places >= low) & (places <= high), axis=1)]


def _in_disc(count: int, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (count, 2) uniform in a disc."""
    angle = rng.uniform(0.0, 2 * math.pi, count)
    distance = radius * np.sqrt(rng.uniform(0.0, 1.0, count))
    return distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _keep_clear(places: NDArray[np.float64], track: TrackConfig, distance: float) -> NDArray[np.float64]:
    """Leave out places closer than `distance` m, in xy, to a waypoint or the start."""
    kept = np.array([*track.waypoints, track.start])[:, :2]
    gaps = np.linalg.norm(places[:, None, :] - kept[None, :, :], axis=2)
    return places[gaps.min(axis=1) >= distance]
