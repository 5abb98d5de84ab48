"""How episodes start: offsets, attitudes, displaced waypoints, randomized plants, and staged starts in training."""

import dataclasses

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from srlrace.task.arrays import CRASHED, DIVERGED, FLYING, OUT_OF_BOUNDS, TIMEOUT
from srlrace.task.observation import POSITION_SCALE

N = 1500
SIGNIFICANT = 1e-4  # p-value below which a distribution is called wrong; the draws are fixed, so this never flickers


def attitude(race) -> Rotation:
    return Rotation.from_quat(race.fleet.state[6:10].T.astype(float), scalar_first=True)


def uniform(values, low, high) -> bool:
    return stats.kstest(values, stats.uniform(low, high - low).cdf).pvalue > SIGNIFICANT


@pytest.fixture(scope="module")
def started(config, flown):
    return flown(config("level=none"), N)


def test_start_state(started):
    state, start = started.fleet.state, np.array(started.config.env.start)
    offset = state[:3].T - start
    assert np.abs(offset).max() <= 1 + 1e-6
    assert uniform(offset[:, 0], -1, 1)
    assert uniform(offset[:, 1], -1, 1)
    height = state[2][state[2] > 0.3001]
    assert state[2].min() == pytest.approx(0.3)
    assert uniform(height, 0.3, start[2] + 1)
    for row in (3, 4, 5):
        assert uniform(state[row], -1, 1)
    assert (state[10:13] == 0).all()
    np.testing.assert_allclose(state[13:17], 0.752 * 9.81 / 4, rtol=1e-6)
    assert (started.fleet.steps == 0).all()
    assert not started.fleet.staged.any()


def test_euler_attitude(started):
    yaw, pitch, roll = attitude(started).as_euler("ZYX").T
    for angle in (roll, pitch, yaw):
        assert uniform(angle, -1, 1)
    assert abs(np.corrcoef([roll, pitch, yaw])[np.triu_indices(3, 1)]).max() < 0.1


def test_quaternion_attitude(config, flown):
    race = flown(config("level=none", "randomization.attitude_draw=quaternion"), N)
    q = race.fleet.state[6:10]
    np.testing.assert_allclose(np.linalg.norm(q, axis=0), 1, atol=1e-6)
    drawn = np.random.default_rng(0).uniform(-1, 1, (4, 20_000))
    drawn /= np.linalg.norm(drawn, axis=0)
    for component in range(4):
        assert stats.ks_2samp(q[component], drawn[component]).pvalue > SIGNIFICANT
    assert (Rotation.magnitude(attitude(race)) > 2).mean() > 0.5  # most such starts are far from upright


def test_no_randomization(config, flown):
    race = flown(config("randomization=none", "level=none"), 3)
    np.testing.assert_array_equal(race.fleet.state[:13].T, [[-25, 0, np.float32(1.12), 0, 0, 0, 1, *[0] * 6]] * 3)
    np.testing.assert_allclose(race.fleet.plant.T, [[0.26, 0.28, 0.42, 1]] * 3, rtol=1e-6)


def test_starts_are_clear_of_obstacles(config, flown, spheres):
    race = flown(config("level=3", "level.clear_radius=0.6"), 300)
    truth = spheres(race, 0)
    gaps = np.array([truth.gap(p) for p in race.fleet.state[:3].T.astype(float)])
    assert gaps.min() > 0.25 - 1e-5
    assert gaps.min() < 0.5  # there were trees to stay clear of
    np.testing.assert_allclose(race.output.clearance, gaps - 0.15, atol=1e-5)


def test_split_s_displaces_one_waypoint_an_episode(config, flown):
    race = flown(config("env=split_s", "level=none"), N)
    moved = race.fleet.waypoints - np.array(race.config.env.waypoints)[:, :, None]  # (7, 3, n)
    which = np.abs(moved).max(axis=1) > 1e-6
    assert (which.sum(axis=0) == 1).all()
    counts = which.sum(axis=1)
    assert stats.chisquare(counts).pvalue > SIGNIFICANT
    offsets = np.concatenate([moved[w][:, which[w]].T for w in range(7)])
    assert np.abs(offsets).max() <= 1 + 1e-6
    assert uniform(offsets[:, 0], -1, 1)
    assert uniform(offsets[:, 1], -1, 1)
    assert race.fleet.waypoints[:, 2].min() == pytest.approx(0.3)  # gates at 1.05 m would go below


