"""A plot is a few panels drawn by functions: side by side in one file for a paper, each by itself on the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from srlrace.report.style import SPEED_MAP

PANEL = (4.3, 2.6)  # inches: on a telephone the type of a panel keeps about its size


@dataclass(frozen=True)
class Key:
    """An entry of a legend."""

    label: str
    colour: str
    dashes: object = "-"
    marker: str = ""  # matplotlib's name; empty for a line


@dataclass(frozen=True)
class Panel:
    """One pair of axes, and what it shows in words for whoever cannot see it."""

    draw: Callable[[Axes], None]
    alt: str
    size: tuple[float, float] = PANEL  # inches


@dataclass(frozen=True)
class Plot:
    """Panels that belong together."""

    name: str  # of its files
    title: str
    caption: str
    panels: tuple[Panel, ...]
    columns: int = 2
    keys: tuple[Key, ...] = ()
    speed_mps: float = 0.0  # upper end of the scale of speeds, where there is one


def figure_of(plot: Plot) -> Figure:
    """Draw all panels of a plot into one figure."""
    columns = min(plot.columns, len(plot.panels))
    rows = -(-len(plot.panels) // columns)
    width = sum(panel.size[0] for panel in plot.panels[:columns])
    heights = [max(panel.size[1] for panel in plot.panels[r * columns : (r + 1) * columns]) for r in range(rows)]
    figure = Figure(figsize=(width, sum(heights) + 0.7), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, height_ratios=heights).ravel()
    for axes, panel in zip(grid, plot.panels, strict=False):
        panel.draw(axes)
    for axes in grid[len(plot.panels) :]:
        axes.set_axis_off()
    if plot.keys:
        figure.legend(handles=list(map(_handle, plot.keys)), loc="outside lower center", ncols=min(4, len(plot.keys)))
    if plot.speed_mps:
        scale = ScalarMappable(Normalize(0.0, plot.speed_mps), SPEED_MAP)
        figure.colorbar(scale, ax=list(grid), label="speed (m/s)", shrink=0.4, aspect=40, pad=0.01)
    figure.suptitle(plot.title, fontsize=10.5, x=0.01, ha="left")
    return figure


def panel_figure(panel: Panel) -> Figure:
    """Draw one panel by itself."""
    figure = Figure(figsize=panel.size, layout="constrained")
    panel.draw(figure.add_subplot())
    engine = figure.get_layout_engine()
    assert engine is not None
    engine.execute(figure)
    figure.set_layout_engine("none")  # saving would lay it out, and draw it, once more
    return figure


def methods_keys(labels: Sequence[str], styles: Sequence[tuple[str, object]]) -> tuple[Key, ...]:
    """Return a legend entry per method."""
    return tuple(Key(label, colour, dashes) for label, (colour, dashes) in zip(labels, styles, strict=True))


def _handle(key: Key) -> Line2D:
    if key.marker:
        return Line2D([], [], color=key.colour, marker=key.marker, linestyle="", label=key.label)
    return Line2D([], [], color=key.colour, linestyle=key.dashes, label=key.label)  # type: ignore[arg-type]
