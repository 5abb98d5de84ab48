"""What a drone at racing speed meets: thin gaps, thin obstacles, waypoints between two sampled positions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from srlrace.world.field import ObstacleField, pass_waypoint, swept_gap
from srlrace.world.obstacles import cylinder, sphere

LOW, HIGH = (-10.0, -10.0, 0.0), (10.0, 10.0, 6.0)
D_SAFE_GAP = 0.27  # m from a surface: arm and margin


def chord_gap(obstacles, start, end, width=np.float32):
    field = ObstacleField.of_maps([tuple(obstacles)], LOW, HIGH, 10, 10.0, width)
    return swept_gap(*np.array(start, width), *np.array(end, width), 0, *field.arrays)


@pytest.mark.parametrize("step", [0.5, 1.2])  # m in 20 ms: 25 and 60 m/s
@pytest.mark.parametrize("shift", np.linspace(0, 1, 7))
def test_thin_gap_is_flown_and_a_thinner_one_is_not(step: float, shift: float) -> None:
    """Two trees of 0.3 m: the gap to either is half of what is between them, wherever the samples fall."""
    for between, passes in ((2 * D_SAFE_GAP + 0.02, True), (2 * D_SAFE_GAP - 0.02, False)):
        offset = 0.3 + between / 2
        # at the height of a layer of spheres, where the gap is the thinnest
        trees = [cylinder((0.0, side * offset, 3.0), 0.3, 6.0) for side in (-1, 1)]
        height = trees[0].spheres()[20, 2]
        gap = chord_gap(trees, (-step * shift, 0.0, height), (step * (1 - shift), 0.0, height))
        assert (gap > D_SAFE_GAP) == passes
        assert gap == pytest.approx(between / 2, abs=1e-5)


@pytest.mark.parametrize("step", [0.5, 1.2])
@pytest.mark.parametrize("shift", np.linspace(0.1, 0.9, 5))
def test_obstacle_thinner_than_the_step_is_hit(step: float, shift: float) -> None:
    """A wire of 2 cm across the way: both ends of the step are far from it."""
    wire = [cylinder((0.0, 0.0, 3.0), 0.01, 6.0)]
    start, end = (-step * shift, 0.0, 2.0), (step * (1 - shift), 0.0, 2.0)
    assert min(abs(start[0]), abs(end[0])) > 0.04
    assert chord_gap(wire, start, end) <= -0.007  # through the axis, between two layers 5 mm apart


def test_swept_gap_does_not_exceed_the_gaps_of_its_samples() -> None:
    rng = np.random.default_rng(0)
    field = ObstacleField.of_maps(
        [tuple(sphere(tuple(rng.uniform(LOW, HIGH)), 0.3) for _ in range(80))], LOW, HIGH, 10, 10.0, np.float64
    )
    for _ in range(200):
        start = rng.uniform(LOW, HIGH)
        end = np.clip(start + rng.normal(0, 1.0, 3), LOW, HIGH)
        samples = start + np.linspace(0, 1, 400)[:, None] * (end - start)
        sampled = field.gaps(samples).min()
        gap = swept_gap(*start, *end, 0, *field.arrays)
        assert sampled - np.linalg.norm(end - start) / 799 - 1e-9 <= gap <= sampled + 1e-9


@pytest.mark.parametrize("width", [np.float32, np.float64])
def test_waypoint_between_two_samples_is_passed(width) -> None:
    """25 m/s, 0.5 m a step, 0.29 m off the centre: both ends are outside of the ball."""
    start, end = np.array([-0.25, 0.29, 1.0], width), np.array([0.25, 0.29, 1.0], width)
    centre = np.array([0, 0, 1], width)
    assert min(np.linalg.norm(start - centre), np.linalg.norm(end - centre)) > 0.3
    share = pass_waypoint(*start, *end, *centre, width(0.3))
    assert share == pytest.approx((0.25 - np.sqrt(0.3**2 - 0.29**2)) / 0.5, abs=1e-5)
    assert pass_waypoint(*start, *end, *centre, width(0.28)) == -1


coordinate = st.floats(-3, 3)
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)


@given(start=point, end=point, centre=point, radius=st.floats(0.05, 2))
def test_waypoint_passing_agrees_with_geometry(start, end, centre, radius) -> None:
    share = pass_waypoint(*start, *end, *centre, radius)
    u = end - start
    t = np.clip((centre - start) @ u / max(u @ u, 1e-300), 0, 1)
    closest = np.linalg.norm(start + t * u - centre)
    if closest < radius - 1e-6:
        assert 0 <= share <= 1
        entry = np.linalg.norm(start + share * u - centre)
        if np.linalg.norm(start - centre) <= radius:
            assert share == pytest.approx(0, abs=1e-12)  # on the sphere itself, rounding decides
        else:
            assert entry == pytest.approx(radius, abs=1e-5)
            assert (centre - start - share * u) @ u >= -1e-6  # on the way in
    elif closest > radius + 1e-6:
        assert share == -1


def test_waypoint_and_broken_state() -> None:
    assert pass_waypoint(np.nan, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.3) < 0
    assert pass_waypoint(0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 5.0, 0.0, 0.0, 0.3) == -1
