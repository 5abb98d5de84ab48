"""Statistics and purity of generated forests; layout of the fixed ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from srlrace.config import ObstacleConfig, TrackConfig
from srlrace.world.levels import generate_map

TREES_OF_MAP_0 = 110
FIRST_TREE_OF_MAP_0 = (-20.90872719710519, -17.942384033843584)  # m


def places(obstacles):
    return np.array([o.center[:2] for o in obstacles])


@pytest.mark.parametrize(("name", "low", "high"), [("1", 4.5, 5.5), ("2", 3.0, 5.0), ("3", 1.0, 3.0)])
def test_neighbours_keep_their_range(forest: TrackConfig, level, name: str, low: float, high: float) -> None:
    area = np.prod(np.subtract(forest.bounds_high, forest.bounds_low)[:2])
    nothing_to_clear = replace(forest, waypoints=((99.0, 99.0, 1.0),), start=(99.0, 99.0, 1.0))
    for index in range(20):
        trees = places(generate_map(nothing_to_clear, level(name), index))
        nearest = cKDTree(trees).query(trees, k=2)[0][:, 1]
        assert nearest.min() >= low - 1e-9
        # no saturation: the density is that of a square lattice with the middle of the range as pitch
        assert len(trees) == pytest.approx(area / ((low + high) / 2) ** 2, rel=0.15)
        inner = np.all(np.abs(trees - trees.mean(axis=0)) < [20, 10], axis=1)
        # away from the border each tree has its four lattice neighbours within the range
        assert cKDTree(trees).query(trees[inner], k=5)[0][:, 4].max() <= high + 1e-9


def test_jitter_fills_the_range(forest: TrackConfig, level) -> None:
    gaps = np.concatenate([
        cKDTree(t).query(t, k=5)[0][:, 1:].ravel()
        for t in (places(generate_map(forest, level("3"), i)) for i in range(20))
    ])  # fmt: skip
    assert gaps.min() < 1.2
    assert np.quantile(gaps[gaps < 3], 0.99) > 2.5


@pytest.mark.parametrize("name", ["1", "2", "3"])
def test_clear_zones_and_extent(forest: TrackConfig, level, name: str) -> None:
    kept = np.array([*forest.waypoints, forest.start])[:, :2]
    for index in range(20):
        obstacles = generate_map(forest, level(name), index)
        gaps = np.linalg.norm(places(obstacles)[:, None] - kept[None], axis=2)
        assert gaps.min() >= 1.0 + 0.3
        assert (places(obstacles) >= forest.bounds_low[:2]).all()
        assert (places(obstacles) <= forest.bounds_high[:2]).all()
        assert {(o.center[2], o.size[2], o.sphere_radius) for o in obstacles} == {(4.0, 8.0, 0.3)}


def test_same_arguments_same_map_other_seeds_other_maps(forest: TrackConfig, level) -> None:
    assert generate_map(forest, level("2"), 3) == generate_map(forest, level("2"), 3)
    maps = {generate_map(forest, level("2"), index) for index in range(30)}
    assert len(maps) == 30
    assert generate_map(forest, level("2", map_seed=7), 0) == generate_map(forest, level("2"), 7)


def test_training_map_never_changes(forest: TrackConfig, level) -> None:
    """Published results name the map by its seed: the draw must stay what it is."""
    trees = places(generate_map(forest, level("2"), 0))
    assert len(trees) == TREES_OF_MAP_0
    assert trees[0] == pytest.approx(FIRST_TREE_OF_MAP_0, abs=1e-9)


def test_directions_vary(forest: TrackConfig, level) -> None:
    """Rotation and offset are drawn: the first trees of many maps lie all over, not on one lattice."""
    first = np.array([places(generate_map(forest, level("1"), i)).mean(axis=0) for i in range(30)])
    assert first.std(axis=0).min() > 0.05


def test_mixed_uses_spacings_in_turn(forest: TrackConfig, level) -> None:
    counts = [len(generate_map(forest, level("mixed"), i)) for i in range(9)]
    assert max(counts[0::3]) < min(counts[1::3]) < max(counts[1::3]) < min(counts[2::3])


def test_obstacles_of_level_and_track_are_in_every_map(forest: TrackConfig, level) -> None:
    ball, cube = ObstacleConfig("sphere", (0, 0, 1), radius=0.5), ObstacleConfig("box", (3, 0, 1), edge=0.5)
    drawn = generate_map(replace(forest, obstacles=(ball,)), replace(level("1"), obstacles=(cube,)), 4)
    assert [o.kind for o in drawn[-2:]] == ["box", "sphere"]
    assert generate_map(forest, level("none"), 0) == ()


def test_split_s_layout(split_s: TrackConfig, level) -> None:
    obstacles = generate_map(split_s, level("split_s"), 0)
    assert [o.kind for o in obstacles].count("cylinder") == 6
    assert [o.kind for o in obstacles].count("box") == 3
    assert [o.kind for o in obstacles].count("sphere") == 5
    assert all(o.center[2] == o.size[2] / 2 for o in obstacles if o.kind == "cylinder")
    stops = np.array([*split_s.waypoints, split_s.start])
    assert min(np.linalg.norm(o.spheres() - w, axis=1).min() - o.sphere_radius for o in obstacles for w in stops) > 0.3
