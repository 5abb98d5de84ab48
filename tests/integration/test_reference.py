"""The published runs: the README's table comes from them, and their policies fly as their episodes say."""

from __future__ import annotations

import re
import shutil
from io import BytesIO
from pathlib import Path

import pandas as pd
import pytest

from srlrace.config import run_id
from srlrace.evaluation import evaluate_run
from srlrace.report.command import read_report
from srlrace.runs import RunFolder, State, find, list_runs

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "runs" / "reference"
EPISODES = 100
SAME = 0.95  # share of episodes with the published outcome: another kind of processor rounds otherwise


def test_every_published_run_is_whole_and_named_by_its_content() -> None:
    runs = list_runs(REFERENCE)
    assert runs
    for run in runs:
        assert run.state is State.FINISHED
        assert run_id(run.load_config()) == run.id
        assert run.info["steps"] >= run.load_config().algo.total_steps
        unseen = run.load_config().level.name in ("mixed", "endless")
        assert run.evaluations.keys() >= ({"level1", "level2", "level3"} if unseen else {"train_map"})
        assert all(evaluation["episodes"] == 1000 for evaluation in run.evaluations.values())


@pytest.mark.parametrize("experiment", ["minimum_time", "generalization", "ablation_safety", "ablation_terminal"])
def test_the_readme_shows_what_they_say(experiment: str) -> None:
    _, report = read_report(REFERENCE)
    readme = (ROOT / "README.md").read_text()
    table = next(table for table in report.tables if table.experiment.name == experiment)
    for cell in table.cells:
        assert cell.numbers is not None
        assert f"{cell.numbers.finished}/{cell.numbers.episodes}" in readme
        if experiment == "generalization" and cell.numbers.finished == 0:
            assert cell.numbers.time_s is None
        else:
            assert cell.numbers.time_s is not None
            assert f"{cell.numbers.time_s.value:.2f}" in readme


@pytest.mark.parametrize(
    ("experiment", "name"),
    [
        ("training_maps", "clutter"),
        ("robustness", "clutter"),
        ("observation_ablation", "clutter"),
        ("song_observations", "reproduce"),
    ],
)
def test_a_page_shows_what_they_say(experiment: str, name: str) -> None:
    _, report = read_report(REFERENCE)
    page = (ROOT / "docs" / f"{name}.md").read_text()
    table = next(table for table in report.tables if table.experiment.name == experiment)
    for cell in table.cells:
        assert cell.numbers is not None
        crash = cell.numbers.crash_pct
        assert f"{crash.value:.1f} [{crash.low:.1f}, {crash.high:.1f}]" in page
    for comparison in table.comparisons:
        difference = comparison.difference
        assert f"{difference.value:.1f} [{difference.low:.1f}, {difference.high:.1f}]" in page


@pytest.mark.parametrize(
    ("kind", "curriculum", "suite"),
    [
        ("forest-srl-", "default", "train_map"),
        ("split_s-srl-", "default", "train_map"),
        ("forest-srl_tuned-", "taught_course", "train_map"),
        ("split_s-srl_tuned-", "taught", "train_map"),
        ("forest-srl_tuned-facing-", "default", "level2"),
    ],
)
def test_a_published_policy_flies_as_published(kind: str, curriculum: str, suite: str, tmp_path: Path) -> None:
    alike = (r for r in list_runs(REFERENCE) if r.id.startswith(kind) and r.load_config().curriculum.name == curriculum)
    published = next(r for r in alike if suite in r.evaluations)
    copy = RunFolder(Path(shutil.copytree(published.path, tmp_path / published.id)))
    evaluate_run(copy, EPISODES, suite, record="none")
    columns = ["outcome", "time_s", "gates_passed"]
    ours, theirs = (pd.read_csv(BytesIO(r.episodes(suite)))[:EPISODES][columns] for r in (copy, published))
    assert (ours["outcome"] == theirs["outcome"]).mean() >= SAME
    assert ours["time_s"].mean() == pytest.approx(theirs["time_s"].mean(), rel=0.02)


def test_the_replays_pictures_are_of_published_runs() -> None:
    named = re.findall(r"^REPLAY_(?:FOREST|SPLIT_S) \?= (\S+)$", (ROOT / "Makefile").read_text(), re.M)
    assert len(named) == 2
    assert [find(REFERENCE, name).id for name in named] == named