def test_forest_waypoints_stay(started):
    np.testing.assert_array_equal(
        started.fleet.waypoints, np.broadcast_to(started.rules.waypoints[:, :, None], (9, 3, N))
    )


@pytest.fixture(scope="module")
def randomized(config, flown):
    return flown(config("randomization=full", "level=1", "randomization.maps=12"), N)


def test_full_randomization_of_the_plant(randomized):
    factor = randomized.fleet.plant[:3] / np.array([[0.26], [0.28], [0.42]])
    np.testing.assert_allclose(factor, np.broadcast_to(factor[:1], factor.shape), rtol=1e-5)
    assert uniform(factor[0], 0.5, 1.5)
    assert uniform(randomized.fleet.plant[3], 0.9, 1.1)


def test_full_randomization_of_maps(randomized):
    assert randomized.field.maps == 12
    assert stats.chisquare(np.bincount(randomized.fleet.map, minlength=12)).pvalue > SIGNIFICANT
    different = {tuple(o.center for o in randomized.field.obstacles(m)) for m in range(12)}
    assert len(different) == 12


def test_full_randomization_of_waypoints(randomized):
    moved = randomized.fleet.waypoints - randomized.rules.waypoints[:, :, None]
    for w in range(9):
        assert uniform(moved[w, 0], -1, 1)
        assert uniform(moved[w, 1], -1, 1)
        assert np.abs(moved[w, 2]).max() <= 1 + 1e-6
    assert randomized.fleet.waypoints[:, 2].min() == pytest.approx(0.3)


def test_full_randomization_asks_for_a_hundred_maps(config):
    assert config("randomization=full").randomization.maps == 100
    assert config("level=mixed").level.maps == 100


def test_every_reset_draws_anew(config, trained, place_drones):
    race = trained(config("randomization=full", "level=1", "randomization.maps=12", "curriculum=none"), 50)
    first = race.fleet.waypoints.copy(), race.fleet.plant.copy(), race.fleet.state.copy()
    race.reset()
    for before, after in zip(first, (race.fleet.waypoints, race.fleet.plant, race.fleet.state), strict=True):
        changed = (before != after).reshape(-1, 50).any(axis=0)
        assert changed.all()


def staged(config, **settings):
    plain = config("level=none", "curriculum=none")
    return dataclasses.replace(plain, curriculum=dataclasses.replace(plain.curriculum, **settings))


def test_gate_starts_are_near_the_waypoint_before_the_target(config, trained):
    race = trained(staged(config, gate_starts=1.0), N)
    target = race.fleet.target
    assert stats.chisquare(np.bincount(target, minlength=9)).pvalue > SIGNIFICANT
    track = race.config.env
    before = np.array([track.start, *track.waypoints])[target]
    assert np.abs(race.fleet.state[:3].T - before).max() <= 1 + 1e-5
    np.testing.assert_array_equal(race.fleet.staged, target > 0)
    np.testing.assert_array_equal(race.fleet.first_target, target)


def test_the_share_of_gate_starts(config, trained):
    race = trained(staged(config, gate_starts=0.4), N)
    expected = 0.4 * 8 / 9  # of the gate starts, one in nine is at the start
    assert stats.binomtest(int(race.fleet.staged.sum()), N, expected).pvalue > SIGNIFICANT


def test_evaluation_ignores_the_curriculum(config, flown):
    eager = staged(config, gate_starts=0.5, memory_starts=0.5, cost_initial=0.1, cost_hold=0.5, cost_ramp=1.0)
    race, plain = flown(eager, 200), flown(staged(config), 200)
    assert (race.fleet.target == 0).all()
    np.testing.assert_array_equal(race.fleet.state, plain.fleet.state)
    np.testing.assert_array_equal(race.current_weights, plain.rules.weights)
    race.set_progress(0.0)
    np.testing.assert_array_equal(race.current_weights, plain.rules.weights)


