"""Headless Chromium for the pages that srlrace writes: Debian's browser, driven by Playwright without a download.

A page is opened from its file. Whatever it logs as an error, throws, violates of its own content policy or asks
the network for fails the test that opened it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pages import PATIENCE

AXE = Path(__file__).parent / "node_modules" / "axe-core" / "axe.min.js"
SOFTWARE_GL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WEBGL = ("--disable-3d-apis",)
COMMON = ("--no-sandbox", "--disable-dev-shm-usage")  # as root and in a container, where CI runs
SERIOUS = ("serious", "critical")  # axe-core's impacts that no page may have


@dataclass
class Visit:
    """An open page and what went wrong on it."""

    page: Any  # playwright.sync_api.Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def watch(self) -> None:
        """Collect console errors, exceptions and requests that leave the file."""
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))

    def network(self) -> list[str]:
        """Requests to anything but local files, blobs and data."""
        return [url for url in self.requests if not url.startswith(("file:", "blob:", "data:"))]

    def violations(self) -> list[str]:
        """Serious and critical findings of axe-core, one line each."""
        if not AXE.is_file():
            pytest.skip("axe-core is not installed: make browser-tools")
        self.page.evaluate(AXE.read_text())
        found = self.page.evaluate("axe.run()")["violations"]
        return [
            f"{finding['id']}: {finding['help']}: {node['html'][:200]}"
            for finding in found
            if finding["impact"] in SERIOUS
            for node in finding["nodes"]
        ]


@pytest.fixture(scope="session")
def browsers() -> Iterator[Callable[..., Any]]:
    """``browsers(*flags)``: Chromium with these flags, started once a session.

    Only one Playwright may run in a thread, so it is kept beside the browsers that it started.
    """
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.skip("chromium is not installed: make browser-tools")
    sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        running: dict[tuple[str, ...], Any] = {}

        def start(*flags: str) -> Any:
            if flags not in running:
                running[flags] = playwright.chromium.launch(executable_path=program, args=[*COMMON, *flags])
            return running[flags]

        yield start
        for browser in running.values():
            browser.close()


@pytest.fixture
def visit(browsers: Callable[..., Any]) -> Iterator[Callable[..., Visit]]:
    """``visit(file)``: open a page; after the test it must have logged no error and asked nothing of the network.

    ``fragment`` follows the address's #; ``size`` in CSS pixels, ``scale`` device pixels per CSS pixel, ``scheme``
    light or dark, ``webgl`` False for a browser without it, ``reduced_motion`` for a person who asked for less.
    """
    opened: list[Visit] = []

    def open_page(
        file: Path,
        *,
        fragment: str = "",
        size: tuple[int, int] = (1280, 800),
        scale: float = 1,
        scheme: str = "light",
        webgl: bool = True,
        reduced_motion: bool = False,
        touch: bool = False,
    ) -> Visit:
        browser = browsers(*(SOFTWARE_GL if webgl else NO_WEBGL))
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]},
            device_scale_factor=scale,
            color_scheme=scheme,
            reduced_motion="reduce" if reduced_motion else "no-preference",
            has_touch=touch,
        )
        context.set_default_timeout(PATIENCE)
        visited = Visit(context.new_page())
        visited.watch()
        opened.append(visited)
        visited.page.goto(file.absolute().as_uri() + (f"#{fragment}" if fragment else ""))
        return visited

    yield open_page
    for visited in opened:
        visited.page.context.close()
    assert [error for visited in opened for error in visited.errors] == []
    assert [url for visited in opened for url in visited.network()] == []
