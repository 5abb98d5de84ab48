"""Ways out of hard starts: the simulator survives them, a search finds them, and nothing but sound ones is read."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from typer.testing import CliRunner

from srlrace.bound import escapes
from srlrace.bound.escapes import ACTIONS, HOLD, Escapes, escapes_key, load_escapes, save_escapes
from srlrace.cli import app
from srlrace.config import ConfigError
from srlrace.evaluation import escape
from srlrace.evaluation.escape import find_escapes
from srlrace.evaluation.starts import fly_plans, random_plans
from srlrace.hydra_bridge import compose
from srlrace.task.arrays import FLYING
from srlrace.task.race import Race, RaceMode

FOREST = compose(["env=forest"])


@pytest.fixture
def shipped() -> Escapes:
    found = load_escapes(FOREST)
    assert found is not None
    return found


def at(start: np.ndarray) -> Race:
    """Drones at these starts, in the world of an evaluation."""
    race = Race(FOREST, RaceMode.evaluation(0, np.arange(len(start))))
    race.reset()
    race.fleet.state[:], race.fleet.plant[:] = start[:, :17].T, start[:, 17:21].T
    return race


def survive(start: np.ndarray, action: np.ndarray) -> np.ndarray:
    race, flying = at(start), np.ones(len(start), bool)
    for step in range(ACTIONS * HOLD):
        flying &= race.step(np.ascontiguousarray(action[:, step // HOLD], np.float32)).outcome == FLYING
    return flying


def test_every_way_out_that_ships_is_survived(shipped):
    assert len(shipped.start) > 1000
    assert survive(shipped.start, shipped.action).all()


def test_hovering_does_not_survive_where_they_begin(shipped):
    """Nor does doing what another start asks for help everywhere."""
    assert survive(shipped.start, np.zeros_like(shipped.action)).mean() < 0.5
    assert survive(shipped.start, np.roll(shipped.action, 1, axis=0)).mean() < 0.8


def test_like_starts_have_like_ways_out(shipped):
    """Most are variations of one: what a network is to learn should not jump about."""
    nearest = np.abs(shipped.action[:, None] - shipped.action[None]).mean((2, 3)) + 9.0 * np.eye(len(shipped.start))
    assert np.median(nearest.min(1)) < 0.25


def test_a_search_finds_hard_starts_and_ways_out(monkeypatch):
    """Of 3000 starts some are hard: no more than a tenth of other random sequences survives, and the ways out do."""
    monkeypatch.setattr(escape, "PLANS", 300)
    monkeypatch.setattr(escape, "SAMPLE", 4)
    found = find_escapes(FOREST, 3000)
    assert 1 <= len(found.start) <= 30
    assert survive(found.start, found.action).all()
    np.testing.assert_array_equal(found.start[:, -2:], 0.0)
    many = np.repeat(found.start, 200, 0)
    race = at(many)
    rng, lived = np.random.default_rng(1), np.ones(len(many), bool)
    for action in random_plans(rng, 30, len(many)):
        lived &= race.step(action).outcome == FLYING
    assert lived.mean() < 0.15
    ordinary = Race(FOREST, RaceMode.evaluation(1, np.arange(500)))
    assert (fly_plans(ordinary, random_plans(rng, 30, 500)) >= 30).mean() > 0.3


def test_they_are_kept_for_what_they_depend_on(shipped, tmp_path, monkeypatch):
    monkeypatch.setattr(escapes, "FOLDER", tmp_path / "none")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert load_escapes(FOREST) is None
    path = save_escapes(FOREST, shipped)
    again = load_escapes(compose(["env=forest", "env.horizon=3", "reward=srl_tuned", "seed=4"]))
    assert path.name == f"{escapes_key(FOREST)}.npz"
    assert again is not None
    np.testing.assert_array_equal(again.start, shipped.start)
    np.testing.assert_array_equal(again.action, shipped.action)
    for word in ("level=1", "randomization.velocity=2", "quad.thrust_max=6.2", "env.passing_radius=0.2"):
        assert load_escapes(compose(["env=forest", word])) is None


@pytest.mark.parametrize("what", ["empty", "beyond", "nan", "shape", "map", "quaternion", "pickle", "text"])
def test_nothing_but_sound_ones_are_read(shipped, tmp_path, monkeypatch, what):
    monkeypatch.setattr(escapes, "FOLDER", tmp_path)
    start, action = shipped.start.copy(), shipped.action.copy()
    if what == "empty":
        start, action = start[:0], action[:0]
    elif what == "beyond":
        action[3, 2, 1] = 1.5
    elif what == "nan":
        start[5, 2] = np.nan
    elif what == "shape":
        start = start[:, :-3]
    elif what == "map":
        start[7, -1] = 4.0
    elif what == "quaternion":
        start[1, 6:10] = 0.5 * start[1, 6:10]
    path = save_escapes(FOREST, dataclasses.replace(shipped, start=start, action=action), tmp_path)
    if what == "pickle":
        np.savez(path, start=np.array([{}], object), action=action)
    elif what == "text":
        path.write_text("ways out")
    assert load_escapes(FOREST) is None


def test_the_command_finds_and_keeps_them(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("srlrace.evaluation.escape.STARTS", 20)
    done = CliRunner().invoke(app, ["bound", "env=forest", "--escapes"])
    assert done.exit_code == 0, done.output
    assert "of 1532 hard starts" in done.output
    [path] = (tmp_path / "srlrace" / "bound" / "escapes").glob("*.npz")
    assert path.name == f"{escapes_key(FOREST)}.npz"


def test_where_no_start_is_hard_there_is_nothing_to_show(monkeypatch):
    monkeypatch.setattr(escape, "LOOK", 16)
    with pytest.raises(ConfigError, match="nothing to show"):
        find_escapes(compose(["env=forest", "level=none", "randomization=none"]), 40)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["level=mixed", "--escapes"], "--escapes: there are 100 maps"),
        (["--escapes", "--race"], "--escapes: goes without --race"),
        (["--escapes", "--demonstrate"], "--demonstrate: goes without --escapes"),
    ],
)
def test_the_command_says_what_does_not_go_together(words, said):
    refused = CliRunner().invoke(app, ["bound", "env=forest", *words])
    assert isinstance(refused.exception, ConfigError)
    assert said in str(refused.exception)
