"""`srlrace runs --watch`: follow runs from their files alone, whoever trains them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from srlrace.console import out
from srlrace.runs import RunFolder, State
from srlrace.tables import STYLES, brief
from srlrace.text import clean, duration

LOOK_EVERY = 2.0  # s between looks at the files
BAR_WIDTH = 12  # characters
WIDE = 100  # characters of a terminal that has room for bars
STEP = 10  # percent of a training between two lines where there is no terminal

List = Callable[[], Iterable[RunFolder]]


@dataclass(frozen=True)
class Seen:
    """A run at one moment."""

    id: str
    state: State
    done: float  # share of the training
    left_s: float | None  # until the training's end, while it goes on
    result: str

    @property
    def news(self) -> tuple[object, ...]:
        """What is worth a new line when it differs."""
        return self.state, int(100 * self.done) // STEP, "" if self.state is State.TRAINING else self.result


def look(run: RunFolder) -> Seen:
    """Read a run's files once."""
    progress, state = run.progress, run.state
    total = run.config.algo.total_steps if run.config else 0
    steps, wall = progress.get("steps", 0.0), progress.get("wall_s", 0.0)
    done = min(1.0, steps / total) if total else 0.0
    left = (total - steps) * wall / steps if state is State.TRAINING and steps > 0 else None
    return Seen(run.id, state, done, left, _result(run, progress))


def _result(run: RunFolder, progress: dict[str, float]) -> str:
    results = [brief(suite, summary) for suite, summary in run.results.items()]
    if results or "success_ratio" not in progress:
        return "; ".join(results)
    time_s = f", {progress['time_s']:.2f} s" if progress.get("time_s") else ""
    return f"{100 * progress['success_ratio']:.0f} % finished{time_s}"


def watch(runs: List, console: Console = out, pause: Callable[[float], None] = time.sleep) -> None:
    """Show the runs again and again until Ctrl-C: a live table on a terminal, elsewhere a line for each change."""
    try:
        if console.is_terminal:
            _watch_live(runs, console, pause)
        else:
            _watch_lines(runs, console, pause)
    except KeyboardInterrupt:
        return


def _watch_live(runs: List, console: Console, pause: Callable[[float], None]) -> None:
    with Live(console=console, auto_refresh=False, screen=False) as live:
        while True:
            live.update(picture([look(run) for run in runs()], console.height, console.width), refresh=True)
            pause(LOOK_EVERY)


def _watch_lines(runs: List, console: Console, pause: Callable[[float], None]) -> None:
    told: dict[str, tuple[object, ...]] = {}
    while True:
        for seen in map(look, runs()):
            if told.get(seen.id) != seen.news:
                told[seen.id] = seen.news
                console.print(line(seen), markup=False, highlight=False, soft_wrap=True)
        pause(LOOK_EVERY)


def line(seen: Seen) -> str:
    """Return a run in one line."""
    words = [seen.id, str(seen.state), f"{100 * seen.done:.0f} %"]
    words += [f"{duration(seen.left_s)} left"] if seen.left_s is not None else []
    return clean("  ".join([*words, seen.result]).rstrip())


def picture(seen: list[Seen], height: int = 1000, width: int = WIDE) -> Group:
    """Return the table: those in training first, then what is waiting, then the rest, as many as fit."""
    order = (State.TRAINING, State.FAILED, State.INTERRUPTED, State.NEW, State.FINISHED)
    ordered = sorted(seen, key=lambda one: (order.index(one.state), one.id))
    room = max(3, height - 5)
    table = Table("run", "state", "", "trained", "left", "result", box=None, pad_edge=False)
    for column, least in zip(table.columns, (0, 11, 0, 7, 4, 0), strict=True):
        column.no_wrap, column.min_width = True, least
    for one in ordered[:room]:
        state = Text(str(one.state), STYLES.get(one.state, ""))
        left = "" if one.left_s is None else duration(one.left_s)
        bar = ProgressBar(1.0, one.done, width=BAR_WIDTH) if width >= WIDE else ""
        table.add_row(Text(clean(one.id)), state, bar, f"{100 * one.done:.0f} %", left, Text(clean(one.result)[:200]))
    hidden = [Text(f"... and {len(ordered) - room} more", style="dim")] if len(ordered) > room else []
    return Group(summary(seen), Text(), table, *hidden)


def summary(seen: list[Seen]) -> Text:
    """Return how many runs are in each state, how much of all the training is done, and how long the longest takes."""
    counts = {state: sum(one.state is state for one in seen) for state in State}
    words = [f"{count} {state}" for state, count in counts.items() if count]
    done = sum(one.done for one in seen) / len(seen) if seen else 0.0
    left = [one.left_s for one in seen if one.left_s is not None]
    ending = f", {duration(max(left))} until those in training end" if left else ""
    return Text(f"{len(seen)} runs: {', '.join(words) or 'none yet'}; {100 * done:.0f} % trained{ending}", style="bold")
