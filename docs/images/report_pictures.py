"""Make the documentation's pictures of the command line and of the report's page; `make report-pictures` runs it.

The terminal is drawn by rich from what the commands print, the page is photographed by headless Chromium.
"""

from __future__ import annotations

import csv
import io
import shutil
import sys
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import TerminalTheme

from srlrace.learn.display import Display
from srlrace.report.command import PAGE, read_report, report
from srlrace.report.terminal import terminal_table
from srlrace.runs import RunFolder, list_runs
from srlrace.watch import look, picture

COLUMNS = 104  # characters of a terminal's line
LINES = 36  # of a terminal that follows a sweep
INSTANT = 0.6  # of a training, at which its panel is shown
SHOTS = {  # of the page: CSS pixels, colours, and which part
    "report": ((1280, 900), "light", "#summary"),
    "report-figures": ((1280, 900), "dark", "figure"),
    "report-phone": ((390, 844), "light", "#minimum_time"),
    "report-4k": ((3840, 2160), "light", "header"),
}
THEME = TerminalTheme(
    (20, 24, 28), (232, 235, 238),
    [(20, 24, 28), (255, 128, 149), (47, 208, 160), (227, 194, 74), (86, 180, 233), (224, 139, 212), (86, 200, 220),
     (200, 205, 210)],
)  # fmt: skip


def main(runs: Path, images: Path) -> None:
    """Write every picture into ``images``, from the runs below ``runs``."""
    images.mkdir(parents=True, exist_ok=True)
    folders = list_runs(runs)
    console = terminal()
    console.print("$ srlrace report", style="bold", highlight=False)
    console.print(terminal_table(read_report(runs)[1].tables[0]))
    save(console, images / "cli-report.svg", "srlrace report")
    console = terminal()
    console.print(picture([look(run) for run in folders], LINES, COLUMNS))
    save(console, images / "cli-runs.svg", "srlrace runs --watch")
    console = terminal()
    console.print(training(folders[0]))
    save(console, images / "cli-train.svg", "srlrace train")
    photograph(runs, images)


def terminal() -> Console:
    """Return a console that records what it is told and shows nothing."""
    return Console(record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True, color_system="truecolor")


def save(console: Console, path: Path, title: str) -> None:
    """Write what a console was told as SVG; its ids depend on the title only."""
    console.save_svg(str(path), title=title, theme=THEME, unique_id=path.stem)


def training(run: RunFolder) -> object:
    """Return the panel of a training as it stood part of the way, replayed from its progress file."""
    config = run.load_config()
    display = Display(config, run.path, terminal())
    with run.file("progress.csv").open(encoding="utf-8") as stream:
        rows = [
            {name: float(value) if value else None for name, value in row.items()} for row in csv.DictReader(stream)
        ]
    for row in rows[: int(INSTANT * len(rows))]:
        display.add(row)
    return display.panel()


def photograph(runs: Path, images: Path) -> None:
    """Write the report's page beside the pictures, take them, and remove it."""
    from playwright.sync_api import sync_playwright

    report(runs, "html", images, Console(file=io.StringIO()))
    page_file = (images / PAGE).absolute()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        for name, ((width, height), scheme, place) in SHOTS.items():
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)  # type: ignore[arg-type]
            page.goto(page_file.as_uri())
            page.locator(place).nth(1 if place == "figure" else 0).evaluate("e => e.scrollIntoView()")
            page.wait_for_timeout(300)  # ms, for the contents to follow
            page.screenshot(path=images / f"{name}.png")
            page.close()
        browser.close()
    page_file.unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
