"""Certificates: what the pilot's flights prove, and which maps they keep out of training and evaluation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from srlrace.config import SpacingConfig, TrackConfig
from srlrace.hydra_bridge import compose
from srlrace.task import certificate
from srlrace.task.certificate import certified_field, certify, fly_paths, unseen_maps
from srlrace.task.pilot import plan
from srlrace.task.race import Race, RaceMode
from srlrace.world.levels import FIRST_UNSEEN_SEED, generate_map
from srlrace.world.obstacles import cylinder

HALL = TrackConfig("hall", ((4.0, 0.0, 1.5),), (-4.0, 0.0, 1.5), (-5.0, -3.0, 0.0), (5.0, 3.0, 3.0), 0, 20.0)


@pytest.fixture(scope="module")
def hall():
    """A hall so narrow that some of its forests close the way."""
    config = compose(["env=forest", "level=3"])
    level = dataclasses.replace(config.level, spacings=(SpacingConfig(1.6, 0.3),), clear_radius=0.5)
    return dataclasses.replace(config, env=HALL, level=level)


def with_level(config, **changes):
    return dataclasses.replace(config, level=dataclasses.replace(config.level, **changes))


def test_a_plan_starts_at_rest_and_passes_the_corners():
    legs = [np.array([[0.0, 0, 1], [3.0, 0, 1]]), np.array([[3.0, 0, 1], [3.0, 4, 1]])]
    flight = plan(legs, 1.0, 0.02)
    assert flight[0, :3] == pytest.approx([0, 0, 1], abs=0.1)  # rounding
    assert np.linalg.norm(flight[0, 3:6]) < 1.0
    for stop in ([3.0, 0, 1], [3.0, 4, 1]):
        assert np.linalg.norm(flight[:, :3] - stop, axis=1).min() < 0.2
    assert np.diff(flight[:, :3], axis=0) / 0.02 == pytest.approx(flight[:-1, 3:6], abs=0.5)


def test_a_flight_certifies_and_a_wall_does_not(hall):
    wall = tuple(cylinder((0.0, y, 1.5), 0.3, 3.0) for y in np.arange(-3, 3.1, 0.5))
    free, tree, walled = fly_paths(hall, [(), (cylinder((0.0, 0.0, 1.5), 0.3, 3.0),), wall])
    assert 1.0 < free < tree < 5.0
    assert walled is None


def test_what_cannot_be_flown_in_time_is_not_certified(hall, monkeypatch):
    hasty = dataclasses.replace(hall, env=dataclasses.replace(HALL, horizon=0.5))
    assert fly_paths(hasty, [()]) == fly_paths(hall, [()])  # short episodes do not change what a map is
    monkeypatch.setattr(certificate, "HORIZON", 0.5)
    assert fly_paths(hall, [()]) == [None]


def test_shipped_certificates_are_those_of_flights():
    """A sample of what ships, flown again: dense unseen maps, and every training map of the tables."""
    for words, indices in (
        (["env=forest", "level=1"], (0,)),
        (["env=forest", "level=2"], (0,)),
        (["env=forest", "level=3"], (0, FIRST_UNSEEN_SEED, FIRST_UNSEEN_SEED + 57)),
    ):
        config = compose(words)
        maps = [generate_map(config.env, config.level, i) for i in indices]
        assert certify(config, maps) == pytest.approx(fly_paths(config, maps), abs=0.01)


@pytest.mark.parametrize("level", ["1", "2", "3"])
def test_evaluation_maps_are_certified_on_file(level, monkeypatch):
    """Evaluating the presets flies no certificate: all hundred are on file."""
    monkeypatch.setattr(certificate, "fly_paths", None)
    config = compose(["env=forest", f"level={level}"])
    seeds = unseen_maps(config, 100)
    assert len(set(seeds)) == 100
    assert min(seeds) >= FIRST_UNSEEN_SEED
    maps = [generate_map(config.env, config.level, seed) for seed in seeds]
    assert all(0 < time <= config.env.horizon for time in certify(config, maps))


def test_training_maps_of_the_presets_are_certified_on_file(monkeypatch):
    monkeypatch.setattr(certificate, "fly_paths", None)
    for words in (["env=forest"], ["env=forest", "level=none"], ["env=split_s"], ["env=split_s", "level=none"]):
        config = compose(words)
        field = Race(config, RaceMode.training(0, 1)).field
        assert field.obstacles(0) == generate_map(config.env, config.level, 0)


def test_a_certificate_is_for_one_quadrotor_and_one_margin():
    config = compose(["env=forest"])
    drawn = generate_map(config.env, config.level, 0)
    keys = {
        certificate.certificate_key(compose(["env=forest", *words]), drawn)
        for words in ([], ["quad.mass=0.8"], ["level.safety_margin=0.2"], ["sim.substeps=4"])
    }
    assert len(keys) == 4
    longer = compose(["env=forest", "seed=5", "reward=paper", "env.horizon=10"])
    assert certificate.certificate_key(longer, drawn) in keys


def test_infeasible_training_maps_are_drawn_anew(hall):
    """Every map of the field is flyable, those that were at once are kept, and the draw is the same again."""
    field = certified_field(hall, range(6))
    first = [generate_map(hall.env, hall.level, i) for i in range(6)]
    times = fly_paths(hall, first)
    assert None in times
    for i, time in enumerate(times):
        assert (field.obstacles(i) == first[i]) == (time is not None)
    assert None not in fly_paths(hall, field.map_obstacles)
    assert certified_field(hall, [3, 1]).map_obstacles == (field.obstacles(3), field.obstacles(1))


def test_unseen_maps_skip_what_cannot_be_flown(hall):
    seeds = unseen_maps(hall, 3)
    skipped = sorted(set(range(FIRST_UNSEEN_SEED, seeds[-1])) - set(seeds))
    assert unseen_maps(hall, 2) == seeds[:2]
    assert fly_paths(hall, [generate_map(hall.env, hall.level, s) for s in skipped]) == [None] * len(skipped)


def test_a_hopeless_level_is_explained(hall):
    wood = with_level(hall, spacings=(SpacingConfig(1.0, 0.0),))
    with pytest.raises(ValueError, match="no flight through"):
        certified_field(wood, [0])
