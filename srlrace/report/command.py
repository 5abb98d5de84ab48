"""`srlrace report`: the paper's tables from the runs at hand, beside the paper's numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from srlrace.confdir import conf_dir
from srlrace.files import atomic_write, naming
from srlrace.report.collect import Run, collect
from srlrace.report.csv_tables import render_csv
from srlrace.report.experiments import ExperimentError, load_experiments, load_paper
from srlrace.report.latex import latex_table, render_latex
from srlrace.report.markdown import markdown_table, render_markdown
from srlrace.report.model import Report, Table
from srlrace.report.presets import row_config
from srlrace.report.tables import build_report
from srlrace.report.terminal import print_report

FILES: dict[str, Callable[[Table], str]] = {"md": markdown_table, "csv": render_csv, "tex": latex_table}
FORMATS = ("rich", *FILES, "html")
PAGE = "report.html"


def report(root: Path, format: str = "rich", out: Path | None = None, console: Console | None = None) -> None:
    """Show the tables of the runs below ``root``; with ``out``, also write tables and figures there.

    The format html writes one page instead, into ``out`` or the current folder, and prints its path. Raises
    ExperimentError for a format that does not exist, a configuration error for an experiment file that does not
    compose, OSError when ``out`` cannot be written.
    """
    if format not in FORMATS:
        raise ExperimentError(f"--format takes {', '.join(FORMATS)}, not {format!r}")
    console = console or Console()
    runs, built = read_report(root)
    if format == "html":
        path = write_page(built, runs, (out or Path()) / PAGE)
        console.print(str(path), markup=False, highlight=False, soft_wrap=True)
        return
    if out is None or format == "rich":
        _show(built, format, console)
    if out is not None:
        _write(built, runs, format, out, console)


def read_report(root: Path) -> tuple[tuple[Run, ...], Report]:
    """Return the runs below ``root`` and the report built from them."""
    folder = conf_dir()
    runs, problems = collect(root)
    built = build_report(
        runs, load_experiments(folder / "experiment"), load_paper(folder / "paper.yaml"), row_config, problems
    )
    return runs, built


def write_page(built: Report, runs: tuple[Run, ...], path: Path) -> Path:
    """Write the report as one self-contained page."""
    from srlrace.report.page import render_page  # matplotlib takes a second to import

    page = render_page(built, runs, load_paper(conf_dir() / "paper.yaml"))
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, page)
    return path


def _show(built: Report, format: str, console: Console) -> None:
    if format == "rich":
        print_report(built, console)
    elif format == "csv":
        tables = (f"# {table.experiment.name}\n{render_csv(table)}" for table in built.tables)
        console.out("\n".join(tables), end="", highlight=False)
    else:
        render = render_markdown if format == "md" else render_latex
        console.out(render(built), end="", highlight=False)


def _write(built: Report, runs: tuple[Run, ...], format: str, out: Path, console: Console) -> None:
    """Write one file per table (in all formats unless one was asked for), and the figures."""
    from srlrace.report.figures import write_figures  # matplotlib takes a second to import

    out.mkdir(parents=True, exist_ok=True)
    formats = tuple(FILES) if format == "rich" else (format,)
    written = [_write_table(table, suffix, out) for table in built.tables for suffix in formats]
    with naming(out / "figures"):
        written += write_figures(built, runs, out / "figures", fly=True)
    console.print(f"wrote {len(written)} files to {out}", markup=False, highlight=False)


def _write_table(table: Table, suffix: str, out: Path) -> Path:
    path = out / f"{table.experiment.name}.{suffix}"
    atomic_write(path, FILES[suffix](table).encode())
    return path
