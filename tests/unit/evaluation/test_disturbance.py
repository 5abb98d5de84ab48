"""Disturbed flights: against an independent flight model, against sums done by hand, and against undisturbed ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from flightmodel import PERIOD, Reference
from scipy.spatial.transform import Rotation

from srlrace.evaluation.disturbance import DisturbedRace, periods, turned
from srlrace.schema import DisturbanceConfig
from srlrace.task.observation import POSITION_SCALE, SPEED_SCALE
from srlrace.task.race import Race, RaceMode

SEED = 11
CALM = DisturbanceConfig("calm")


@pytest.fixture(scope="module")
def disturbed(config):
    """Function (disturbance, n, overrides) to a race that has begun, in a world without obstacles unless asked."""
    fields = {}

    def build(disturbance: DisturbanceConfig, n: int, *overrides: str) -> DisturbedRace:
        settings = config(*(overrides or ("level=none",)))
        fields.setdefault(overrides, Race(settings, RaceMode.evaluation(SEED, np.arange(1))).field)
        race = DisturbedRace(settings, RaceMode.evaluation(SEED, np.arange(n)), fields[overrides], disturbance)
        race.reset()
        return race

    return build


def actions(n: int, steps: int, seed: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, n, 4)).astype(np.float32)


def flights(race: Race, pilot) -> bytes:
    """Everything that the policy sees and that becomes of its flights, until all of them have ended."""
    seen, said = race.output.observation, [race.output.observation.tobytes()]
    while not race.fleet.parked.all():
        out = race.step(pilot(seen))
        said += [part.tobytes() for part in (out.observation, out.clearance, out.outcome, out.time, race.fleet.state)]
    return b"".join([*said, *(part.tobytes() for part in (out.final_tally, out.final_passing_time, out.final_target))])


@pytest.mark.parametrize("overrides", [("level=1",), ("level=2", "env.horizon=4")])
def test_no_disturbance_is_the_undisturbed_race_to_the_byte(config, disturbed, flown, pilot, overrides):
    calm, plain = disturbed(CALM, 30, *overrides), flown(config(*overrides), 30, SEED)
    assert flights(calm, pilot) == flights(plain, pilot)


@pytest.mark.parametrize(
    "changes",
    [{"mass": 1.2}, {"mass": 0.8}, {"drag": 2.0}, {"drag": 0.0}, {"thrust": 0.9}, {"wind": 5.0},
     {"mass": 1.2, "drag": 1.5, "thrust": 0.9, "wind": 4.0}],
)  # fmt: skip
def test_the_plant_and_the_air_fly_as_an_independent_model_says(disturbed, changes):
    n, steps = 8, 12  # a quarter of a second
    race = disturbed(replace(CALM, **changes), n)
    wind = race.rules.wind.astype(float) if "wind" in changes else None
    model = Reference(race.config.quad, **{**changes, "wind": wind})
    nominal = Reference(race.config.quad)
    expected = undisturbed = race.fleet.state.astype(float)
    for action in actions(n, steps):
        command = np.empty((4, n))
        command[0] = 0.5 * (action[:, 0] + 1) * race.rules.max_collective
        command[1:] = (action[:, 1:] * race.rules.body_rate_max).T
        race.step(action)
        expected, undisturbed = model.flown_period(expected, command), nominal.flown_period(undisturbed, command)
    np.testing.assert_allclose(race.fleet.state[:3], expected[:3], atol=2e-4)
    np.testing.assert_allclose(race.fleet.state[3:6], expected[3:6], atol=2e-3)
    assert np.median(np.linalg.norm(expected[:3] - undisturbed[:3], axis=0)) > 0.005  # m: the disturbance shows


def test_a_heavier_drone_sinks_under_hover_thrust(disturbed, place_drones, hover):
    race = disturbed(replace(CALM, mass=1.2), 1)
    place_drones(race, (0, 0, 6))  # without drag
    for _ in range(20):
        race.step(hover(1))
    assert race.fleet.state[5, 0] == pytest.approx(20 * PERIOD * 9.81 * (1 / 1.2 - 1), rel=1e-3)


def test_drag_falls_with_the_mass_and_the_controller_keeps_its_own(disturbed):
    race = disturbed(replace(CALM, mass=0.8, drag=2.0, thrust=0.9), 3)
    nominal = np.array(race.config.quad.drag)
    np.testing.assert_allclose(race.fleet.plant[:3], np.tile(nominal[:, None] * 2 / 0.8, 3), rtol=1e-6)
    np.testing.assert_allclose(race.fleet.plant[3], 0.9, rtol=1e-6)
    believed = disturbed(CALM, 3).rules
    assert race.rules.max_collective == believed.max_collective
    assert race.rules.hover_thrust == believed.hover_thrust
    changed = np.flatnonzero(race.rules.airframe != believed.airframe)
    assert changed.tolist() == [0]  # the acceleration per newton alone


def test_the_wind_is_steady_horizontal_and_from_all_sides(disturbed):
    wind = disturbed(replace(CALM, wind=3.0), 400).rules.wind
    np.testing.assert_allclose(np.linalg.norm(wind, axis=0), 3.0, rtol=1e-5)
    assert (wind[2] == 0).all()
    quarters = np.histogram(np.arctan2(wind[1], wind[0]), bins=4, range=(-np.pi, np.pi))[0]
    assert quarters.min() > 70  # of 100 expected
    stronger = disturbed(replace(CALM, wind=5.0), 20).rules.wind
    np.testing.assert_allclose(stronger, wind[:, :20] * 5 / 3, rtol=1e-5)  # from the same sides


def test_the_wind_carries_what_is_at_rest(disturbed, place_drones, hover):
    race = disturbed(replace(CALM, wind=5.0), 6)
    place_drones(race, (0, 0, 4))
    race.fleet.plant[:3] = 0.3
    for _ in range(50):
        race.step(hover(6))
    gained = 5 * -np.expm1(-0.3 * 50 * PERIOD)
    np.testing.assert_allclose(race.fleet.state[3:5], race.rules.wind[:2] * gained / 5, atol=1e-3)


@pytest.mark.parametrize("late", [1, 3])
def test_a_delayed_action_is_that_of_earlier_steps(config, disturbed, flown, hover, late):
    n, steps = 8, 30
    given = actions(n, steps)
    race, plain = disturbed(replace(CALM, delay=late * PERIOD), n), flown(config("level=none"), n, SEED)
    for k in range(steps):
        race.step(given[k])
        plain.step(given[k - late] if k >= late else hover(n))
        np.testing.assert_array_equal(race.fleet.state, plain.fleet.state)


def test_a_new_episode_has_nothing_left_in_the_line(disturbed):
    race = disturbed(replace(CALM, delay=0.04), 4)

    def fly():
        race.fleet.streams[1] = 0
        race.reset()
        for action in actions(4, 5):
            race.step(action)
        return race.fleet.state.copy()

    np.testing.assert_array_equal(fly(), fly())


def test_a_delay_is_whole_control_periods():
    assert [periods(delay, 0.02) for delay in (0.0, 0.02, 0.06)] == [0, 1, 3]
    with pytest.raises(ValueError, match="30 ms is no multiple of the control period, 20 ms"):
        periods(0.03, 0.02)


NOISE = replace(CALM, position_noise=0.1, velocity_noise=0.3, attitude_noise=0.05)


def mistakes(race: Race) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the paper's observation is off by: position (n, 3), velocity (n, 3), rotation vector (n, 3) in the body."""
    seen, state = race.output.observation.astype(float), race.fleet.state.astype(float)
    believed = Rotation.from_matrix(seen[:, 3:12].reshape(-1, 3, 3))
    true = Rotation.from_quat(state[6:10].T, scalar_first=True)
    position, velocity = seen[:, :3] * POSITION_SCALE - state[:3].T, seen[:, 12:15] * SPEED_SCALE - state[3:6].T
    return position, velocity, (true.inv() * believed).as_rotvec()


