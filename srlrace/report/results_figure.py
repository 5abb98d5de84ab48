"""What the tables say, as pictures: estimates with intervals beside the paper's numbers, and what flights were like."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from srlrace.report.collect import Evaluation
from srlrace.report.model import Cell, Estimate, Table
from srlrace.report.plots import Key, Panel, Plot, methods_keys
from srlrace.report.style import GATE, INK, MUTED, OUTCOME, series

Array = NDArray[np.float64]
Flown = Mapping[str, Sequence[Evaluation]]  # evaluations of each seed, by method

BINS = 40
LABEL_WIDTH = 32  # characters of a method's name in a line: more would leave no room for what is drawn
HEADING_WIDTH = 30  # characters; longer names of environments reach back over the names of methods
GATES = 40  # waypoints passed that a picture tells apart; more count as so many
TAILS = (0.5, 99.5)  # percentiles between which a histogram is drawn
PAPER_KEY = Key("the paper's", INK, marker="D")
T_REF_KEY = Key("T_ref, best known", GATE, marker="|")


def results_plot(table: Table) -> Plot | None:
    """Return time and crash ratio of a table's cells with their intervals; None where nothing was run."""
    cells = [cell for cell in table.cells if cell.numbers]
    if not cells:
        return None
    height = 0.75 + 0.3 * len(cells) + 0.2 * len({cell.environment for cell in cells})
    panels = tuple(
        Panel(partial(_draw_estimates, cells, quantity), _estimates_text(cells, quantity), (4.3, height))
        for quantity in ("time", "crash")
    )
    keys: tuple[Key, ...] = (Key("ours, 95 % interval", series(0)[0], marker="o"),)
    keys += (PAPER_KEY,) if table.experiment.paper_table else ()
    keys += (T_REF_KEY,) if any(cell.t_ref_s for cell in cells) else ()
    caption = "Means over training seeds with 95 % intervals."
    return Plot(f"{table.experiment.name}-results", table.experiment.title, caption, panels, keys=keys)


def flights_plot(methods: Flown, name: str, title: str, reference_s: float | None = None) -> Plot:
    """Return distributions of time and clearance over finished flights, and where the others ended."""
    clear = {method: [e.min_clearance_m[e.finished] for e in flown] for method, flown in methods.items()}
    timed = {method: [e.time_s[e.finished] for e in flown] for method, flown in methods.items()}
    panels = [
        Panel(partial(_draw_histograms, timed, "time of finished flights (s)", reference_s), _medians(timed, "s")),
        Panel(partial(_draw_histograms, clear, "least clearance of finished flights (m)", None), _medians(clear, "m")),
    ]
    failed = {method: _failures(flown, _gates(methods)) for method, flown in methods.items()}
    top = max(1.0, 1.08 * max(float(counts.sum(axis=0).max()) for counts in failed.values()))
    panels += [
        Panel(partial(_draw_failures, counts, top, method), _failures_text(methods[method], method))
        for method, counts in failed.items()
    ]
    keys = methods_keys(list(methods), [series(i) for i in range(len(methods))])
    keys += tuple(Key(outcome.replace("_", " "), colour, marker="s") for outcome, colour in OUTCOME.items())
    caption = (
        "Above: histograms, mean over seeds, bands from the lowest to the highest seed; each seed flew the same frozen "
        "initial conditions. Clearance is from the drone's hull to the nearest obstacle. Below: flights that did not "
        "finish, by the number of waypoints they had passed, per 1000 flights of a seed."
    )
    return Plot(name, title, caption, tuple(panels), columns=2, keys=keys)


def _draw_estimates(cells: Sequence[Cell], quantity: str, axes: Axes) -> None:
    labels: list[tuple[float, str]] = []
    position, environment = 0.0, ""
    x, side = (0, "left") if max(len(cell.environment) for cell in cells) <= HEADING_WIDTH else (1, "right")
    for cell in cells:
        position += 0.0 if not labels else 1.0 if cell.environment == environment else 1.7
        labels.append((position, fill(cell.method, LABEL_WIDTH)))
        if cell.environment != environment:
            environment = cell.environment
            axes.annotate(environment, (x, position - 0.55), xycoords=("axes fraction", "data"), color=INK, ha=side,
                          fontsize=8.5, fontweight="bold", va="bottom", in_layout=side == "left")  # fmt: skip
        _draw_estimate(axes, position, cell, quantity)
    axes.set_yticks([at for at, _ in labels], [text for _, text in labels])
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set(ylim=(position + 0.6, -1.1), title="time (s)" if quantity == "time" else "crash ratio (%)")
    axes.grid(axis="x")
    if quantity == "crash":
        axes.set_xlim(left=-0.03 * axes.get_xlim()[1])


