"""The report's sentences say what its cells say."""

import pytest

from srlrace.report.experiments import PaperCell
from srlrace.report.model import Cell, Comparison, Estimate, Numbers
from srlrace.report.page.findings import _fastest, _gap, _safest
from srlrace.report.page.tables import comparison_text


def cell(method: str, time_s: float | None, t_ref_s: float | None) -> Cell:
    time = None if time_s is None else Estimate(time_s, time_s, time_s)
    crash = Estimate(0.0, 0.0, 0.0)
    numbers = Numbers(time, None, crash, None, 20.0, 9, 0, 9, (0,))
    return Cell("Forest", method, "level1", PaperCell(None, None), "", numbers, t_ref_s)


@pytest.mark.parametrize(
    ("cells", "sentence"),
    [
        ([cell("a", 5.0, 4.0), cell("b", 6.0, 4.0)], " Slower than the best known time of 4.00 s by: a 25 %, b 50 %."),
        (
            [cell("a", 5.0, 4.0), cell("b", 7.5, 5.0), cell("none finished", None, 9.0), cell("unsolved", 7.0, None)],
            " Slower than the best known times of 4.00 or 5.00 s by: a 25 %, b 50 %.",
        ),
        ([cell("unsolved", 7.0, None)], ""),
    ],
)
def test_the_gap_names_the_reference_that_it_is_measured_from(cells: list[Cell], sentence: str) -> None:
    assert _gap(cells) == sentence


def test_a_name_that_ends_in_a_full_stop_ends_the_sentence() -> None:
    cells = [cell("srl", 5.0, None), cell("Song et al.", 5.0, None)]
    assert _fastest(cells).endswith("(9 of 9 flights finished), not clearly ahead of Song et al.")


def test_a_name_with_commas_stands_in_quotes() -> None:
    cells = [cell("srl, shown a flight", 5.0, 4.0), cell("srl", 6.0, 4.0)]
    assert _fastest(cells).startswith("“srl, shown a flight” is fastest")
    assert _safest(cells) == "“srl, shown a flight” and srl crash in none of the evaluated flights."
    assert _gap(cells).endswith("by: “srl, shown a flight” 25 %, srl 50 %.")
    difference = Comparison("Forest", "srl, shown a flight", "srl", "time", 5, Estimate(-0.5, -0.6, -0.4))
    assert comparison_text(difference).startswith("Forest, “srl, shown a flight” against srl: a difference in time of")
    assert comparison_text(difference).endswith("“srl, shown a flight” has the lower time.")