@pytest.mark.parametrize("noise_time", [0.0, 0.2])
def test_errors_have_the_size_and_the_memory_that_were_asked_for(disturbed, hover, noise_time):
    n, steps = 300, 12
    race = disturbed(replace(NOISE, noise_time=noise_time), n)
    seen = [mistakes(race)]
    for _ in range(steps):
        race.step(hover(n))
        seen.append(mistakes(race))
    kept = np.exp(-PERIOD / noise_time) if noise_time else 0.0
    for errors, size in zip((np.array(part) for part in zip(*seen, strict=True)), (0.1, 0.3, 0.05), strict=True):
        np.testing.assert_allclose(errors.std(axis=(1, 2)), size, rtol=0.15)  # from the first observation on
        assert np.abs(errors.mean(axis=(1, 2))).max() < 0.25 * size
        correlation = (errors[1:] * errors[:-1]).mean() / size**2
        assert correlation == pytest.approx(kept, abs=0.08)


def test_errors_change_what_is_seen_and_nothing_else(config, disturbed, flown):
    n = 10
    race, plain = disturbed(NOISE, n), flown(config("level=none"), n, SEED)
    assert (race.output.observation != plain.output.observation).any()
    for action in actions(n, 20):
        out = race.step(action)
        plain.step(action)
        np.testing.assert_array_equal(race.fleet.state, plain.fleet.state)
        np.testing.assert_array_equal(out.reward, plain.output.reward)


def test_obstacles_are_seen_from_the_estimated_place(disturbed, place_drones, hover):
    """A drone that believes to be elsewhere sees the trees as from there."""
    race = disturbed(replace(CALM, position_noise=0.5), 40, "level=2", "observation=rays")
    race.step(hover(40))
    position = race.output.observation[:, :3] * POSITION_SCALE
    there = race.fleet.state.copy()
    there[:3] = position.T
    seen = race.output.observation[:, 24:].copy()
    np.testing.assert_allclose(race.observe(there)[:, 24:], seen, atol=2e-3)


def test_wind_and_errors_do_not_depend_on_how_many_fly(disturbed, hover):
    everything = replace(NOISE, noise_time=0.1, wind=4.0)
    few, many = disturbed(everything, 4), disturbed(everything, 9)
    for _ in range(5):
        few.step(hover(4))
        many.step(hover(9))
        np.testing.assert_array_equal(few.output.observation, many.output.observation[:4])


def test_turned_is_a_rotation_about_the_bodys_own_axes():
    rng = np.random.default_rng(2)
    start, angles = Rotation.random(50, rng=rng), rng.normal(0, 0.7, (3, 50))
    angles[:, 0] = 0.0
    got = Rotation.from_quat(turned(start.as_quat(scalar_first=True).T, angles).T, scalar_first=True)
    np.testing.assert_allclose((got.inv() * start * Rotation.from_rotvec(angles.T)).magnitude(), 0, atol=1e-7)


def test_training_is_never_disturbed(config):
    settings = config("level=none")
    with pytest.raises(ValueError, match="for evaluation"):
        DisturbedRace(settings, RaceMode.training(0, 2), Race(settings, RaceMode.training(0, 2)).field, CALM)
