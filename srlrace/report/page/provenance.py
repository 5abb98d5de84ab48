"""Where every number comes from: the runs of each cell seed by seed, and what each run was."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from srlrace.config import to_dict
from srlrace.report.collect import Run
from srlrace.report.layout import number
from srlrace.report.model import Cell, Report, Table
from srlrace.report.page.findings import seeds_of
from srlrace.report.page.html import Html, scrolling, tag
from srlrace.report.page.tables import cell_anchor
from srlrace.runs import TABLES, RunFolder

SETTINGS_SHOWN = 20_000  # characters; a track of ten thousand obstacles is not printed in full
FACTS = (
    ("started", "started"), ("steps", "environment steps"), ("train_wall_s", "training, wall-clock (s)"),
    ("cpu", "processor"), ("cores", "cores"), ("threads", "torch threads"), ("platform", "platform"),
)  # fmt: skip


def cells_html(report: Report, runs: dict[str, Run]) -> Html:
    """Return one section per cell: per-seed values, runs, settings, and the command that fills it."""
    return tag("div", *(_cell(table, i, cell, runs) for table in report.tables for i, cell in enumerate(table.cells)))


def _cell(table: Table, index: int, cell: Cell, runs: dict[str, Run]) -> Html:
    title = f"{cell.method}, {cell.environment}"
    source = tag(
        "p",
        f"{table.experiment.title}; suite {cell.suite}; one row of ",
        tag("code", f"{table.experiment.name}.csv"),
        ".",
    )
    parts = [tag("h4", title), source]
    if cell.numbers:
        rows = (_seed(cell, *seed) for seed in seeds_of(cell, runs))
        names = ("Seed", "Run", "Time (s)", "Crash (%)", "Finished")
        head = tag("thead", tag("tr", *(tag("th", name, scope="col") for name in names)))
        parts.append(
            scrolling(tag("table", tag("caption", f"Seed by seed: {title}"), head, tag("tbody", *rows)), title)
        )
        parts += [tag("p", f"{note}.") for note in cell.notes]
    if cell.paper.time_s is not None or cell.paper.crash_pct is not None:
        parts.append(
            tag("p", f"The paper's numbers: {table.experiment.paper_table}, in ", tag("code", "conf/paper.yaml"), ".")
        )
    parts.append(tag("p", "Filled, or completed, by ", tag("code", cell.command)))
    return tag("section", *parts, id=cell_anchor(table, index), class_="provenance")


def _seed(cell: Cell, seed: int, run: Run, time: float | None, crash: float) -> Html:
    evaluation = run.evaluations[cell.suite]
    link = tag("a", run.id, href=f"#run-{run.id}")
    finished = f"{int(evaluation.finished.sum())}/{len(evaluation.episode)}"
    values = (link, number(time), f"{crash:.2f}", finished)
    return tag("tr", tag("th", seed, scope="row"), *(tag("td", value) for value in values))


def runs_html(runs: dict[str, Run]) -> Html:
    """Return one section per run: command, versions, machine, files, settings."""
    return tag("div", *(_run(run) for run in runs.values()))


def _run(run: Run) -> Html:
    folder = RunFolder(run.path)
    info = folder.info
    argv = info.get("argv")
    rows: list[tuple[str, object]] = [
        ("command", tag("code", " ".join(map(str, argv)) if isinstance(argv, list) else "unknown"))
    ]
    rows += [("state", run.state), ("seed", run.config.seed)]
    rows += [(label, _fact(info[key])) for key, label in FACTS if isinstance(info.get(key), str | int | float)]
    rows += [("source", _source(info.get("git"))), ("versions", _versions(info.get("versions")))]
    rows.append(("files", ", ".join(_files(folder))))
    facts = tag("dl", *(part for name, value in rows for part in (tag("dt", name), tag("dd", value))))
    settings = tag("pre", _settings(run), tabindex="0")
    more = tag("details", tag("summary", "settings (config.json)"), settings)
    return tag("details", tag("summary", tag("code", run.id)), facts, more, id=f"run-{run.id}", class_="run")


def _fact(value: str | int | float) -> str:
    return str(value)[:200] if isinstance(value, str) else f"{value:,}" if isinstance(value, int) else f"{value:,.1f}"


def _source(git: Any) -> str:
    if not isinstance(git, dict):
        return "not recorded"
    dirty = f", changed: {str(git['dirty'])[:64]}" if git.get("dirty") else ", unchanged"
    return f"commit {str(git.get('commit'))[:64]}{dirty}"


def _versions(versions: Any) -> str:
    if not isinstance(versions, dict):
        return "not recorded"
    return ", ".join(f"{str(name)[:40]} {str(value)[:40]}" for name, value in list(versions.items())[:20])


def _files(folder: RunFolder) -> Iterator[str]:
    names: list[tuple[str, ...]] = [("config.json",), ("run.json",), ("progress.csv",), ("policy.safetensors",)]
    names += [("eval", suite, name) for suite in folder.evaluations for name in (*TABLES, "trajectories.mcap")]
    for parts in names:
        path = folder.path.joinpath(*parts)
        if path.is_file():
            yield f"{'/'.join(parts)} ({path.stat().st_size / 1000:,.0f} kB)"


def _settings(run: Run) -> str:
    text = "\n".join(_flat(to_dict(run.config)))
    return text if len(text) <= SETTINGS_SHOWN else f"{text[:SETTINGS_SHOWN]}\n... (config.json has all of it)"


def _flat(data: dict[str, Any], prefix: str = "") -> Iterator[str]:
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name} = {json.dumps(value)}"