def _draw_estimate(axes: Axes, y: float, cell: Cell, quantity: str) -> None:
    value, paper = _quantity(cell, quantity)
    if value:
        axes.plot([value.low, value.high], [y, y], color=series(0)[0], linewidth=2.2, solid_capstyle="butt")
        axes.plot([value.value], [y], "o", color=series(0)[0], markersize=5.5)
    if paper is not None:
        axes.plot([paper], [y], "D", color=INK, markersize=4.5, fillstyle="none", markeredgewidth=1.1)
    if quantity == "time" and cell.t_ref_s:
        axes.plot([cell.t_ref_s], [y], "|", color=GATE, markersize=11, markeredgewidth=1.8)


def _quantity(cell: Cell, quantity: str) -> tuple[Estimate | None, float | None]:
    assert cell.numbers is not None
    if quantity == "time":
        return cell.numbers.time_s, cell.paper.time_s
    return cell.numbers.crash_pct, cell.paper.crash_pct


def _estimates_text(cells: Sequence[Cell], quantity: str) -> str:
    unit = "s" if quantity == "time" else "%"
    parts = []
    for cell in cells:
        value, paper = _quantity(cell, quantity)
        ours = f"{value.value:.2f} {unit} [{value.low:.2f}, {value.high:.2f}]" if value else "none finished"
        parts.append(
            f"{cell.environment}, {cell.method}: {ours}" + (f", paper {paper:.2f}" if paper is not None else "")
        )
    return "; ".join(parts)


def _draw_histograms(values: Mapping[str, Sequence[Array]], label: str, reference: float | None, axes: Axes) -> None:
    known = [_known(seed) for seeds in values.values() for seed in seeds if len(_known(seed))]
    axes.set(title=label, yticks=[])
    axes.spines["left"].set_visible(False)
    if not known:
        axes.text(0.5, 0.5, "nothing to show", ha="center", color=MUTED, transform=axes.transAxes)
        return
    low = min(float(np.percentile(seed, TAILS[0])) for seed in known)
    high = max(float(np.percentile(seed, TAILS[1])) for seed in known)
    edges = np.linspace(low, max(high, low + 1e-3), BINS + 1)
    for i, seeds in enumerate(values.values()):
        drawn = np.array([np.histogram(_known(seed), edges)[0] / max(1, len(seed)) for seed in seeds if len(seed)])
        if len(drawn):
            colour, dashes = series(i)
            axes.stairs(drawn.mean(axis=0), edges, color=colour, linestyle=dashes, linewidth=1.5)
            axes.stairs(drawn.max(axis=0), edges, baseline=drawn.min(axis=0), fill=True, color=colour, alpha=0.18)
    if reference is not None:
        axes.axvline(reference, color=GATE, linewidth=1.4)
        axes.annotate("T_ref", (reference, 1), xycoords=("data", "axes fraction"), xytext=(3, -9),
                      textcoords="offset points", color=GATE, fontsize=8)  # fmt: skip
    axes.set_ylim(bottom=0)


def _failures(flown: Sequence[Evaluation], gates: int) -> Array:
    """Return (outcomes, gates + 1) unfinished flights per 1000, by how many waypoints they had passed."""
    counts = np.zeros((len(OUTCOME), gates + 1))
    for evaluation in flown:
        for row, outcome in zip(counts, OUTCOME, strict=True):
            passed = np.minimum(evaluation.gates_passed[evaluation.outcome == outcome], gates)
            row += np.bincount(passed, minlength=gates + 1)
    return 1000 * counts / max(1, sum(len(evaluation.outcome) for evaluation in flown))


def _draw_failures(counts: Array, top: float, method: str, axes: Axes) -> None:
    bottom = np.zeros(counts.shape[1])
    for row, colour in zip(counts, OUTCOME.values(), strict=True):
        axes.bar(np.arange(len(row)), row, bottom=bottom, color=colour, width=0.75, linewidth=0)
        bottom += row
    axes.set(title=f"{method}: not finished, per 1000", xlabel="waypoints passed", ylim=(0, top))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(axis="y")


def _gates(methods: Flown) -> int:
    passed = max((int(e.gates_passed.max(initial=0)) for flown in methods.values() for e in flown), default=0)
    return min(passed, GATES)


def _failures_text(flown: Sequence[Evaluation], method: str) -> str:
    failed = sum(int((~e.finished).sum()) for e in flown)
    early = sum(int(((~e.finished) & (e.gates_passed == 0)).sum()) for e in flown)
    return f"{method}: {failed} flights did not finish, {early} of them passed no waypoint"


def _medians(values: Mapping[str, Sequence[Array]], unit: str) -> str:
    parts = []
    for method, seeds in values.items():
        known = [_known(seed) for seed in seeds if len(_known(seed))]
        parts.append(
            f"{method} median {np.mean([np.median(k) for k in known]):.2f} {unit}" if known else f"{method} none"
        )
    return "; ".join(parts)


def _known(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])
