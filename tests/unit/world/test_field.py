"""Nearest obstacles, swept gaps and rays against the enumeration of every sphere, in both float widths."""

import numpy as np
import pytest

from srlrace.world.field import ObstacleField, cast_rays, nearest, nearest_centre, ray_directions, swept_gap
from srlrace.world.obstacles import box, cylinder, sphere
from srlrace.world.queries import FAR

N, REACH = 10, 10.0
LOW, HIGH = (-12.0, -14.0, 0.0), (17.0, 14.0, 8.0)
WORLDS = ["level 1", "level 2", "level 3", "split_s", "1000 spheres", "sparse", "mixed kinds"]
TOLERANCE = {np.float32: 2e-5, np.float64: 1e-9}  # m; float32 at 30 m resolves 2e-6 m


def random_spheres(rng, count):
    return tuple(sphere(tuple(rng.uniform(LOW, HIGH)), rng.uniform(0.05, 0.6)) for _ in range(count))


def random_kinds(rng, count):
    shapes = [
        lambda c: sphere(c, rng.uniform(0.1, 2.0)),
        lambda c: cylinder(c, rng.uniform(0.1, 0.8), rng.uniform(0.2, 8.0)),
        lambda c: box(c, rng.uniform(0.1, 3.0)),
    ]
    return tuple(shapes[rng.integers(3)](tuple(rng.uniform(LOW, HIGH))) for _ in range(count))


@pytest.fixture(scope="module", params=[np.float32, np.float64], ids=["float32", "float64"])
def width(request):
    return request.param


@pytest.fixture(scope="module", params=WORLDS)
def world(request, width, forest, split_s, level, enumeration):
    """(field, one enumeration per map, low, high)."""
    name, rng = request.param, np.random.default_rng(WORLDS.index(request.param))
    if name.startswith("level"):
        field = ObstacleField.build(forest, level(name[-1]), 3, N, REACH, width)
        low, high = forest.bounds_low, forest.bounds_high
    elif name == "split_s":
        field, low, high = ObstacleField.build(split_s, level("split_s"), 1, N, REACH, width), LOW, HIGH
    else:
        maps = {
            "1000 spheres": lambda: [random_spheres(rng, 1000)],
            "sparse": lambda: [random_spheres(rng, 3), random_spheres(rng, 1), random_spheres(rng, 12)],
            "mixed kinds": lambda: [random_kinds(rng, 60), random_kinds(rng, 25)],
        }[name]()
        field, low, high = ObstacleField.of_maps(maps, LOW, HIGH, N, REACH, width), LOW, HIGH
    # the truth is that of the packed field: positions rounded to its width
    return field, [enumeration(field.obstacles(m)) for m in range(field.maps)], np.array(low), np.array(high)


def draw_points(rng, truth, low, high, count):
    """Points inside, on cell borders and corners, close to spheres, and up to 1.9 m outside of the world."""
    inside = rng.uniform(low, high, (count, 3))
    border = np.round(rng.uniform(low, high, (count, 3)))
    border[::2] += rng.uniform(0, 1, border[::2].shape) * [0, 1, 1]
    touching = truth.spheres[rng.integers(0, len(truth.spheres), count)] + rng.normal(0, 0.3, (count, 3))
    outside = rng.uniform(low - 1.9, high + 1.9, (count, 3))
    return np.clip(np.concatenate([inside, border, touching, outside]), low - 1.9, high + 1.9)


def ask_nearest(field, point, map_index, reach=REACH, n=N):
    kind = field.lattices.dtype.type
    distance, index = np.empty(n, kind), np.empty(n, np.int32)
    count, gap = nearest(*point.astype(kind), map_index, *field.arrays, kind(reach), distance, index)
    return distance, index, count, gap


def test_nearest_matches_enumeration(world, width) -> None:
    field, truths, low, high = world
    rng, tolerance = np.random.default_rng(1), TOLERANCE[width]
    for map_index, truth in enumerate(truths):
        for point in draw_points(rng, truth, low, high, 50).astype(width):
            distance, index, count, gap = ask_nearest(field, point, map_index)
            expected = truth.distances(point.astype(float))
            wanted = np.full(N, REACH)
            closest = np.sort(expected[expected < REACH])[:N]
            wanted[: len(closest)] = closest
            assert distance == pytest.approx(wanted, abs=tolerance)
            assert abs(count - len(closest)) <= (np.abs(expected - REACH) < tolerance).sum()
            assert (index[count:] == -1).all()
            assert len(set(index[:count])) == count
            own = index[:count] - field.first[map_index]
            assert expected[own] == pytest.approx(distance[:count], abs=tolerance)
            assert gap == pytest.approx(truth.gap(point.astype(float)), abs=tolerance)
            for i, d in zip(index[:count], distance, strict=False):
                centre = nearest_centre(i, *point, field.lattices)
                assert np.linalg.norm(np.array(centre, float) - point) == pytest.approx(d, abs=tolerance)