def test_staged_starts_are_not_counted(config, trained, hover):
    race = trained(staged(config, gate_starts=0.5), 200)
    real = ~race.fleet.staged
    assert 80 < real.sum() < 150
    race.fleet.state[3] = np.nan
    out = race.step(hover(200))
    assert (out.outcome == DIVERGED).all()
    ledger = race.take_ledger()
    assert ledger["episodes"] == ledger["diverged"] == real.sum()
    assert race.take_ledger()["episodes"] == 0


WAYPOINT = np.array([-20.0, 0.0, 1.12])


def test_a_remembered_start_is_the_passing_exactly(config, trained, place_drones, hover):
    """One drone passes the first waypoint in a world of its own; every later start is that very moment."""
    settings = config("randomization=full", "level=1", "randomization.maps=12", "curriculum=none")
    settings = dataclasses.replace(settings, curriculum=dataclasses.replace(settings.curriculum, memory_starts=1.0))
    race = trained(settings, 4)
    race.fleet.target[:] = 0
    race.fleet.staged[:] = False
    place_drones(race, np.add(WAYPOINT, [0, 3, 3]), (0, 0, 0))
    race.fleet.plant[:] = np.random.default_rng(0).uniform(0.2, 0.9, (4, 4))
    race.fleet.waypoints[:, :, 0] = race.rules.waypoints + 0.125
    race.fleet.state[:6, 0] = [*WAYPOINT + 0.125 - [0.4, 0, 0], 20, 0, 0]
    race.fleet.map[0] = 7
    race.fleet.steps[0] = 41
    race.step(hover(4))
    assert race.memory.count.tolist() == [0, 1, *[0] * 7]
    fleet = race.fleet
    names = ("state", "plant", "waypoints", "steps", "map")
    kept = {name: getattr(fleet, name)[..., 0].copy() for name in names}
    assert kept["steps"] == 42
    race.fleet.state[3] = np.nan
    assert (race.step(hover(4)).outcome == DIVERGED).all()
    for name in names:
        for i in range(4):
            np.testing.assert_array_equal(getattr(fleet, name)[..., i], kept[name], err_msg=name)
    assert fleet.staged.all()
    assert (fleet.target == 1).all()
    assert (fleet.tally[4] == 0).all()  # the return starts anew
    assert race.take_ledger()["episodes"] == 4  # the four real starts, and none of the staged


def test_the_memory_is_a_ring(config, trained, place_drones, hover):
    race = trained(staged(config, memory_starts=0.5, memory_size=3), 5)
    place_drones(race, WAYPOINT - [0.4, 0, 0], (20, 0, 0))
    race.fleet.steps[:] = np.arange(5)
    race.fleet.target[:] = 0
    race.step(hover(5))
    assert race.memory.count[1] == 5
    assert sorted(race.memory.record[1, :, -2].tolist()) == [3, 4, 5]  # steps of drones 2, 3 and 4
    race.fleet.state[3] = np.nan
    race.step(hover(5))
    remembered = race.fleet.target == 1
    assert set(race.fleet.steps[remembered].tolist()) <= {3, 4, 5}
    assert (race.fleet.steps[~remembered] == 0).all()


def test_with_nothing_to_remember_starts_are_near_waypoints(config, trained):
    race = trained(staged(config, memory_starts=1.0), 200)
    assert (race.memory.count == 0).all()
    assert len(set(race.fleet.target.tolist())) == 9


