"""Every block of every observation preset against numpy, scipy's rotations and the enumeration of all spheres."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from srlrace.task.observation import (
    DISTANCE_SCALE,
    HEIGHT_SCALE,
    POSITION_SCALE,
    RATE_SCALE,
    SPEED_SCALE,
    TARGET_SCALE,
    observation_size,
)

SIZES = {"paper": 34, "relative": 64, "rays": 56, "facing": 70, "blind": 24, "song": 18}
BLOCK_SIZES = {
    "position": 3, "rotation": 9, "velocity": 3, "body_rate": 3, "targets": 6,
    "obstacle_distances": 10, "obstacle_vectors": 40, "rays": 32, "height": 1,
}  # fmt: skip
N = 24


def test_every_preset_is_listed():
    folder = Path(__file__).parents[3] / "conf" / "observation"
    assert {path.stem for path in folder.glob("*.yaml")} == SIZES.keys()


@pytest.mark.parametrize(("preset", "size"), SIZES.items())
def test_sizes(config, flown, preset, size):
    settings = config(f"observation={preset}", "level=1")
    assert observation_size(settings.observation) == size
    assert flown(settings, 2).output.observation.shape == (2, size)


@pytest.fixture(scope="module")
def moved(config, flown):
    """Drones spread over a dense forest, each in another state, seen with all blocks at once."""
    settings = config("observation=paper", "level=3", "randomization=full", "randomization.maps=2")
    every = dataclasses.replace(settings.observation, blocks=tuple(BLOCK_SIZES))
    race = flown(dataclasses.replace(settings, observation=every), N, 7)
    rng = np.random.default_rng(3)
    low, high = np.array(settings.env.bounds_low), np.array(settings.env.bounds_high)
    race.fleet.state[:3] = rng.uniform(low + 1, high - 1, (N, 3)).T
    race.fleet.state[3:6] = rng.uniform(-10, 10, (3, N))
    race.fleet.state[10:13] = rng.uniform(-6, 6, (3, N))
    race.fleet.target[:] = rng.integers(0, 9, N)
    race.fleet.target[:2] = 8
    out = race.step(rng.uniform(-1, 1, (N, 4)).astype(np.float32))
    seen = np.where((out.outcome > 0)[:, None], out.terminal_observation, out.observation)
    assert (out.outcome > 0).any()
    assert (out.outcome == 0).any()
    return race, seen


def block(seen, name):
    at = 0
    for other, size in BLOCK_SIZES.items():
        if other == name:
            return seen[:, at : at + size]
        at += size
    raise KeyError(name)


def test_own_state(moved):
    race, seen = moved
    state = race.fleet.state
    np.testing.assert_allclose(block(seen, "position") * POSITION_SCALE, state[:3].T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(block(seen, "velocity") * SPEED_SCALE, state[3:6].T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(block(seen, "body_rate") * RATE_SCALE, state[10:13].T, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(block(seen, "height")[:, 0] * HEIGHT_SCALE, state[2], rtol=1e-5, atol=1e-6)
    matrices = Rotation.from_quat(state[6:10].T.astype(float), scalar_first=True).as_matrix()
    np.testing.assert_allclose(block(seen, "rotation"), matrices.reshape(N, 9), atol=2e-6)


def test_targets(moved):
    race, seen = moved
    target, position = race.fleet.target, race.fleet.state[:3].T
    for ahead in (0, 1):
        which = np.minimum(target + ahead, 8)
        expected = race.fleet.waypoints[which, :, np.arange(N)] - position
        np.testing.assert_allclose(
            block(seen, "targets")[:, 3 * ahead : 3 * ahead + 3] * TARGET_SCALE, expected, atol=1e-5
        )
    last = block(seen, "targets")[target >= 8]
    assert len(last) >= 2
    np.testing.assert_array_equal(last[:, :3], last[:, 3:])


def test_nearest_obstacles_count_obstacles_not_spheres(moved, spheres):
    race, seen = moved
    truths = [spheres(race, m) for m in range(2)]
    short = 0
    for i in range(N):
        position = race.fleet.state[:3, i].astype(float)
        everything = np.sort(truths[race.fleet.map[i]].distances(position))
        expected = np.minimum(everything[:10], 10.0)
        np.testing.assert_allclose(block(seen, "obstacle_distances")[i] * DISTANCE_SCALE, expected, atol=2e-5)
        vectors = block(seen, "obstacle_vectors")[i].reshape(10, 4)
        np.testing.assert_allclose(vectors[:, 3] * DISTANCE_SCALE, expected, atol=2e-5)
        np.testing.assert_allclose(np.linalg.norm(vectors[:, :3], axis=1), 1, atol=1e-5)
        ends = position + vectors[:, :3] * vectors[:, 3:] * DISTANCE_SCALE
        centres = truths[race.fleet.map[i]].centres
        misses = [np.linalg.norm(centres - end, axis=1).min() for end in ends]
        assert max(misses) < 1e-4  # each vector ends in the centre of a sphere
        short += np.ptp(everything[:10]) < 3
    assert short > 3  # of ten spheres of one tree, most would be that close together


def test_slots_without_an_obstacle_hold_the_range(config, flown, place_drones, hover, spheres):
    race = flown(config("env=split_s", "observation=relative", "observation.range=6"), 1)
    place_drones(race, (0.0, 2.0, 3.0))
    vectors = race.step(hover(1)).observation[0, 24:].reshape(10, 4)
    empty = np.isclose(vectors[:, 3] * DISTANCE_SCALE, 6.0)
    assert 10 - empty.sum() == (spheres(race, 0).distances([0, 2, 3]) < 6).sum()
    assert 0 < empty.sum() < 10
    assert (vectors[empty, :3] == 0).all()
    assert empty.tolist() == sorted(empty.tolist())


def test_rays(moved, spheres):
    race, seen = moved
    truths = [spheres(race, m) for m in range(2)]
    free, hit = 0, 0
    for i in range(12):
        position = race.fleet.state[:3, i].astype(float)
        for k in range(32):
            direction = np.array([np.cos(2 * np.pi * k / 32), np.sin(2 * np.pi * k / 32), 0.0])
            distance = truths[race.fleet.map[i]].ray(position, direction, 0.25, 10.0)
            assert block(seen, "rays")[i, k] == pytest.approx(np.exp(-distance / 2.5), abs=2e-3)
            free, hit = free + (distance == 10.0), hit + (distance < 10.0)
    assert min(free, hit) > 10


@pytest.mark.parametrize("preset", SIZES)
def test_presets_are_their_blocks_in_order(config, moved, flown, preset):
    """The same drones seen through a preset: the same values, block after block."""
    full, _seen = moved
    settings = config(f"observation={preset}", "level=3", "randomization=full", "randomization.maps=2")
    race = flown(settings, N, 7)
    for name in ("state", "waypoints", "target", "map", "plant"):
        getattr(race.fleet, name)[...] = getattr(full.fleet, name)
    race.fleet.target[:] = np.minimum(race.fleet.target, 8)
    race.fleet.waypoints[:] = full.fleet.waypoints
    action = np.zeros((N, 4), np.float32)
    race.step(action)
    got = np.where((race.output.outcome > 0)[:, None], race.output.terminal_observation, race.output.observation)
    at = 0
    for name in settings.observation.blocks:
        part = got[:, at : at + block_size(settings.observation, name)]
        expected = block_of(race, name)
        if expected is not None:
            np.testing.assert_allclose(part, expected, atol=2e-5, err_msg=name)
        at += part.shape[1]
    assert at == got.shape[1]


def block_size(observation, name):
    """Values of a block: those of rays can be chosen."""
    return observation.rays if name == "rays" else BLOCK_SIZES[name]


def in_its_axes(race, vectors):
    """World vectors (n, k, 3) as the observation has them: with frame=target, x points to the next waypoint."""
    if race.config.observation.frame == "world":
        return vectors
    target = race.fleet.waypoints[np.minimum(race.fleet.target, 8), :, np.arange(race.n)].astype(float)
    to = target - race.fleet.state[:3].T
    back = Rotation.from_euler("z", -np.arctan2(to[:, 1], to[:, 0])[:, None]).as_matrix()
    return np.einsum("nij,nkj->nki", back, vectors)


def block_of(race, name):
    """A block from the race's present state; None for obstacles, which have tests of their own."""
    state, n = race.fleet.state.astype(float), race.n
    if name == "position":
        return state[:3].T / POSITION_SCALE
    if name == "velocity":
        return in_its_axes(race, state[3:6].T[:, None]).reshape(n, 3) / SPEED_SCALE
    if name == "body_rate":
        return state[10:13].T / RATE_SCALE
    if name == "rotation":
        axes = Rotation.from_quat(state[6:10].T, scalar_first=True).as_matrix().transpose(0, 2, 1)
        return in_its_axes(race, axes).transpose(0, 2, 1).reshape(n, 9)
    if name == "targets":
        which = np.minimum(race.fleet.target[:, None] + [0, 1], 8)
        there = race.fleet.waypoints[which, :, np.arange(n)[:, None]]
        return in_its_axes(race, there - state[:3].T[:, None]).reshape(n, 6) / TARGET_SCALE
    return state[2:3].T / HEIGHT_SCALE if name == "height" else None


