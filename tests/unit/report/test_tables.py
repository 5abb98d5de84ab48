"""Which runs fill which cell, and the numbers in it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from srlrace.report.collect import Run
from srlrace.report.experiments import Experiment, Paper, PaperCell, Row
from srlrace.report.model import Cell, Report
from srlrace.report.stats import clopper_pearson, wilson
from srlrace.report.tables import build_report
from srlrace.runs import State

SRL = Row("Forest", "srl", ("env=forest",), "ours")
NO_SAFETY = Row("Forest", "no safety", ("env=forest", "reward=no_safety"))
PAPER = Paper({"table": {"ours": {"train_map": PaperCell(7.31, 0.0)}}}, 51)


def experiment(*rows: Row, **settings: object) -> Experiment:
    return Experiment("table", "A table", rows, **({"suites": ("train_map",), "episodes": 4} | settings))  # type: ignore[arg-type]


def report(lab: SimpleNamespace, runs: list[Run], *rows: Row, **settings: object) -> Report:
    return build_report(runs, [experiment(*rows, **settings)], PAPER, lab.compose)


def only_cell(built: Report) -> Cell:
    (table,) = built.tables
    (cell,) = table.cells
    return cell


def test_a_cell_without_runs_names_its_sweep_and_the_papers_numbers(lab: SimpleNamespace) -> None:
    cell = only_cell(report(lab, [], SRL))
    assert cell.numbers is None
    assert cell.command == "srlrace sweep table"
    assert cell.paper == PaperCell(7.31, 0.0)


def test_a_trained_run_that_waits_for_its_evaluation_is_named(lab: SimpleNamespace) -> None:
    waiting = lab.run(lab.compose(SRL.overrides))
    cell = only_cell(report(lab, [waiting], SRL))
    assert cell.command == f"srlrace eval {waiting.id} --episodes 4 --suite train_map"


def test_means_are_taken_over_seeds_not_over_pooled_flights(lab: SimpleNamespace) -> None:
    config = lab.compose(SRL.overrides)
    runs = [
        lab.run(lab.with_seed(config, 0), lab.evaluation([5.0, 5.0, 5.0, None])),
        lab.run(lab.with_seed(config, 1), lab.evaluation([7.0, None, None, None])),
    ]
    numbers = only_cell(report(lab, runs, SRL)).numbers
    assert numbers is not None
    assert numbers.time_s is not None
    assert numbers.time_s.value == pytest.approx(6.0)  # pooled flights would give 5.5
    assert numbers.crash_pct.value == pytest.approx(50.0)
    assert numbers.penalised_time_s == pytest.approx(((15 + 20) / 4 + (7 + 60) / 4) / 2)
    assert (numbers.finished, numbers.crashed, numbers.episodes, numbers.seeds) == (4, 4, 8, (0, 1))


@pytest.mark.parametrize(
    "change",
    [
        {"reward": {"body_rate": 0.002}},
        {"quad": {"mass": 0.8}},
        {"curriculum": {"gate_starts": 0.123}},
        {"level": {"map_seed": 3}},
        {"baseline": "song"},
    ],
)
def test_one_changed_setting_makes_another_method(lab: SimpleNamespace, change: dict[str, object]) -> None:
    config = lab.compose(SRL.overrides)
    for part, value in change.items():
        old = getattr(config, part)
        config = replace(config, **{part: replace(old, **value) if isinstance(value, dict) else value})
    built = report(lab, [lab.run(config, lab.evaluation([5.0]))], SRL)
    assert only_cell(built).numbers is None
    assert [other.run for other in built.others] == [lab.run(config).id]


def test_a_label_does_not_make_another_method_nor_another_seed(lab: SimpleNamespace) -> None:
    config = lab.compose(SRL.overrides)
    plain = lab.run(config, lab.evaluation([5.0]))
    labelled = lab.run(replace(config, name="mine"), lab.evaluation([9.0]))
    assert only_cell(report(lab, [labelled], SRL)).runs == (labelled.id,)
    assert only_cell(report(lab, [labelled, plain], SRL)).runs == (plain.id,)


def test_budgets_are_never_mixed_and_the_others_are_named(lab: SimpleNamespace) -> None:
    config = lab.compose(SRL.overrides)
    small = [lab.run(lab.with_seed(config, seed, total_steps=1_000_000), lab.evaluation([9.0])) for seed in (0, 1)]
    large = [lab.run(lab.with_seed(config, seed, total_steps=2_000_000), lab.evaluation([5.0])) for seed in (0, 1)]
    built = report(lab, small + large, SRL)
    assert only_cell(built).runs == tuple(each.id for each in large)
    assert any("2 M steps" in note and "1 M steps" in note for note in only_cell(built).notes)
    assert {other.run for other in built.others} == {each.id for each in small}
    assert only_cell(report(lab, [*small, large[0]], SRL)).runs == tuple(each.id for each in small)


def test_an_unfinished_run_fills_no_cell_but_is_listed(lab: SimpleNamespace) -> None:
    stopped = lab.run(lab.compose(SRL.overrides), lab.evaluation([5.0]), state=State.INTERRUPTED)
    built = report(lab, [stopped], SRL)
    assert only_cell(built).numbers is None
    assert [other.run for other in built.others] == [stopped.id]


def test_one_seed_has_a_within_run_interval_and_says_so(lab: SimpleNamespace) -> None:
    cell = only_cell(report(lab, [lab.run(lab.compose(SRL.overrides), lab.evaluation([5.0, 6.0, None, 5.0]))], SRL))
    assert cell.numbers is not None
    crash = cell.numbers.crash_pct
    assert (crash.low / 100, crash.high / 100) == pytest.approx(wilson(1, 4))
    assert any("within-run only" in note for note in cell.notes)


def test_no_crash_in_five_seeds_is_bounded_by_one_run_not_by_the_pool(lab: SimpleNamespace) -> None:
    config = lab.compose(SRL.overrides)
    runs = [lab.run(lab.with_seed(config, seed), lab.evaluation([5.0] * 1000)) for seed in range(5)]
    numbers = only_cell(report(lab, runs, SRL)).numbers
    assert numbers is not None
    assert numbers.crash_pct.high / 100 == pytest.approx(clopper_pearson(0, 1000).high)


def test_flights_on_unseen_maps_are_clustered_by_map(lab: SimpleNamespace) -> None:
    """Ten maps, each always or never flown: ten trials, not a thousand."""
    times = [5.0 if i % 10 else None for i in range(1000)]
    flown = lab.evaluation(times, suite="level1", maps=[i % 10 for i in range(1000)])
    numbers = only_cell(report(lab, [lab.run(lab.compose(SRL.overrides), flown)], SRL, suites=("level1",))).numbers
    assert numbers is not None
    assert numbers.crash_pct.value == pytest.approx(10.0)
    assert numbers.crash_pct.high >= 30.0
    assert wilson(100, 1000).high < 0.13


def test_paired_rows_take_the_same_budget_and_common_seeds(lab: SimpleNamespace) -> None:
    on, off = lab.compose(SRL.overrides), lab.compose(NO_SAFETY.overrides)
    runs = [lab.run(lab.with_seed(on, seed), lab.evaluation([5.0 + seed])) for seed in (0, 1, 2)]
    runs += [lab.run(lab.with_seed(on, seed, total_steps=10**9), lab.evaluation([1.0])) for seed in range(5)]
    runs += [lab.run(lab.with_seed(off, seed), lab.evaluation([6.0 + seed])) for seed in (1, 2, 3)]
    (table,) = report(lab, runs, SRL, NO_SAFETY, paired="time").tables
    (comparison,) = table.comparisons
    assert comparison.seeds == 2
    assert comparison.difference.value == pytest.approx(-1.0)
    assert (comparison.difference.low, comparison.difference.high) == pytest.approx((-1.0, -1.0))
    assert len(table.cells[0].runs) == 3


BLIND = Row("Forest", "blind", ("env=forest", "observation=blind"))


def rated(lab: SimpleNamespace, row: Row, crashes: dict[str, int], seeds: tuple[int, ...] = (0, 1)) -> list[Run]:
    """Runs of a row that crash in so many of four flights of each suite, one more for every seed."""
    config = lab.compose(row.overrides)
    return [
        lab.run(
            lab.with_seed(config, seed),
            *(lab.evaluation([None] * (n + seed) + [5.0] * (4 - n - seed), suite=name) for name, n in crashes.items()),
        )
        for seed in seeds
    ]


def test_every_row_can_be_compared_with_the_last(lab: SimpleNamespace) -> None:
    flown = {SRL: {"level1": 3, "level2": 1}, NO_SAFETY: {"level1": 2, "level2": 2}, BLIND: {"level1": 1, "level2": 3}}
    runs = [run for row, crashes in flown.items() for run in rated(lab, row, crashes)]
    settings = {"suites": ("level1", "level2"), "paired": "crash", "pairs": "last_row"}
    (table,) = report(lab, runs, SRL, NO_SAFETY, BLIND, **settings).tables
    said = [(each.environment, each.first, each.second, each.difference.value) for each in table.comparisons]
    first, second = "Forest, unseen level 1", "Forest, unseen level 2"
    assert said == [
        (first, "srl", "blind", pytest.approx(50)),
        (first, "no safety", "blind", pytest.approx(25)),
        (second, "srl", "blind", pytest.approx(-50)),
        (second, "no safety", "blind", pytest.approx(-25)),
    ]


def test_the_gap_between_two_suites_is_taken_seed_by_seed(lab: SimpleNamespace) -> None:
    runs = rated(lab, SRL, {"train_map": 0, "unseen": 2, "level1": 3}) + rated(
        lab, BLIND, {"train_map": 1, "unseen": 1}
    )
    settings = {"suites": ("train_map", "unseen", "level1"), "paired": "crash", "pairs": "suites"}
    (table,) = report(lab, runs, SRL, BLIND, **settings).tables
    one, other = table.comparisons
    assert (one.environment, one.first, one.second) == ("Forest, srl", "unseen maps", "training maps")
    assert (one.difference.value, one.seeds) == (pytest.approx(50), 2)
    assert (other.environment, other.difference.value) == ("Forest, blind", pytest.approx(0))


def test_disturbed_cells_say_so_and_ask_for_their_suite(lab: SimpleNamespace) -> None:
    runs = rated(lab, SRL, {"level2": 0, "level2-wind5": 2})
    (table,) = report(lab, runs, SRL, suites=("level2", "level2-wind5", "level2-mass80")).tables
    calm, windy, light = table.cells
    assert calm.environment == "Forest, unseen level 2"
    assert windy.environment == "Forest, unseen level 2, wind 5 m/s"
    assert windy.t_ref_s == calm.t_ref_s is not None
    assert any("undisturbed" in note for note in windy.notes)
    assert not any("undisturbed" in note for note in calm.notes)
    assert light.command == f"srlrace eval {' '.join(run.id for run in runs)} --episodes 4 --suite level2-mass80"


def test_a_run_that_never_finishes_has_no_time(lab: SimpleNamespace) -> None:
    cell = only_cell(report(lab, [lab.run(lab.compose(SRL.overrides), lab.evaluation([None] * 4))], SRL))
    assert cell.numbers is not None
    assert cell.numbers.time_s is None
    assert cell.numbers.crash_pct.value == 100.0
    assert cell.numbers.penalised_time_s == 20.0


def test_a_cell_short_of_seeds_names_the_sweep_at_its_own_budget(lab: SimpleNamespace) -> None:
    config = lab.with_seed(lab.compose(SRL.overrides), 0, total_steps=123_000)
    cell = only_cell(report(lab, [lab.run(config, lab.evaluation([5.0]))], SRL))
    assert cell.command == "srlrace sweep table --steps 123000"
