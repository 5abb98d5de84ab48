"""Run folders: where they live, what state they are in, and who may write to them.

The files are the truth. A run's state follows from which files exist and from a lock that the kernel
releases when its holder dies, so a killed run shows as interrupted at once. Folders may come from a
stranger: names are checked, sizes limited, links out of the folder refused, and nothing is executed.
"""

from __future__ import annotations

import csv
import difflib
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from itertools import accumulate
from pathlib import Path
from typing import Any

from srlrace.config import Config, ConfigError, run_id, stored_config
from srlrace.files import FileError, atomic_write, open_plain, read_json, read_limited, read_packed, remove_leftovers
from srlrace.locks import RunError, hold, holder
from srlrace.parse import NAME
from srlrace.provenance import provenance, versions

__all__ = ["RunError", "RunFolder", "State", "atomic_write", "find", "latest_finished", "list_runs", "provenance",
           "runs_root", "versions"]  # fmt: skip

TAIL = 8 * 2**10  # bytes of progress.csv that are read to find its last row
EPISODES_LIMIT = 128 * 2**20  # bytes of episodes.csv: a million episodes
TABLES = ("episodes.csv", "episodes.csv.gz")  # a suite's table of episodes; published runs have it packed
DIGEST = "config_sha256"  # key in run.json: checksum of config.json
TABLE_DIGEST = "episodes_sha256"  # key in summary.json: checksum of episodes.csv, unpacked


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

    @cached_property
    def id(self) -> str:
        """The run's id: the folder's name."""
        plain = self.path.name not in ("", "..") and not self.path.is_symlink()
        return self.path.name if plain else self.path.resolve().name

    @property
    def state(self) -> State:
        """What the files and the lock say at this moment."""
        if not self.has("config.json"):
            return State.NEW
        if self.has("policy.safetensors"):
            return State.FINISHED  # also while somebody who waited for it holds the lock
        if self.holder() is not None:
            return State.TRAINING
        return State.FAILED if self.has("error.txt") else State.INTERRUPTED

    def has(self, name: str) -> bool:
        """Whether there is such a file."""
        return os.path.isfile(os.path.join(self.path, name))  # noqa: PTH113, PTH118 - a fifth of what Path takes

    @cached_property
    def config(self) -> Config | None:
        """The stored configuration, or None when it is missing or not valid."""
        try:
            return self.load_config()
        except RunError:
            return None

    def load_config(self) -> Config:
        """The stored configuration; raises `RunError` saying what is wrong with it."""
        path, info = self.file("config.json"), self.info
        try:
            content = read_limited(path)
            config = stored_config(content, path)
            damaged = DIGEST in info and info[DIGEST] != hashlib.sha256(content).hexdigest()
        except (ConfigError, FileError) as error:
            raise RunError(str(error)) from None
        if damaged or (DIGEST not in info and info.get("run") == self.id != run_id(config)):
            raise RunError(f"{path}: not the settings that run.json tells of; the file is damaged or was edited")
        return config

    @property
    def info(self) -> dict[str, Any]:
        """What ``run.json`` holds; empty when it is missing or broken."""
        return self._json("run.json")

    @property
    def evaluations(self) -> dict[str, dict[str, Any]]:
        """The summary of each evaluated suite, by suite; broken ones, and those of another table, are left out."""
        return {suite: summary for suite, summary in self._summaries() if self._belong(suite, summary)}

    @property
    def results(self) -> dict[str, dict[str, Any]]:
        """As `evaluations`, for lists: a table that is older than its summary, as it should be, is not read."""
        found = self._summaries()
        return {suite: summary for suite, summary in found if self._older(suite) or self._belong(suite, summary)}

    def _summaries(self) -> Iterator[tuple[str, dict[str, Any]]]:
        folder = os.path.join(self.path, "eval")  # noqa: PTH118
        for suite in sorted(entry.name for entry in _entries(folder) if NAME.fullmatch(entry.name)):
            if summary := self.summary(suite):
                yield suite, summary

    def summary(self, suite: str) -> dict[str, Any]:
        """``summary.json`` of a suite as it stands there; empty when it is missing or broken."""
        return self._json("eval", suite, "summary.json")

    def _older(self, suite: str) -> bool:
        folder = os.path.join(self.path, "eval", suite)  # noqa: PTH118
        try:
            name = next(name for name in TABLES if os.path.lexists(f"{folder}/{name}"))
            table, summary = (os.lstat(f"{folder}/{name}") for name in (name, "summary.json"))
        except (OSError, StopIteration):
            return False
        return table.st_mtime_ns <= summary.st_mtime_ns

    def _belong(self, suite: str, summary: dict[str, Any]) -> bool:
        try:
            return TABLE_DIGEST not in summary or bool(self.episodes(suite, summary))
        except (RunError, FileError):
            return False

    def table(self, suite: str) -> Path:
        """Where a suite's table of episodes is, or would be: the packed one only where there is no other."""
        plain, packed = (self.file("eval", suite, name) for name in TABLES)
        return packed if packed.is_file() and not plain.is_file() else plain

    def episodes(self, suite: str, summary: dict[str, Any] | None = None) -> bytes:
        """The table of a suite's episodes; raises `RunError` or `FileError` where it is not what was written.

        ``summary``: what stands in ``summary.json``, where that is known already.
        """
        path = self.table(suite)
        table = (read_packed if path.suffix == ".gz" else read_limited)(path, EPISODES_LIMIT)
        summary = self.summary(suite) if summary is None else summary
        if TABLE_DIGEST in summary and summary[TABLE_DIGEST] != hashlib.sha256(table).hexdigest():
            raise RunError(f"{path}: damaged, or its evaluation was interrupted; repeat: srlrace eval --suite {suite}")
        return table

    @property
    def progress(self) -> dict[str, float]:
        """The last complete row of ``progress.csv``, by column; empty when there is none."""
        try:
            with open_plain(self.file("progress.csv")) as stream:
                header = stream.readline(TAIL)
                stream.seek(max(len(header), os.fstat(stream.fileno()).st_size - TAIL))
                tail = stream.read(TAIL)
        except (RunError, FileError, OSError):
            return {}
        lines = tail[: tail.rfind(b"\n") + 1].splitlines()
        if not lines:
            return {}
        names, values = (next(csv.reader([line.decode(errors="replace")]), []) for line in (header, lines[-1]))
        return {name: float(value) for name, value in zip(names, values, strict=False) if _is_number(value)}

    def file(self, *parts: str) -> Path:
        """A file of this folder; raises `RunError` when a link leads out of the folder."""
        # A long list asks for tens of thousands of files: where no link is, none leads out, and strings are quick.
        steps = [*accumulate(parts, os.path.join, initial=os.fspath(self.path))]
        path = Path(steps[-1])
        if any(map(os.path.islink, steps[1:])) and not path.resolve().is_relative_to(self.path.resolve()):
            raise RunError(f"{path}: a link out of the run folder; not followed")
        return path

    def _json(self, *parts: str) -> dict[str, Any]:
        try:
            return read_json(self.file(*parts))
        except (RunError, FileError):
            return {}

    def holder(self) -> str | None:
        """Who is training this run (pid, host, since), or None when nobody does."""
        try:
            return holder(self.file("lock"))
        except RunError:
            return None

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Hold the run for training; raises `RunError` saying who holds it already. Creates the folder."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise RunError(f"{self.path}: cannot write there ({error.strerror})") from None
        with hold(self.file("lock"), self.id):
            for folder in (self.path, self.path / "checkpoint", self.path / "snapshots"):
                remove_leftovers(folder)
            yield


def runs_root(option: Path | str | None = None) -> Path:
    """Where runs live: the option, else ``SRLRACE_RUNS``, else ``./runs``."""
    return Path(option or os.environ.get("SRLRACE_RUNS") or "runs")


def list_runs(root: Path) -> list[RunFolder]:
    """Every run below a root, in order of its name; anything else that lies there is passed over."""
    names = sorted(entry.name for entry in _entries(root) if entry.is_dir(follow_symlinks=False))
    folders = (RunFolder(root / name) for name in names if NAME.fullmatch(name))
    return [run for run in folders if run.has("config.json")]


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


def _entries(folder: Path | str) -> list[os.DirEntry[str]]:
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
