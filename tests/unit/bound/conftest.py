"""Small tracks for the time-optimal solver, written as a user would, and a cache of its own for each test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from srlrace.config import Config
from srlrace.hydra_bridge import compose

SHORT = """
waypoints: [[4.0, 0.0, 1.5], [6.0, 3.0, 2.0]]
start: [0.0, 0.0, 1.5]
bounds_low: [-2.0, -4.0, 0.0]
bounds_high: [9.0, 6.0, 5.0]
"""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(Path.home() / ".cache" / "srlrace"))


@pytest.fixture
def short(tmp_path: Path) -> Any:
    """Compose the short track with overrides, and obstacles as YAML."""

    def build(*overrides: str, obstacles: str = "[]", start: str | None = None) -> Config:
        path = tmp_path / "short.yaml"
        text = SHORT.replace("[0.0, 0.0, 1.5]", start) if start else SHORT
        path.write_text(f"{text}obstacles: {obstacles}\n")
        return compose([f"env={path}", "level=none", *overrides])

    return build
