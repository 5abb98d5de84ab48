"""Take the replay's pictures for the README and the docs: ``make replay-pictures``.

Draws the WebGL page by software, so that the pictures do not depend on the machine.
"""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

from srlrace.replay.command import replay
from srlrace.replay.select import Wish

IMAGES = Path(__file__).parent
FLAGS = ["--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle", "--use-angle=swiftshader",
         "--enable-unsafe-swiftshader"]  # fmt: skip
PATIENCE = 300_000  # ms


@dataclass(frozen=True)
class Picture:
    """One picture: which page, in which state, how large."""

    name: str
    track: str
    wish: Wish
    state: str  # after the page's #
    size: tuple[int, int]  # CSS pixels
    scheme: str = "dark"
    scale: float = 1.0  # device pixels per CSS pixel


PICTURES = (
    Picture("replay-forest", "forest", Wish(), "t=4.1&play=0", (1440, 900)),
    Picture("replay-split_s", "split_s", Wish(overlay=6), "t=5.9&play=0", (1440, 900), "light"),
    Picture("replay-phone", "forest", Wish(), "t=1.2&play=0", (390, 844), "dark", 2.0),
    Picture("replay-4k", "split_s", Wish(), "t=5.2&play=0", (3840, 2160)),
)


def take(browser: Browser, picture: Picture, page: Path) -> None:
    """Open a page and keep what it shows."""
    context = browser.new_context(
        viewport={"width": picture.size[0], "height": picture.size[1]},
        color_scheme=picture.scheme,  # type: ignore[arg-type]
        device_scale_factor=picture.scale,
    )
    context.set_default_timeout(PATIENCE)
    shown = context.new_page()
    shown.goto(f"{page.absolute().as_uri()}#{picture.state}")
    shown.wait_for_selector("html[data-interactive]")
    shown.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    shown.screenshot(path=IMAGES / f"{picture.name}.png", timeout=PATIENCE)
    context.close()


def main(root: Path, runs: dict[str, str], out: Path) -> None:
    """Write the pages of these runs, by track, and take all pictures."""
    out.mkdir(parents=True, exist_ok=True)
    program = shutil.which("chromium") or sys.exit("chromium is not installed: make browser-tools")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=FLAGS)
        for picture in PICTURES:
            page = replay(root, [runs[picture.track]], picture.wish, out=out / f"{picture.name}.html")
            take(browser, picture, page)
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]), {"forest": sys.argv[2], "split_s": sys.argv[3]}, Path(sys.argv[4]))
