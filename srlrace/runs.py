"""Run folders: where they live, what state they are in, and who may write to them.

The files are the truth. A run's state follows from which files exist and from a lock that the kernel
releases when its holder dies, so a killed run shows as interrupted at once. Folders may come from a
stranger: names are checked, sizes limited, links out of the folder refused, and nothing is executed.
"""

from __future__ import annotations

import csv
import difflib
import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any

from srlrace.config import Config, ConfigError, load_config
from srlrace.files import FileError, atomic_write, read_json, read_limited
from srlrace.parse import NAME
from srlrace.provenance import provenance, versions

__all__ = ["RunError", "RunFolder", "State", "atomic_write", "find", "latest_finished", "list_runs", "provenance",
           "runs_root", "versions"]  # fmt: skip

LOCK_PATIENCE = 0.5  # s: a lister holds a shared lock for microseconds; whoever holds it longer is training
TAIL = 64 * 2**10  # bytes of progress.csv that are read to find its last row
LOCK_LIMIT = 4096  # bytes


class RunError(ValueError):
    """A run that cannot be found, read or written; the message is one line for a person."""


class State(StrEnum):
    """What a run folder's files and lock say."""

    NEW = "new"
    TRAINING = "training"
    INTERRUPTED = "interrupted"
    FAILED = "failed"
    FINISHED = "finished"


@dataclass(frozen=True)
class RunFolder:
    """One run: ``config.json``, ``run.json``, ``progress.csv``, ``checkpoint/``, ``policy.safetensors``, ``eval/``."""

    path: Path

    @property
    def id(self) -> str:
        """The run's id: the folder's name."""
        return self.path.resolve().name

    @property
    def state(self) -> State:
        """What the files and the lock say at this moment."""
        if not (self.path / "config.json").is_file():
            return State.NEW
        if self.holder() is not None:
            return State.TRAINING
        if (self.path / "policy.safetensors").is_file():
            return State.FINISHED
        return State.FAILED if (self.path / "error.txt").is_file() else State.INTERRUPTED

    @cached_property
    def config(self) -> Config | None:
        """The stored configuration, or None when it is missing or not valid."""
        try:
            return self.load_config()
        except RunError:
            return None

    def load_config(self) -> Config:
        """The stored configuration; raises `RunError` saying what is wrong with it."""
        try:
            return load_config(self.file("config.json"))
        except ConfigError as error:
            raise RunError(str(error)) from None

    @property
    def info(self) -> dict[str, Any]:
        """What ``run.json`` holds; empty when it is missing or broken."""
        return self._json("run.json")

    @property
    def evaluations(self) -> dict[str, dict[str, Any]]:
        """The summary of each evaluated suite, by suite; broken ones are left out."""
        folder = self.path / "eval"
        suites = sorted(entry.name for entry in _entries(folder) if NAME.fullmatch(entry.name))
        summaries = {suite: self._json("eval", suite, "summary.json") for suite in suites}
        return {suite: summary for suite, summary in summaries.items() if summary}

    @property
    def progress(self) -> dict[str, float]:
        """The last complete row of ``progress.csv``, by column; empty when there is none."""
        try:
            path = self.file("progress.csv")
            with path.open("rb") as stream:
                header = stream.readline(TAIL)
                stream.seek(max(len(header), path.stat().st_size - TAIL))
                tail = stream.read(TAIL)
        except (RunError, OSError):
            return {}
        lines = tail[: tail.rfind(b"\n") + 1].splitlines()
        if not lines:
            return {}
        names, values = (next(csv.reader([line.decode(errors="replace")]), []) for line in (header, lines[-1]))
        return {name: float(value) for name, value in zip(names, values, strict=False) if _is_number(value)}

    def file(self, *parts: str) -> Path:
        """A file of this folder; raises `RunError` when a link leads out of the folder."""
        path = self.path.joinpath(*parts)
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise RunError(f"{path}: a link out of the run folder; not followed")
        return path

    def _json(self, *parts: str) -> dict[str, Any]:
        try:
            return read_json(self.file(*parts))
        except (RunError, FileError):
            return {}

    def holder(self) -> str | None:
        """Who holds the lock (pid, host, since), or None when nobody does."""
        try:
            descriptor = os.open(self.file("lock"), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        except (OSError, RunError):
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return self._holder_text()
        finally:
            os.close(descriptor)
        return None

    def _holder_text(self) -> str:
        try:
            data = json.loads(read_limited(self.path / "lock", LOCK_LIMIT))
            return f"process {int(data['pid'])} on {str(data['host'])[:64]!r} since {str(data['since'])[:32]}"
        except (ValueError, TypeError, KeyError):
            return "another process"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run for writing; raises `RunError` saying who holds it already. Creates the folder."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.file("lock"), os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RunError(f"{self.path}: cannot write there ({error.strerror})") from None
        try:
            self._acquire(descriptor)
            who = {"pid": os.getpid(), "host": socket.gethostname(), "since": _now()}
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps(who).encode(), 0)
            yield
        finally:
            os.close(descriptor)

    def _acquire(self, descriptor: int) -> None:
        give_up = time.monotonic() + LOCK_PATIENCE
        while True:
            try:
                return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() > give_up:
                    raise RunError(f"{self.id} is held by {self._holder_text()}; wait for it or stop it") from None
                time.sleep(0.01)


def runs_root(option: Path | str | None = None) -> Path:
    """Where runs live: the option, else ``SRLRACE_RUNS``, else ``./runs``."""
    return Path(option or os.environ.get("SRLRACE_RUNS") or "runs")


def list_runs(root: Path) -> list[RunFolder]:
    """Every run below a root, in order of its name; anything else that lies there is passed over."""
    names = sorted(entry.name for entry in _entries(root) if entry.is_dir(follow_symlinks=False))
    folders = (RunFolder(root / name) for name in names if NAME.fullmatch(name))
    return [run for run in folders if (run.path / "config.json").is_file()]


def latest_finished(root: Path) -> RunFolder:
    """The run whose policy was finished last; raises `RunError` when there is none."""
    finished = [run for run in list_runs(root) if run.state is State.FINISHED]
    if not finished:
        raise RunError(f"no finished run in {root}; train one with: srlrace train")
    return max(finished, key=lambda run: (run.path / "policy.safetensors").stat().st_mtime_ns)


def find(root: Path, query: str) -> RunFolder:
    """The run with this id, or with this unique prefix of one, or in this folder."""
    known = {run.id: run for run in list_runs(root)}
    if query in known:
        return known[query]
    if query and (Path(query) / "config.json").is_file():
        return RunFolder(Path(query))
    matches = [name for name in known if query and name.startswith(query)]
    if len(matches) == 1:
        return known[matches[0]]
    if matches:
        raise RunError(f"run {query!r} is ambiguous: {', '.join(matches[:5])}{', ...' if len(matches) > 5 else ''}")
    close = difflib.get_close_matches(query, known, n=3, cutoff=0.3)
    hint = f"; closest: {', '.join(close)}" if close else ""
    raise RunError(f"no run {query[:100]!r} in {root}{hint}")


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError:
        return []


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
