"""Where a run came from: command, versions, source and machine."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from srlrace import __version__

PACKAGES = ("numpy", "numba", "torch", "stable-baselines3", "gymnasium", "hydra-core")  # what results depend on


def provenance(argv: Sequence[str]) -> dict[str, Any]:
    """What ``run.json`` records about the origin of a run; imports none of the packages it names."""
    return {
        "argv": without_runs_folder(argv),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "git": git_state(),
        "cpu": cpu_name(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "platform": platform.platform(),
    }


def without_runs_folder(argv: Sequence[str]) -> list[str]:
    """The command line without ``--runs DIR``: where runs lie is no part of where they came from."""
    kept = [word for before, word in zip(["", *argv], argv, strict=False) if before != "--runs"]
    return [word for word in kept if word != "--runs" and not word.startswith("--runs=")]


def versions() -> dict[str, str]:
    """The versions of what results depend on; imports none of it."""
    found = {"srlrace": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = ""
    return found


def circumstances(threads: int) -> dict[str, Any]:
    """What the last bits of a result depend on, beside its settings and seed; ``threads`` are torch's."""
    return {"threads": threads, "cpu": cpu_name(), "versions": versions()}


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """What `circumstances` say that earlier ones, where they are known, did not."""
    for name, value in now.items():
        earlier = before.get(name, value)
        if isinstance(value, dict) and isinstance(earlier, dict):
            yield from changes(earlier, value)
        elif earlier != value:
            yield f"{name} was {earlier!r:.60}, now {value!r:.60}"


def git_state() -> dict[str, str] | None:
    """The source's commit, and a hash of what differs from it ("" for nothing); None outside a checkout."""
    if _git("ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    commit, changes = _git("rev-parse", "HEAD"), _git("diff", "--no-ext-diff", "HEAD", "--", ":/srlrace", ":/conf")
    if commit is None or changes is None:
        return None
    return {"commit": commit.decode().strip(), "dirty": hashlib.sha256(changes).hexdigest()[:16] if changes else ""}


def _git(*arguments: str) -> bytes | None:
    command = ["git", "-C", str(Path(__file__).parent), *arguments]
    try:
        return subprocess.run(command, capture_output=True, check=True, timeout=10).stdout
    except (OSError, subprocess.SubprocessError):
        return None


def cpu_name() -> str:
    """The processor's model, as well as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.processor() or platform.machine())
