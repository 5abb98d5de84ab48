"""Flights held against the time-optimal reference of the maps that they flew, not of others."""

from __future__ import annotations

import pytest

from srlrace.report import reference
from srlrace.report.experiments import Experiment, Paper, Row
from srlrace.report.numbers import cell_numbers
from srlrace.report.tables import build_report


@pytest.fixture
def mixed(lab):
    return lab.compose(("env=forest", "level=mixed"))


def test_each_flight_is_held_against_its_own_map(lab, mixed, monkeypatch):
    """Worked by hand: per seed the mean over finished flights, then the mean over seeds, on both sides."""
    monkeypatch.setattr(reference, "_unseen", lambda config, suite: {11: 4.0, 12: 5.0})
    first = lab.evaluation([4.4, 5.5, None, 4.6], "level3", [11, 12, 12, 11])
    second = lab.evaluation([None, 6.0], "level3", [11, 12])
    found = reference.compare(mixed, "level3", [first, second])
    assert found.t_ref_s == pytest.approx(((4.0 + 5.0 + 4.0) / 3 + 5.0) / 2)
    assert found.flown_s == pytest.approx(((4.4 + 5.5 + 4.6) / 3 + 6.0) / 2)
    assert found.flown_s == pytest.approx(cell_numbers([(0, first), (1, second)]).time_s.value)
    assert not any("not solved" in note for note in found.notes)


def test_flights_on_maps_without_a_solution_are_left_out_and_counted(lab, mixed, monkeypatch):
    monkeypatch.setattr(reference, "_unseen", lambda config, suite: {11: 4.0, 12: None})
    flown = lab.evaluation([4.4, 9.0, 9.0], "level3", [11, 12, 13])
    found = reference.compare(mixed, "level3", [flown])
    assert (found.t_ref_s, found.flown_s) == (4.0, 4.4)
    assert "2 of the 3 maps are not solved" in found.notes[0]


def test_the_gap_of_a_cell_is_that_of_the_flights_compared(lab, monkeypatch):
    """The mean time of the cell is over all finished flights; its gap is not."""
    monkeypatch.setattr(reference, "_unseen", lambda config, suite: {11: 4.0})
    row = Row("Forest", "ours", ("env=forest", "level=mixed"))
    run = lab.run(lab.compose(row.overrides), lab.evaluation([4.4, 9.0], "level3", [11, 12]))
    table = Experiment("table", "A table", (row,), suites=("level3",), episodes=2)
    [cell] = build_report([run], [table], Paper({}, 51), lab.compose).tables[0].cells
    assert cell.numbers.time_s.value == pytest.approx(6.7)
    assert cell.gap_pct == pytest.approx(10.0)
    assert any("1 of the 2 maps are not solved" in note for note in cell.notes)


def test_where_no_map_is_solved_the_open_track_stands_in(lab, mixed, monkeypatch):
    monkeypatch.setattr(reference, "_unseen", lambda config, suite: {11: None})
    found = reference.compare(mixed, "level1", [lab.evaluation([5.0], "level1", [11])])
    assert 4.5 < found.t_ref_s < 4.6
    assert found.flown_s is None
    assert found.notes == (reference.OPEN,)


def test_without_flights_it_is_the_mean_over_the_solved_maps(mixed, monkeypatch):
    monkeypatch.setattr(reference, "_unseen", lambda config, suite: {11: 4.0, 12: 5.0, 13: None})
    found = reference.compare(mixed, "level2", [])
    assert (found.t_ref_s, found.flown_s) == (4.5, None)