def test_song_sees_neither_position_nor_obstacles(config, flown, place_drones, hover):
    """Shift drone and waypoints together, and put them among other trees: nothing that it sees changes."""
    settings = config("baseline=song", "level=3")
    here, there = flown(settings, 1), flown(settings, 1)
    shift = np.array([4.0, 2.0, 2.0])
    place_drones(here, (-24.0, 0.0, 2.0), (5, 1, 0))
    place_drones(there, np.add((-24.0, 0.0, 2.0), shift), (5, 1, 0))
    there.fleet.waypoints[:] = here.fleet.waypoints + shift[None, :, None]
    seen = [
        np.concatenate([r.step(hover(1)).observation, r.output.terminal_observation]).max(axis=0) for r in (here, there)
    ]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-6)
    assert "position" not in settings.observation.blocks


def test_the_documented_indices(config):
    """The table of presets in docs/task.md."""
    page = (Path(__file__).parents[3] / "docs" / "task.md").read_text()
    for preset, size in SIZES.items():
        [(documented, blocks)] = re.findall(rf"^\| `{preset}` \| (\d+) \| (.*) \|$", page, re.MULTILINE)
        assert int(documented) == size
        at, expected = 0, []
        for name in config(f"observation={preset}").observation.blocks:
            last = at + block_size(config(f"observation={preset}").observation, name) - 1
            expected.append(f"`{name}` {at}-{last}" if last > at else f"`{name}` {at}")
            at = last + 1
        assert blocks == ", ".join(expected)