def test_a_failed_start_is_flown_again_exactly(config, trained, hover):
    """One drone fails from its start; later starts are that very one, and are not counted, nor remembered again."""
    settings = config("randomization=full", "level=1", "randomization.maps=12", "curriculum=none")
    settings = dataclasses.replace(settings, curriculum=dataclasses.replace(settings.curriculum, retry_starts=1.0))
    race = trained(settings, 4)
    names = ("state", "plant", "waypoints", "steps", "map", "target")
    drawn = {name: getattr(race.fleet, name)[..., 2].copy() for name in names}
    assert race.memory.failures.tolist() == [0]
    assert not race.fleet.staged.any()
    for failures in ([0, 0, 1, 0], [1, 1, 1, 1]):
        race.fleet.state[3] = np.where(failures, np.nan, race.fleet.state[3])
        race.step(hover(4))
        again = np.flatnonzero(failures)
        assert race.fleet.staged[again].all()
        assert race.memory.failures.tolist() == [[1], [4]][len(again) > 1]  # the retried one is not written again
        if len(again) == 1:
            for name, value in drawn.items():
                np.testing.assert_array_equal(getattr(race.fleet, name)[..., 2], value, err_msg=name)
    assert race.take_ledger()["episodes"] == 4


def test_what_led_to_a_crash_is_flown_again(config, trained, place_drones, hover):
    """A drone passes three waypoints and crashes: later episodes begin at its second passing, again and again."""
    race = trained(staged(config, hard_starts=1.0, memory_size=4), 2)
    race.set_progress(1.0)
    fleet, names = race.fleet, ("state", "plant", "waypoints", "steps", "map", "target")
    passed = []
    for waypoint in race.rules.waypoints[:3]:
        place_drones(race, [waypoint - [0.4, 0, 0], (0, 0, 4)], [(20, 0, 0), (0, 0, 0)])
        race.step(hover(2))
        passed.append({name: getattr(fleet, name)[..., 0].copy() for name in names})
    assert [at["target"] for at in passed] == [1, 2, 3]
    for _ in range(3):
        fleet.state[3, 0] = np.nan
        assert race.step(hover(2)).outcome.tolist() == [DIVERGED, FLYING]
        assert race.memory.hards.tolist() == [1]  # a crash on the way from a remembered one is not remembered again
        assert fleet.rehearsing.tolist() == fleet.staged.tolist() == [True, False]
        for name, value in passed[1].items():
            np.testing.assert_array_equal(getattr(fleet, name)[..., 0], value, err_msg=name)
    fleet.state[3, 1] = np.nan
    race.step(hover(2))
    assert race.memory.hards.tolist() == [2]
    assert race.memory.hard[1, -1] == 0  # it had passed nothing: from its start


@pytest.mark.parametrize("late", [False, True])
def test_a_flight_that_is_late_is_remembered_as_a_crash_where_asked(config, trained, place_drones, hover, late):
    """A flight from there that is cut off is not: it may only have been short."""
    race = trained(staged(config, hard_starts=1.0, hard_time=0.02, hard_late=late), 1)
    race.set_progress(1.0)
    race.fleet.steps[:] = race.rules.horizon_steps - 1
    place_drones(race, [(0, 0, 4)], [(0, 0, 0)])
    assert race.step(hover(1)).outcome.tolist() == [TIMEOUT]
    assert race.memory.hards.tolist() == [int(late)]
    assert race.fleet.rehearsing.tolist() == [late]
    race.step(hover(1))
    assert race.memory.hards.tolist() == [int(late)]


def test_a_flight_from_before_a_crash_is_cut_off(config, trained, place_drones, hover):
    """After three steps of 20 ms, as if the time were up; a flight from the start has all of it."""
    race = trained(staged(config, hard_starts=1.0, hard_time=0.06), 2)
    race.set_progress(1.0)
    place_drones(race, [(0, 0, 4), (0, 0, 4)], [(0, 0, 0), (0, 0, 0)])
    race.fleet.steps[:] = 100
    race.fleet.state[3, 0] = np.nan
    race.step(hover(2))
    place_drones(race, [(0, 0, 4), (0, 0, 4)], [(0, 0, 0), (0, 0, 0)])
    outcomes = [race.step(hover(2)).outcome.tolist() for _ in range(3)]
    assert outcomes == [[FLYING, FLYING], [FLYING, FLYING], [TIMEOUT, FLYING]]
    assert race.take_ledger()["timeout"] == 0


