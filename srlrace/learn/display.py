"""What a person sees of a training: a live panel on a terminal, plain lines elsewhere, and always ``train.log``."""

from __future__ import annotations

import logging
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from srlrace.config import Config, CurriculumConfig
from srlrace.console import err, logged
from srlrace.learn.progress import figures_text
from srlrace.task.race import phase_of
from srlrace.text import duration

LOG = "train.log"
LINE_EVERY = 10.0  # s between plain lines
REDRAW_EVERY = 0.2  # s between two pictures: drawing one takes 2 ms
BAR_WIDTH = 44  # characters: with the figures beside it the line fits a terminal of 80
RECENT = 20  # rows of progress whose mean speed foretells the end
BLOCKS = "▁▂▃▄▅▆▇█"
TREND = 32  # characters of a trend over all of the training so far
FIGURES = (  # what the panel shows: label, column, factor, format, style
    ("finished", "success_ratio", 100.0, "{:.1f} %", "green"),
    ("crashed", "crash_ratio", 100.0, "{:.1f} %", "red"),
    ("time of finished", "time_s", 1.0, "{:.2f} s", "cyan"),
    ("waypoints passed", "gates_passed", 1.0, "{:.1f}", "blue"),
    ("reward per step", "reward", 1.0, "{:.3f}", "magenta"),
)

logger = logging.getLogger(__name__)


class Display:
    """Shows a run's progress while the ``with`` statement lasts; ``folder`` gets its log."""

    def __init__(self, config: Config, folder: Path, console: Console = err) -> None:
        self._config, self._folder, self._console = config, folder, console
        self._total = config.algo.total_steps
        self._rows: list[dict[str, Any]] = []
        self._speeds: deque[float] = deque(maxlen=RECENT)
        self._last_line, self._drawn = -LINE_EVERY, 0.0
        self._live = Live(console=console, auto_refresh=False, transient=True)  # no thread that takes time from torch
        self._open = ExitStack()

    def __enter__(self) -> Display:
        self._log = self._open.enter_context(logged(self._folder / LOG))
        if self._console.is_terminal:
            self._open.enter_context(self._live)
        return self

    def __exit__(self, *exc: object) -> None:
        self._open.close()

    def show(self, row: dict[str, Any]) -> None:
        """Show the newest row of progress."""
        self.add(row)
        if self._console.is_terminal and time.monotonic() - self._drawn >= REDRAW_EVERY:
            self._live.update(self.panel(), refresh=True)
            self._drawn = time.monotonic()
        if row["wall_s"] - self._last_line >= LINE_EVERY or row["steps"] >= self._total:
            self._last_line = row["wall_s"]
            self._say(self.line())

    def add(self, row: dict[str, Any]) -> None:
        """Take in a row of progress without showing anything."""
        self._rows.append(row)
        self._speeds.append(row["steps_per_s"])

    def line(self) -> str:
        """Return the newest row in one line."""
        row = self._rows[-1]
        percent, millions = 100 * row["steps"] / self._total, row["steps"] / 1e6
        left = f"{self._left()} left{self._then()}"
        return f"{self._folder.name}  {percent:3.0f}%  {millions:.2f} M steps  {figures_text(row)}  {left}"

    def panel(self) -> Group:
        """Return the live picture: how far, how fast, which phase, and how each figure has developed."""
        row = self._rows[-1]
        head = Table.grid(padding=(0, 1))
        bar = ProgressBar(self._total, row["steps"], width=BAR_WIDTH)
        far = f"{100 * row['steps'] / self._total:.0f} %  {row['steps'] / 1e6:.1f}/{self._total / 1e6:.1f} M"
        head.add_row(bar, Text(far, style="bold"), Text(f"{self._left()} left"))
        body = Table.grid(padding=(0, 2))
        body.add_column(min_width=16)
        body.add_column(justify="right", min_width=9)
        for label, column, scale, form, style in FIGURES:
            value = row.get(column)
            shown = Text("-" if value is None else form.format(scale * value), style="bold")
            body.add_row(Text(label, style="dim"), shown, Text(trend([r.get(column) for r in self._rows]), style=style))
        speed = f"{sum(self._speeds) / len(self._speeds) / 1e3:.0f} k steps/s"
        phase = phase_text(self._config.curriculum, row["steps"] / self._total)
        about = Text(f"{speed}; {phase}{self._then()}", style="dim")
        return Group(Text(self._folder.name, style="bold"), head, body, about)

    def _left(self) -> str:
        speed = sum(self._speeds) / len(self._speeds)
        return duration((self._total - self._rows[-1]["steps"]) / speed) if speed > 0 else "?"

    def _then(self) -> str:
        """What follows on the last step."""
        rounds = self._config.curriculum.polish_rounds
        return f", then {rounds} rounds of polish" if rounds else ""

    def _say(self, text: str) -> None:
        """Log a line; on a terminal, where the panel says the same, to the file only."""
        if self._console.is_terminal:
            self._log.handle(logger.makeRecord(logger.name, logging.INFO, __file__, 0, text, (), None))
        else:
            logger.info("%s", text)


def phase_text(curriculum: CurriculumConfig, done: float) -> str:
    """Return what the curriculum does at this share of the training, in words."""
    phase = phase_of(curriculum, done)
    words = ["costs in full" if phase.costs >= 1.0 else f"costs at {100 * phase.costs:.0f} %"]
    if (smaller := curriculum.obstacle_ease * phase.ease) > 0:
        words.append(f"obstacles {smaller:.2f} m smaller")
    if (larger := curriculum.waypoint_ease * phase.ease) > 0:
        words.append(f"waypoints {larger:.2f} m larger")
    if (staged := (curriculum.gate_starts + curriculum.memory_starts) * phase.staged) > 0:
        words.append(f"{100 * staged:.0f} % of starts along the course")
    if (hard := curriculum.hard_starts * phase.hard) > 0:
        words.append(f"{100 * hard:.0f} % before earlier crashes")
    if curriculum.escape_starts > 0:
        words.append(f"{100 * curriculum.escape_starts:.0f} % at hard starts")
    return "curriculum: " + ", ".join(words)


def trend(values: list[float | None]) -> str:
    """Return values over time as a row of blocks between their extremes; a gap where there is none."""
    known = [value for value in values if value is not None]
    if not known:
        return ""
    width = min(TREND, len(values))
    low, high = min(known), max(known)
    parts = (values[i * len(values) // width : (i + 1) * len(values) // width] for i in range(width))
    means = (_mean([value for value in part if value is not None]) for part in parts)
    span = (high - low) or 1.0
    return "".join(" " if mean is None else BLOCKS[round((len(BLOCKS) - 1) * (mean - low) / span)] for mean in means)


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None
