"""Names of suites, and the disturbances that stand in files."""

from __future__ import annotations

import pytest

import srlrace.suites as module
from srlrace.confdir import conf_dir
from srlrace.parse import NAME, ConfigError
from srlrace.report.experiments import load_experiment
from srlrace.schema import SUITES, DisturbanceConfig
from srlrace.suites import check_suite, definition, describe, describe_suite, disturbance_of, maps_of, suite_names

DISTURBED = [name for name in suite_names() if name.startswith("level2-")]


def test_a_suite_is_a_set_of_maps_alone_or_disturbed() -> None:
    assert suite_names()[: len(SUITES)] == SUITES
    assert len(DISTURBED) == len(list((conf_dir() / "disturbance").glob("*.yaml"))) >= 16
    assert all(NAME.fullmatch(name) for name in suite_names())  # they name folders of a run
    assert (maps_of("level2-wind5"), maps_of("train_map")) == ("level2", "train_map")


@pytest.mark.parametrize("suite", DISTURBED)
def test_every_disturbance_changes_what_its_name_says(suite: str) -> None:
    disturbance = disturbance_of(suite)
    changed = definition(disturbance)
    assert changed.pop("name") == suite.partition("-")[2] == disturbance.name
    kind = disturbance.name.rstrip("0123456789")
    assert changed
    assert all(kind in key for key in changed)
    assert kind in describe(disturbance)
    number = float(disturbance.name.removeprefix(kind))
    unit = {"mass": 0.01, "drag": 0.01, "thrust": 0.01, "delay": 0.001, "wind": 1.0}.get(kind)
    assert unit is None or changed[kind] == pytest.approx(unit * number)


def test_the_robustness_table_flies_all_of_them_and_the_undisturbed() -> None:
    experiment = load_experiment(conf_dir() / "experiment" / "robustness.yaml")
    assert experiment.suites[0] == "level2"
    assert sorted(experiment.suites[1:]) == sorted(DISTURBED)


def test_words() -> None:
    assert definition(disturbance_of("level1")) == {}
    assert describe_suite("train_map") == ""
    assert describe_suite("validation") == "starts for validation"
    assert describe_suite("unseen") == "unseen maps"
    assert describe_suite("level2-wind5") == "unseen level 2, wind 5 m/s"
    assert describe(DisturbanceConfig("x", mass=0.8, delay=0.04)) == "mass x0.8, action delay 40 ms"


@pytest.mark.parametrize(
    "name", ["level4", "level2-", "level2-storm", "-wind5", "../level2", "level2+wind5", "", "wind5"]
)
def test_other_names_are_refused_in_a_line(name: str) -> None:
    with pytest.raises(ConfigError, match="takes one of train_map") as refusal:
        check_suite(name)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- a list", "holds no settings"),
        ("name: odd\nmass: 0", "mass"),
        ("name: odd\nhail: 1", "hail"),
        ("name: even\nwind: 1", "takes odd, as the file is called"),
        ("name: odd\nwind: [", "odd.yaml"),
    ],
)
def test_a_disturbance_that_cannot_be_used(tmp_path, monkeypatch, text: str, words: str) -> None:
    (tmp_path / "disturbance").mkdir()
    (tmp_path / "disturbance" / "odd.yaml").write_text(text)
    monkeypatch.setattr(module, "conf_dir", lambda: tmp_path)
    monkeypatch.setattr(module, "suite_names", lambda: ("level1-odd",))
    with pytest.raises(ConfigError, match=words) as refusal:
        disturbance_of.__wrapped__("level1-odd")
    assert "\n" not in str(refusal.value)