def test_hard_starts_come_as_staged_ones_go(config, trained):
    race = trained(staged(config, gate_starts=0.8, hard_starts=0.4, staged_hold=0.2, staged_end=0.6), 1)
    for done, share in ((0.0, 0.0), (0.2, 0.0), (0.5, 0.3), (0.6, 0.4), (1.0, 0.4)):
        race.set_progress(done)
        assert race.rules.hard_starts == pytest.approx(share)


def test_hard_starts_do_not_come_before_they_shall(config, trained):
    settings = {"gate_starts": 0.4, "hard_starts": 0.6, "staged_hold": 0.2, "staged_end": 0.6}
    for begin, half_way in ((0.4, 0.3), (0.5, 0.0)):
        race = trained(staged(config, **settings, hard_begin=begin), 1)
        for done, share in ((0.0, 0.0), (0.3, 0.0), (0.4, half_way), (0.6, 0.6), (1.0, 0.6)):
            race.set_progress(done)
            assert race.rules.hard_starts == pytest.approx(share)


def test_staged_starts_end(config, trained, hover):
    race = trained(staged(config, gate_starts=0.5, memory_starts=0.3, staged_hold=0.2, staged_end=0.6), 300)
    for done, left in ((0.0, 1.0), (0.2, 1.0), (0.5, 0.25), (0.6, 0.0), (1.0, 0.0)):
        race.set_progress(done)
        assert race.rules.gate_starts == pytest.approx(0.5 * left)
        assert race.rules.memory_starts == pytest.approx(0.3 * left)
    race.fleet.state[3] = np.nan
    race.step(hover(300))
    assert not race.fleet.staged.any()


def test_waypoints_shrink_to_their_size(config, trained, flown, place_drones, hover):
    """A drone that flies by at 0.5 m passes while the radius of 0.3 m is still twice that, and never in evaluation."""
    settings = staged(config, waypoint_ease=0.3, ease_hold=0.2, ease_end=0.6)
    beside = np.array(settings.env.waypoints[0]) + [-0.1, 0.5, 0.0]
    for race, passes in ((trained(settings, 1), (True, True, False)), (flown(settings, 1), (False, False, False))):
        for done, passed in zip((0.0, 0.2, 0.6), passes, strict=True):
            race.set_progress(done)
            place_drones(race, [beside], [[10.0, 0.0, 0.0]], target=0)
            race.step(hover(1))
            assert (race.fleet.target[0] == 1) == passed
    race = trained(settings, 1)
    race.set_progress(0.4)
    assert race.rules.passing_radius == pytest.approx(0.45)


def test_obstacles_grow_to_their_size(config, trained, flown, place_drones, hover):
    """A drone 0.1 m from a tree is too close where 0.25 m are wanted, and was not while that was less."""
    plain = staged(config, obstacle_ease=0.2, ease_hold=0.2, ease_end=0.6)
    settings = dataclasses.replace(plain, level=config("level=1").level)
    tree, *_ = trained(settings, 1).field.obstacles(0)
    beside = np.array([*tree.origin[:2], 2.0]) + [tree.sphere_radius + 0.1, 0.0, 0.0]
    for race, crashes in ((trained(settings, 1), (False, False, True)), (flown(settings, 1), (True, True, True))):
        for done, crashed in zip((0.0, 0.2, 0.6), crashes, strict=True):
            race.set_progress(done)
            race.reset()
            place_drones(race, [beside], [[0.0, 0.0, 0.0]])
            assert (race.step(hover(1)).outcome[0] == CRASHED) == crashed


