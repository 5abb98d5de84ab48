"""The picture of a table has room for its rows' names."""

import warnings

from srlrace.report.experiments import PaperCell
from srlrace.report.model import Cell, Estimate, Numbers
from srlrace.report.plots import Panel, panel_figure
from srlrace.report.results_figure import _draw_estimates


def test_a_long_name_leaves_room_for_what_is_drawn() -> None:
    method = "srl_tuned, facing, 1000 training maps, random plant and waypoints"
    one = Estimate(1.0, 0.5, 2.0)
    numbers = Numbers(one, None, one, None, 20.0, 9, 0, 9, (0,))
    cells = [Cell("Forest, unseen level 1", method, "level1", PaperCell(), "", numbers)] * 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = panel_figure(Panel(lambda axes: _draw_estimates(cells, "crash", axes), "", (4.3, 1.85)))
    assert figure.axes[0].get_position().width > 0.3
