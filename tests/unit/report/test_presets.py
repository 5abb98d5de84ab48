"""Rows composed without Hydra, held against Hydra."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from srlrace.confdir import conf_dir
from srlrace.config import ConfigError
from srlrace.report import presets
from srlrace.report.experiments import load_experiments

ROWS = sorted({row.overrides for each in load_experiments(conf_dir() / "experiment") for row in each.rows})


@pytest.mark.parametrize("overrides", ROWS, ids=" ".join)
def test_every_row_means_what_hydra_says(overrides: tuple[str, ...], lab: SimpleNamespace) -> None:
    assert presets.row_config(overrides) == lab.compose(overrides)


def test_rows_of_choices_do_without_hydra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "compose", None)  # calling it fails
    presets.row_config.cache_clear()
    assert presets.row_config(("env=split_s", "baseline=song", "seed=3")).reward.name == "progress"
    assert presets.row_config(("env=split_s", "level=none", "name=bare")).level.name == "none"
    assert presets.row_config(("baseline=song", "observation=paper")).observation.name == "paper"
    assert presets.row_config(("observation=facing", "observation.frame=world")).observation.frame == "world"
    assert presets.row_config(("level=mixed", "level.maps=10")).level.maps == 10


@pytest.mark.parametrize(
    "word",
    [
        "reward.safety=-0.1",
        "algo.gamma=1",
        "algo.total_steps=2e5",  # to YAML a word
        "level.maps=10",
        "observation.frame=target",  # not in the preset
        "observation.blocks=[rotation,rays]",
        "level.spacings=[{pitch: 3.0, jitter: 0.5}]",
        "name='no'",
    ],
)
def test_single_settings(word: str, lab: SimpleNamespace) -> None:
    assert presets.row_config(("env=forest", word)) == lab.compose(("env=forest", word))


def test_a_wrong_row_is_hydras_error() -> None:
    with pytest.raises(ConfigError, match="forest"):
        presets.row_config(("env=forst",))
