"""Runs in the terminal: the list, one run's page, one evaluation's line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rich.table import Table
from rich.text import Text

from srlrace.catalogue import SETTINGS
from srlrace.config import Config, ConfigError, method_name, to_dict
from srlrace.parse import nearest
from srlrace.runs import RunFolder, State
from srlrace.text import clean

LONG = 1000  # rows of a list that nobody reads from top to bottom
STYLES = {State.FINISHED: "green", State.TRAINING: "cyan", State.INTERRUPTED: "yellow", State.FAILED: "red"}
SHORT = (
    "id",
    "state",
    "method",
    "env",
    "level",
    "reward",
    "observation",
    "quad",
    "randomization",
    "curriculum",
    "algo",
)


def text(value: object, style: str = "") -> Text:
    """Anything from a file, as it may be shown: no markup, no control characters, not endless."""
    return Text(clean(value)[:2000], style=style)


def runs_text(runs: Sequence[RunFolder]) -> str:
    """What `runs_table` shows, as plain lines: laying out ten thousand rows takes longer than reading the runs."""
    rows = [[cell.replace("\n", ", ") for cell in _row(run)] for run in runs]
    widths = [max(len(row[column]) for row in rows) for column in range(3)] + [0]
    return "\n".join("  ".join(map(str.ljust, row, widths)) for row in rows)


def runs_table(runs: Sequence[RunFolder]) -> Table:
    """One row a run: id, state, how far, and what evaluations said, or training while there is none."""
    table = Table("run", "state", "trained", "result", box=None, pad_edge=False)
    for column in table.columns[:3]:
        column.no_wrap = True  # an id is there to be copied
    for run in runs:
        name, state, trained, result = _row(run)
        table.add_row(Text(name), Text(state, STYLES.get(State(state), "")), Text(trained), Text(result))
    return table


def _row(run: RunFolder) -> tuple[str, str, str, str]:
    state = run.state
    results = "\n".join(clean(brief(suite, summary))[:200] for suite, summary in run.results.items())
    total = run.config.algo.total_steps if run.config else None
    done = state is State.FINISHED and results and total
    progress = {"steps": float(total or 0)} if done else run.progress
    return clean(run.id), str(state), _steps(total, progress), results or _training(progress)


def _steps(total: int | None, progress: dict[str, float]) -> str:
    steps = progress.get("steps")
    if steps is None or not total:
        return "-" if total else "config.json is not valid"
    return f"{steps / 1e6:.4g} M, {min(100, 100 * steps / total):.0f} %"


def _training(progress: dict[str, float]) -> str:
    if "success_ratio" not in progress or "crash_ratio" not in progress:
        return "-"
    return f"training: {100 * progress['success_ratio']:.0f} %, crash {100 * progress['crash_ratio']:.0f} %"


def brief(suite: str, summary: dict[str, Any]) -> str:
    """An evaluation in a few words."""
    outcomes = summary.get("outcomes")
    finished = outcomes.get("finished", 0) if isinstance(outcomes, dict) else "?"
    time = summary.get("time_mean_s")  # None where no flight finished
    timed = f" in {time:.2f} s" if isinstance(time, int | float) else ""
    return f"{suite} {finished}/{summary.get('episodes', '?')}{timed}"


def evaluation_text(name: str, summary: dict[str, Any]) -> Text:
    """An evaluation's outcome in one line."""
    crash = summary.get("crash_ratio")
    crashed = f", crash ratio {100 * crash:.2f} %" if isinstance(crash, int | float) else ""
    return text(f"{name}: {brief(str(summary.get('suite')), summary)}{crashed}")


def learning_table(name: str, rows: Sequence[dict[str, Any]], episodes: int) -> Table:
    """What the policies kept along a training did: one row each."""
    table = Table("steps", "finished", "crashed", "time, s", title=clean(name), title_justify="left")
    for row in rows:
        time = "-" if row["time_s"] is None else f"{row['time_s']:.2f}"
        finished, crashed = (f"{row[key]}/{episodes}" for key in ("finished", "crashed"))
        table.add_row(f"{row['steps'] / 1e6:.2f} M", finished, crashed, time)
    return table


def filtered(runs: Sequence[RunFolder], filters: Sequence[str]) -> list[RunFolder]:
    """The runs that meet every ``name=value``; raises `ConfigError` for a name that no run has."""
    wanted = dict(_split(word) for word in filters)
    return [run for run in runs if all(matches(run, name, value) for name, value in wanted.items())]


def _split(word: str) -> tuple[str, str]:
    name, equals, value = word.partition("=")
    valid = (*SHORT, *SETTINGS)
    if not equals or name not in valid:
        raise ConfigError(f"--filter: got {word!r}; takes name=value of a setting, or of state{nearest(name, valid)}")
    return name, value


def matches(run: RunFolder, name: str, value: str) -> bool:
    """Whether a run's setting, state or method has this value."""
    if name == "state":
        return str(run.state) == value
    if name == "id":
        return run.id.startswith(value)
    return run.config is not None and setting_text(run.config, name) == value


def setting_text(config: Config, name: str) -> str:
    """A setting, or the preset of a group, as text."""
    if name == "method":
        return method_name(config)
    value: Any = to_dict(config)
    for part in name.split("."):
        value = value[part]
    if isinstance(value, dict):
        value = value["name"]
    return str(value).lower() if isinstance(value, bool) else str(value)


def run_page(run: RunFolder) -> Iterator[Table | Text]:
    """A run's state, origin, results and settings."""
    state = run.state
    yield Text.assemble(text(run.id, "bold"), "  ", (str(state), STYLES.get(state, "")))
    yield _pairs({"folder": run.path.resolve(), **run.info})
    for suite, summary in run.evaluations.items():
        yield Text()
        yield text(f"eval/{suite}", "bold")
        yield _pairs(summary)
    yield Text()
    yield text("settings", "bold")
    config = run.load_config()
    table = Table("setting", "value", "unit", "meaning", box=None, pad_edge=False)
    for path, setting in SETTINGS.items():
        about = setting.field.metadata
        table.add_row(path, text(setting_text(config, path)), about["unit"], about["meaning"])
    yield table


def _pairs(data: dict[str, Any], prefix: str = "") -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    for name, value in _flat(data, prefix):
        table.add_row(text(name), text(value))
    return table


def _flat(data: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, dict) and prefix.count(".") < 3:
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, " ".join(map(str, value)) if name == "argv" and isinstance(value, list) else value