@pytest.mark.parametrize("done", [0.0, 1.0])
def test_margins_are_kept_in_training_alone(config, trained, flown, place_drones, hover, done):
    """A drone 0.27 m from a tree is too close where 0.25 m and 0.05 m more are wanted, one at 0.32 m is not."""
    plain = staged(config, obstacle_margin=0.05, waypoint_margin=0.1)
    settings = dataclasses.replace(plain, level=config("level=1").level)
    tree, *_ = trained(settings, 2).field.obstacles(0)
    from_tree = [np.array([*tree.origin[:2], 2.0]) + [tree.sphere_radius + gap, 0, 0] for gap in (0.27, 0.32)]
    from_waypoint = [np.array(settings.env.waypoints[0]) + [-0.1, aside, 0] for aside in (0.25, 0.15)]
    for race, kept in ((trained(settings, 2), True), (flown(settings, 2), False)):
        race.set_progress(done)
        race.reset()
        place_drones(race, from_tree, [[0, 0, 0], [0, 0, 0]])
        assert (race.step(hover(2)).outcome == CRASHED).tolist() == [kept, False]
        race.reset()
        place_drones(race, from_waypoint, [[10, 0, 0], [10, 0, 0]], target=0)
        race.step(hover(2))
        assert race.fleet.target.tolist() == [int(not kept), 1]


def test_a_margin_is_kept_from_walls_in_training_alone(config, trained, flown, place_drones, hover):
    settings = staged(config, obstacle_margin=0.05)
    floor, far = settings.env.bounds_low[2], settings.env.bounds_high[0]
    places = [[0.0, 0.0, floor + 0.03], [far - 0.03, 0.0, floor + 5.0], [0.0, 0.0, floor + 0.07]]
    for race, outcomes in ((trained(settings, 3), [OUT_OF_BOUNDS] * 2 + [FLYING]), (flown(settings, 3), [FLYING] * 3)):
        place_drones(race, places, np.zeros((3, 3)))
        assert race.step(hover(3)).outcome.tolist() == outcomes


def test_a_margin_can_leave_the_first_moments_of_an_episode_out(config, trained, place_drones, hover):
    """Who starts beside a tree may not get further away from it in time, but must have done so later."""
    plain = staged(config, obstacle_margin=0.05, obstacle_margin_after=0.1)
    race = trained(dataclasses.replace(plain, level=config("level=1").level), 1)
    tree, *_ = race.field.obstacles(0)
    place_drones(race, [np.array([*tree.origin[:2], 2.0]) + [tree.sphere_radius + 0.27, 0, 0]], [[0, 0, 0]])
    outcomes = [race.step(hover(1)).outcome[0] for _ in range(5)]
    assert outcomes == [FLYING] * 4 + [CRASHED]


def test_starts_are_drawn_from_wider_ranges_in_training_alone(config, trained, flown):
    settings = staged(config, start_margin=0.5)
    draw = settings.randomization
    for race, share in ((trained(settings, 2000), 1.5), (flown(settings, 2000), 1.0)):
        race.reset()
        away = np.abs(race.fleet.state[:2] - np.array(settings.env.start[:2])[:, None]).max(1)
        speed = np.abs(race.fleet.state[3:6]).max(1)
        up = 1.0 - 2.0 * (race.fleet.state[7] ** 2 + race.fleet.state[8] ** 2)  # cosine of the tilt
        np.testing.assert_allclose(away, share * draw.position, rtol=0.01)
        np.testing.assert_allclose(speed, share * draw.velocity, rtol=0.01)
        assert up.min() == pytest.approx(np.cos(share * draw.attitude) ** 2, abs=0.05)


def test_episodes_restart_at_once_in_training(config, trained, place_drones, hover):
    race = trained(staged(config), 3)
    place_drones(race, [[0, 0, 4], [0, 0, 4], [0, 0, 0.05]], [[0, 0, 0], [0, 0, 0], [0, 0, -5]])
    out = race.step(hover(3))
    assert out.outcome[:2].tolist() == [FLYING, FLYING]
    assert out.outcome[2] not in (FLYING, CRASHED)
    assert race.fleet.steps.tolist() == [1, 1, 0]
    assert np.abs(race.fleet.state[:2, 2] - np.array(race.config.env.start[:2])).max() <= 1
    np.testing.assert_allclose(out.terminal_observation[2, :3] * POSITION_SCALE, [0, 0, -0.05], atol=2e-3)
    np.testing.assert_allclose(out.observation[2, :3] * POSITION_SCALE, race.fleet.state[:3, 2], rtol=1e-6)
