"""Colours and type of every figure, for the screen, for print and for the page's light and dark themes.

A figure is drawn in the colours of the light theme. Each of them has a name, which the page uses to give it another
value where the reader prefers a dark background.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib as mpl
from matplotlib.colors import ListedColormap

INK, MUTED, GRID = "#1d232a", "#58626d", "#dce1e6"
SOLID, CAP, HALO = "#aeb6be", "#c5cbd1", "#e6eaed"  # an obstacle, its upper face, the margin around it
GATE = "#b3420a"  # vermilion: told apart from the speeds' violet to green
SERIES = ("#0072b2", "#d55e00", "#009e73", "#aa4499", "#8a6a00", "#4f5bd5", "#a51e37")  # after Okabe and Ito
DASHES = ("-", (0, (5, 2)), (0, (6, 2, 1, 2)), (0, (1.5, 1.5)), (0, (8, 3)), (0, (3, 1)), (0, (6, 1, 1, 1, 1, 1)))
SPEEDS = (  # viridis at 0 to 0.88 of its range: ordered in greyscale too
    "#440154", "#472071", "#423c81", "#38558c", "#2d6d8e", "#24848e", "#1e9b8a", "#2ab07f", "#50c46a", "#86d449",
)  # fmt: skip
OUTCOME = {"crashed": SERIES[1], "out_of_bounds": SERIES[0], "timeout": SERIES[4], "diverged": SERIES[3]}

DARK_SERIES = ("#56b4e9", "#ff9040", "#2fd0a0", "#e08bd4", "#e3c24a", "#98a2ff", "#ff8095")
DARK_SPEEDS = (
    "#6a5bc0", "#5a78cf", "#4692d0", "#35a8c8", "#2cbcb5", "#37cd98", "#5fda7a", "#90e35a", "#c3e83f", "#fde725",
)  # fmt: skip
DARK = {  # what each colour becomes on a dark background
    INK: "#e8ebee", MUTED: "#a3adb7", GRID: "#343c45", SOLID: "#66707a", CAP: "#7d8791", HALO: "#2b3239",
    GATE: "#ff9d5c", **dict(zip(SERIES, DARK_SERIES, strict=True)), **dict(zip(SPEEDS, DARK_SPEEDS, strict=True)),
}  # fmt: skip
NAMES = {colour: f"--c{i}" for i, colour in enumerate(DARK)}  # of the page's variables, by light colour

SPEED_MAP = ListedColormap(SPEEDS, name="speed")
SETTINGS: dict[Any, Any] = {
    "text.parse_math": False,  # a dollar in a name is a dollar
    "font.size": 9.0,
    "font.family": "sans-serif",
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,  # text stays text in a paper
    "svg.hashsalt": "srlrace",
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw and save figures in this style."""
    with mpl.rc_context({**mpl.rcParamsDefault, **SETTINGS, "backend": "agg"}):
        yield


def series(index: int) -> tuple[str, object]:
    """Return colour and dashes of the i-th method: told apart in greyscale by the dashes as well."""
    return SERIES[index % len(SERIES)], DASHES[index % len(DASHES)]
