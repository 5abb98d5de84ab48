"""The picture of a table has room for its rows' names."""

import warnings

import pytest

from srlrace.report.experiments import PaperCell
from srlrace.report.model import Cell, Estimate, Numbers
from srlrace.report.plots import Panel, panel_figure
from srlrace.report.results_figure import _draw_estimates


@pytest.mark.parametrize(
    ("environment", "method"),
    [
        ("Forest, unseen level 1", "srl_tuned, facing, 1000 training maps, random plant and waypoints"),
        ("Forest, unseen level 2, estimate noise 0.05 m, 0.1 m/s, 0.02 rad", "random plant and waypoints"),
    ],
)
def test_long_names_leave_room_for_what_is_drawn(environment: str, method: str) -> None:
    one = Estimate(1.0, 0.5, 2.0)
    numbers = Numbers(one, None, one, None, 20.0, 9, 0, 9, (0,))
    cells = [Cell(environment, method, "level1", PaperCell(), "", numbers)] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = panel_figure(Panel(lambda axes: _draw_estimates(cells, "crash", axes), "", (4.3, 1.85)))
    assert figure.axes[0].get_position().width > 0.3