def test_fewer_neighbours_and_shorter_reach_are_served_too(world, width) -> None:
    """A field answers any query for at most its N within at most its reach."""
    field, truths, low, high = world
    rng = np.random.default_rng(2)
    for point in rng.uniform(low, high, (30, 3)).astype(width):
        distance, _, count, gap = ask_nearest(field, point, 0, reach=3.0, n=4)
        expected = np.sort(np.append(truths[0].distances(point.astype(float)), [3.0] * 4).clip(max=3.0))[:4]
        assert distance == pytest.approx(expected, abs=TOLERANCE[width])
        assert gap == pytest.approx(truths[0].gap(point.astype(float)), abs=TOLERANCE[width])
        assert count <= 4


@pytest.mark.parametrize("speed", [0.0, 1.0, 25.0, 60.0, 400.0])
def test_swept_gap_matches_enumeration(world, width, speed: float) -> None:
    """Chords of one 20 ms step, up to 8 m long: many cells and several pieces."""
    field, truths, low, high = world
    rng = np.random.default_rng(3)
    for map_index, truth in enumerate(truths):
        for start in draw_points(rng, truth, low, high, 8).astype(width):
            way = rng.normal(size=3)
            way[2] *= rng.choice([0.0, 1.0, 10.0])
            end = start + (0.02 * speed * way / np.linalg.norm(way)).astype(width)
            end = np.clip(end, low - 1.9, high + 1.9).astype(width)
            gap = swept_gap(*start, *end, map_index, *field.arrays)
            expected = truth.swept_gap(start.astype(float), end.astype(float))
            assert gap == pytest.approx(expected, abs=TOLERANCE[width])


def test_rays_match_enumeration(world, width) -> None:
    field, truths, low, high = world
    rng, directions = np.random.default_rng(4), ray_directions(16, width)
    out = np.empty(16, width)
    free = 0
    for map_index, truth in enumerate(truths):
        for point in draw_points(rng, truth, low, high, 4).astype(width):
            cast_rays(*point, map_index, *field.arrays, width(0.37), width(REACH), width(1), width(0), directions, out)
            for (cos, sin), distance in zip(directions.T.astype(float), out, strict=True):
                aim, place = np.array([cos, sin, 0.0]), point.astype(float)
                # where a ray grazes a sphere, rounding decides: accept the answers of slightly smaller and larger ones
                low_hit, high_hit = (truth.ray(place, aim, 0.37 + e, REACH) for e in (1e-5, -1e-5))
                assert low_hit - 1e-3 <= distance <= high_hit + 1e-3
                free += distance > 0
    assert free > 100


def test_gaps_of_many_points(world, width) -> None:
    field, truths, low, high = world
    points = np.random.default_rng(5).uniform(low, high, (20, 3)).astype(width)
    expected = [truths[-1].gap(point.astype(float)) for point in points]
    assert field.gaps(points, field.maps - 1) == pytest.approx(np.array(expected), abs=TOLERANCE[width])


def test_empty_world_and_states_that_are_not_finite(width) -> None:
    empty = ObstacleField.of_maps([()], LOW, HIGH, N, REACH, width)
    distance, index, count, gap = ask_nearest(empty, np.zeros(3), 0)
    assert (count, gap) == (0, FAR)
    assert (distance == REACH).all()
    assert (index == -1).all()
    assert swept_gap(*np.zeros(3, width), *np.ones(3, width), 0, *empty.arrays) == FAR
    some = ObstacleField.of_maps([(sphere((0, 0, 1), 0.3),)], LOW, HIGH, N, REACH, width)
    for bad in (np.nan, np.inf, -np.inf, 1e30):
        point = np.array([bad, 0.0, bad])
        ask_nearest(some, point, 0)
        swept_gap(*point.astype(width), *np.zeros(3, width), 0, *some.arrays)
        rays = ray_directions(4, width), np.empty(4, width)
        cast_rays(*point.astype(width), 0, *some.arrays, width(0), width(1), width(1), width(0), *rays)


def test_field_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one map"):
        ObstacleField.of_maps([], LOW, HIGH, N, REACH)


def test_seeds_name_maps(forest, level) -> None:
    chosen = ObstacleField.of_seeds(forest, level("1", map_seed=5), (9, 6), N, REACH)
    drawn = ObstacleField.build(forest, level("1"), 10, N, REACH)
    assert [chosen.obstacles(0), chosen.obstacles(1)] == [drawn.obstacles(9), drawn.obstacles(6)]
