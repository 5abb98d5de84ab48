"""Reward terms by name against numpy, their sum, the curriculum; and the trap of a reward that punishes finishing."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from srlrace.task.arrays import CRASHED, EPISODE_RETURN, FINISHED, FLYING, TIMEOUT
from srlrace.task.reward import TERMS, exp_minus, weights

N = 60
PRESETS = ("srl", "srl_tuned", "paper", "no_safety", "no_terminal", "progress")


def terms_of(out):
    return dict(zip(TERMS, out.reward_terms.astype(float), strict=True))


@pytest.mark.parametrize("preset", PRESETS)
def test_every_term_against_numpy(config, flown, spheres, preset):
    """Random flight among the trees of level 2, each step's terms computed anew from the states around it."""
    settings = config("env=forest", "level=2", f"reward={preset}")
    race = flown(settings, N)
    reward, truth = settings.reward, spheres(race, 0)
    rng = np.random.default_rng(0)
    flying, ends, total = np.ones(N, bool), set(), np.zeros(N)
    for _ in range(60):
        before, target = race.fleet.state[:3].T.astype(float), race.fleet.target.copy()
        out = race.step(rng.uniform(-1, 1, (N, 4)).astype(np.float32))
        after, terms = race.fleet.state[:3].T.astype(float), terms_of(out)
        goal = race.fleet.waypoints[np.minimum(target, 8), :, np.arange(N)]
        gain = np.linalg.norm(goal - before, axis=1) - np.linalg.norm(goal - after, axis=1)
        spin = np.linalg.norm(race.fleet.state[10:13].astype(float), axis=0)
        collided = (out.outcome >= CRASHED) & (out.outcome != TIMEOUT)
        expected = {
            "progress": reward.progress * gain,
            "body_rate": reward.body_rate * spin,
            "collision": reward.collision * collided,
            "completion": np.zeros(N),
            "completion_time": np.zeros(N),
            "time": np.full(N, reward.time * 0.02),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(terms[name][flying], value[flying], atol=3e-5, err_msg=name)
        for i in np.flatnonzero(flying)[:6]:
            near = np.sort(truth.distances(after[i]))[:10]
            safety = reward.safety * np.exp(-near[near < 10]).sum()
            assert terms["safety"][i] == pytest.approx(safety, abs=1e-6)
        np.testing.assert_allclose(out.reward[flying], sum(terms.values())[flying], rtol=1e-6, atol=1e-6)
        total[flying] += out.reward[flying]
        ends |= set(out.outcome.tolist())
        flying = out.outcome == FLYING
    assert CRASHED in ends or len(ends) > 1
    np.testing.assert_allclose(race.fleet.tally[EPISODE_RETURN], total, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_terms_of_finishing(config, flown, place_drones, hover, preset):
    """25 m/s into the last waypoint, 7 s after the start."""
    settings = config("env=forest", "level=none", f"reward={preset}")
    race = flown(settings, 1)
    place_drones(race, np.array(settings.env.waypoints[-1]) - [0.5, 0, 0], (25, 0, 0), target=8)
    race.fleet.steps[:] = 349
    out = race.step(hover(1))
    assert out.outcome[0] == FINISHED
    time, terms = 6.98 + 0.2 / 25, terms_of(out)
    assert out.time[0] == pytest.approx(time, abs=1e-5)
    assert terms["completion"][0] == pytest.approx(settings.reward.completion)
    assert terms["completion_time"][0] == pytest.approx(settings.reward.completion_time * time, abs=1e-5)
    assert terms["collision"][0] == 0
    assert terms["progress"][0] == pytest.approx(settings.reward.progress * 0.5, abs=1e-5)  # towards the passed one


def test_progress_counts_the_old_target_in_the_step_that_passes_it(config, flown, place_drones, hover):
    race = flown(config("level=none"), 1)
    place_drones(race, np.array([-20.0, 0.0, 1.12]) - [0.4, 0, 0], (20, 0, 0), target=0)
    out = race.step(hover(1))
    assert race.fleet.target[0] == 1
    assert terms_of(out)["progress"][0] == pytest.approx(0.4, abs=1e-5)


def test_what_the_presets_keep_of_the_paper(config):
    paper = dict(zip(TERMS, weights(config("reward=paper").reward), strict=True))
    assert paper == {
        "progress": 1.0, "body_rate": -0.01, "safety": -0.05, "collision": -30.0,
        "completion": 0.0, "completion_time": -1.0, "time": 0.0,
    }  # fmt: skip
    srl = dict(zip(TERMS, weights(config("reward=srl").reward), strict=True))
    for kept in ("progress", "body_rate", "safety", "collision"):
        assert srl[kept] == paper[kept]
    song = dict(zip(TERMS, weights(config("baseline=song").reward), strict=True))
    assert (song["collision"], song["completion"], song["safety"]) == (-10.0, 10.0, 0.0)


def test_exp_of_the_table():
    d = np.linspace(0, 30, 4001)
    np.testing.assert_allclose([exp_minus(x) for x in d], np.exp(-d), atol=3e-7)


def test_the_curriculum_scales_costs_and_nothing_else(config, trained, hover):
    plain = config("level=1", "reward=srl")
    ramp = dataclasses.replace(plain.curriculum, cost_initial=0.2, cost_hold=0.1, cost_ramp=0.5)
    race = trained(dataclasses.replace(plain, curriculum=ramp), 4)
    full = weights(plain.reward)
    for done, share in ((0.0, 0.2), (0.1, 0.2), (0.3, 0.6), (0.5, 1.0), (0.9, 1.0)):
        race.set_progress(done)
        expected = np.where(full < 0, full * share, full)
        np.testing.assert_allclose(race.current_weights, expected)
        out = race.step(hover(4))
        terms = terms_of(out)
        np.testing.assert_allclose(terms["time"], plain.reward.time * 0.02 * share, rtol=1e-6)
    race.fleet.state[3] = np.nan
    race.set_progress(0.3)
    np.testing.assert_allclose(terms_of(race.step(hover(4)))["collision"], plain.reward.collision * 0.6)


LAST = np.array([20.0, 0.0, 1.12])
BEFORE = np.array([15.0, 5.0, 3.53])
ELAPSED = 350  # steps, 7 s: about the paper's time


def discounted_returns(settings, flown, place_drones, hover) -> dict[str, float]:
    """Flown half a metre short of the Forest's last waypoint: go through it, hover there, or fall to the ground."""
    race = flown(settings, 3)
    way = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)  # level, from the waypoint before
    assert way @ (LAST - BEFORE) > 0
    place_drones(race, LAST - 0.5 * way, [2.0 * way, np.zeros(3), np.zeros(3)], target=8)
    race.fleet.plant[:3] = race.rules.drag[:, None]
    race.fleet.steps[:] = ELAPSED
    action = hover(3)
    action[2, 0] = -1.0
    returns, discount, flying = np.zeros(3), 1.0, np.ones(3, bool)
    while flying.any():
        out = race.step(action)
        returns[flying] += discount * out.reward[flying]
        discount *= settings.algo.gamma
        flying = out.outcome == FLYING
    assert race.output.outcome.tolist() == [FINISHED, TIMEOUT, 3]
    assert np.linalg.norm(race.fleet.state[:3, 1] - (LAST - 0.5 * way)) < 0.01  # it did hover
    return dict(zip(("finish", "hover", "crash"), returns.tolist(), strict=True))


@pytest.mark.parametrize("preset", ["srl", "srl_tuned", "no_safety", "progress"])
@pytest.mark.parametrize("level", ["none", "2"])
def test_finishing_pays(config, flown, place_drones, hover, preset, level):
    worth = discounted_returns(config(f"reward={preset}", f"level={level}"), flown, place_drones, hover)
    assert worth["finish"] > worth["hover"] + 0.3
    assert worth["hover"] > worth["crash"] + 1.0


@pytest.mark.parametrize("level", ["none", "2"])
def test_the_trap_of_the_paper_as_written(config, flown, place_drones, hover, level):
    """lambda 4 T at completion: the best a policy can do is to stop short of the last waypoint."""
    worth = discounted_returns(config("reward=paper", f"level={level}"), flown, place_drones, hover)
    assert worth["hover"] > worth["finish"] + 5.0
    assert worth["finish"] > worth["crash"]


def test_finishing_sooner_pays_more(config, flown, place_drones, hover):
    """From the same place at 2, 4 and 8 m/s: the default reward prefers the faster."""
    settings = config("reward=srl", "level=none")
    race = flown(settings, 3)
    place_drones(race, LAST - [1.5, 0, 0], [(2, 0, 0), (4, 0, 0), (8, 0, 0)], target=8)
    returns, flying = np.zeros(3), np.ones(3, bool)
    for k in range(60):
        out = race.step(hover(3))
        returns[flying] += settings.algo.gamma**k * out.reward[flying]
        flying = out.outcome == FLYING
    assert (out.outcome == FINISHED).all()
    assert returns[0] < returns[1] < returns[2]


def test_the_documented_numbers(config, flown, place_drones, hover):
    """The table of discounted returns in docs/task.md."""
    page = (Path(__file__).parents[3] / "docs" / "task.md").read_text()
    rows = re.findall(r"^\| (0\.\d+) \| `(\w+)` \| (\S+) \| (\S+) \| (\S+) \|$", page, re.MULTILINE)
    assert len(rows) == 6
    for gamma, preset, *numbers in rows:
        settings = config(f"reward={preset}", "level=2")
        settings = dataclasses.replace(settings, algo=dataclasses.replace(settings.algo, gamma=float(gamma)))
        worth = discounted_returns(settings, flown, place_drones, hover)
        assert list(worth.values()) == pytest.approx([float(number) for number in numbers], abs=0.0051)


def test_the_documented_weights(config):
    page = (Path(__file__).parents[3] / "docs" / "task.md").read_text()
    page = page.partition("## Reward")[2]
    [head] = re.findall(r"^\| term \|.*$", page, re.MULTILINE)
    presets = re.findall(r"`(\w+)`", head)
    for k, term in enumerate(TERMS):
        [row] = re.findall(rf"^\| `{term}` \|.*$", page, re.MULTILINE)
        documented = [float(cell) for cell in row.split("|")[-len(presets) - 1 : -1]]
        assert documented == [weights(config(f"reward={preset}").reward)[k] for preset in presets], term
