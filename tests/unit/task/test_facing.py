"""Observations in axes that face the next waypoint: turning the world turns nothing that is seen."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from srlrace.config import ObstacleConfig
from srlrace.world.field import ray_directions

N = 40
HALF = 30.0  # m, half the edge of a world that holds the track however it is turned
GRAZING = 0.01  # share of rays that may be off: where one touches an inflated tree, rounding decides
REACH = 10.0  # m


def turned_settings(config, observation, angle):
    """A round track among trees, all of it turned about the vertical by an angle, with this observation."""
    settings, turn = config("level=none", "randomization=none", observation), Rotation.from_euler("z", angle)
    rng = np.random.default_rng(5)
    waypoints = np.column_stack([rng.uniform(-14, 14, (9, 2)), rng.uniform(1, 6, 9)])
    trees = np.column_stack([rng.uniform(-20, 20, (150, 2)), np.full(150, 4.0)])
    obstacles = tuple(
        ObstacleConfig("cylinder", tuple(place), radius=0.3, height=8.0) for place in turn.apply(trees).tolist()
    )
    track = dataclasses.replace(
        settings.env,
        waypoints=tuple(map(tuple, turn.apply(waypoints).tolist())),
        bounds_low=(-HALF, -HALF, 0.0),
        bounds_high=(HALF, HALF, 8.0),
    )
    return dataclasses.replace(settings, env=track, level=dataclasses.replace(settings.level, obstacles=obstacles))


def seen(flown, settings, angle):
    """What the same drones, turned with their world, see after a step."""
    race, turn = flown(settings, N), Rotation.from_euler("z", angle)
    rng = np.random.default_rng(6)
    state = race.fleet.state
    state[:3] = turn.apply(np.column_stack([rng.uniform(-14, 14, (N, 2)), rng.uniform(1, 7, N)])).T
    state[3:6] = turn.apply(rng.uniform(-8, 8, (N, 3))).T
    state[6:10] = (turn * Rotation.random(N, rng=rng)).as_quat(scalar_first=True).T
    state[10:13] = rng.uniform(-6, 6, (3, N))
    race.fleet.target[:] = rng.integers(0, 9, N)
    out = race.step(rng.uniform(-1, 1, (N, 4)).astype(np.float32))
    return race, np.where((out.outcome > 0)[:, None], out.terminal_observation, out.observation)


@pytest.mark.parametrize("angle", [0.7, 2.5, -1.9])
def test_turning_the_world_changes_nothing_that_is_seen(config, flown, angle):
    (_, here), (_, there) = (seen(flown, turned_settings(config, "observation=facing", a), a) for a in (0.0, angle))
    own, rays = np.r_[0:21, 69], slice(21, 69)
    np.testing.assert_allclose(there[:, own], here[:, own], atol=5e-5)
    assert (np.abs(there[:, rays] - here[:, rays]) > 1e-3).mean() < GRAZING
    assert np.ptp(here[:, rays]) > 0.5  # trees near and far


def test_in_the_worlds_axes_turning_shows(config, flown):
    (_, here), (_, there) = (seen(flown, turned_settings(config, "observation=rays", a), a) for a in (0.0, 2.5))
    for block in (slice(0, 3), slice(3, 12), slice(12, 15), slice(18, 24), slice(24, 56)):
        assert np.abs(there[:, block] - here[:, block]).max() > 0.1


def test_obstacle_vectors_turn_too(config, flown):
    def of(angle):
        settings = turned_settings(config, "observation=relative", angle)
        facing = dataclasses.replace(settings.observation, frame="target")
        return seen(flown, dataclasses.replace(settings, observation=facing), angle)[1][:, 24:]

    np.testing.assert_allclose(of(2.5), of(0.0), atol=5e-5)


def test_the_axes_face_the_next_waypoint(config, flown):
    """x points at it: its y is zero and its x the horizontal distance."""
    race, observation = seen(flown, turned_settings(config, "observation=facing", 0.4), 0.4)
    which = np.minimum(race.fleet.target, 8)
    to = race.fleet.waypoints[which, :, np.arange(N)] - race.fleet.state[:3].T
    np.testing.assert_allclose(observation[:, 15] * 5.0, np.hypot(to[:, 0], to[:, 1]), rtol=1e-4)
    np.testing.assert_allclose(observation[:, 16], 0.0, atol=1e-5)
    np.testing.assert_allclose(observation[:, 17] * 5.0, to[:, 2], atol=1e-4)


def test_above_the_waypoint_there_is_no_such_direction(config, flown, place_drones, hover):
    settings = turned_settings(config, "observation=facing", 0.0)
    race = flown(settings, 1)
    place_drones(race, np.add(settings.env.waypoints[0], (0, 0, 1.5)), target=0)
    observation = race.step(hover(1)).observation[0]
    assert np.isfinite(observation).all()
    np.testing.assert_allclose(observation[:9].reshape(3, 3), np.eye(3), atol=1e-3)  # the world's axes


def test_rays_match_the_enumeration_of_all_spheres(config, flown, spheres):
    race, observation = seen(flown, turned_settings(config, "observation=facing", 0.4), 0.4)
    truth, settings = spheres(race, 0), race.config.observation
    which = np.minimum(race.fleet.target, 8)
    to = (race.fleet.waypoints[which, :, np.arange(N)] - race.fleet.state[:3].T).astype(float)
    near, wrong = 0, 0
    for i in range(12):
        position = race.fleet.state[:3, i].astype(float)
        for k in range(48):
            share = k / 24 if k <= 24 else k / 24 - 2  # of half a turn
            angle = np.arctan2(to[i, 1], to[i, 0]) + np.pi * np.sign(share) * share**2
            distance = truth.ray(position, np.array([np.cos(angle), np.sin(angle), 0.0]), 0.25, REACH)
            near += distance < REACH
            wrong += abs(observation[i, 21 + k] - np.exp(-distance / settings.ray_scale)) > 2e-3
    assert near > 50
    assert wrong <= GRAZING * 12 * 48


@pytest.mark.parametrize("rays", [7, 48])
def test_focus_draws_rays_to_the_front(rays):
    even, focused = (ray_directions(rays, np.float64, focus) for focus in (1.0, 2.0))
    np.testing.assert_allclose(np.linalg.norm(focused, axis=0), 1)
    turns = np.arctan2(focused[1], focused[0])
    k = np.arange(rays)
    share = np.where(2 * k > rays, 2 * k / rays - 2, 2 * k / rays)
    np.testing.assert_allclose(np.cos(turns), np.cos(np.pi * share * np.abs(share)), atol=1e-12)
    np.testing.assert_allclose(np.sin(turns), np.sin(np.pi * share * np.abs(share)), atol=1e-12)
    gaps = np.diff(np.sort(turns))
    assert gaps.min() == pytest.approx(np.pi * (2 / rays) ** 2)  # beside the one straight ahead
    assert gaps.max() > 3 * gaps.min()
    np.testing.assert_array_equal(even, np.array([np.cos(2 * np.pi * k / rays), np.sin(2 * np.pi * k / rays)]))


def test_rays_end_at_the_walls_where_asked(config, flown, place_drones, hover):
    """In an empty world, 2 m from its eastern wall and 3 m from its northern one, facing along x."""
    settings = turned_settings(config, "observation=facing", 0.0)
    empty = dataclasses.replace(settings.level, obstacles=())
    track = dataclasses.replace(settings.env, waypoints=((HALF - 0.5, HALF - 3.0, 2.0),))
    seen_rays = {}
    for walls in (True, False):
        sight = dataclasses.replace(settings.observation, ray_walls=walls)
        race = flown(dataclasses.replace(settings, env=track, level=empty, observation=sight), 1)
        place_drones(race, (HALF - 2.0, HALF - 3.0, 2.0), target=0)
        seen_rays[walls] = -np.log(race.step(hover(1)).observation[0, 21:69]) * sight.ray_scale
    np.testing.assert_allclose(seen_rays[False], REACH, rtol=1e-5)
    cos, sin = ray_directions(48, np.float64, 2.0)
    with np.errstate(divide="ignore"):
        expected = np.minimum(np.where(cos > 1e-9, 2.0 / cos, REACH), np.where(sin > 1e-9, 3.0 / sin, REACH))
    np.testing.assert_allclose(seen_rays[True], np.minimum(expected, REACH), atol=5e-3)
