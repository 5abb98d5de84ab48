"""A disk that fails at the n-th operation: SQLite's way of testing what a program does then.

Inside `Faults`, opening for writing, writing, syncing, renaming, making folders and shortening files below a folder
are counted, and the n-th raises an error instead of happening. Without a number they are only counted.
"""

from __future__ import annotations

import builtins
import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

ERRORS = (errno.ENOSPC, errno.EIO, errno.EACCES)
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class _Raw(io.FileIO):
    """A file whose writing is counted."""

    faults: Faults

    def write(self, data: Any) -> int:
        self.faults.operation("write", self.name)
        return super().write(data)

    def truncate(self, size: int | None = None) -> int:
        self.faults.operation("truncate", self.name)
        return super().truncate(size)


class Faults:
    """Counts what is done below ``root``, and lets operation number ``failing`` (from 1) fail with ``code``."""

    def __init__(self, root: Path, failing: int = 0, code: int = errno.ENOSPC) -> None:
        self.root, self.failing, self.code = os.path.realpath(root), failing, code
        self.log: list[str] = []
        self._real: list[tuple[Any, str, Any]] = []

    @property
    def reached(self) -> bool:
        """Whether the operation that was to fail was reached."""
        return len(self.log) >= self.failing

    def operation(self, name: str, path: Any) -> None:
        """Count an operation, and let it fail if it is its turn."""
        place = os.path.realpath(f"/proc/self/fd/{path}" if isinstance(path, int) else os.fsdecode(path))
        if not place.startswith(self.root):
            return
        self.log.append(f"{name} {place.removeprefix(self.root)}")
        if len(self.log) == self.failing:
            raise OSError(
                self.code, os.strerror(self.code), *([] if isinstance(path, int) or name == "write" else [path])
            )

    def open(self, file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **options: Any) -> Any:
        if isinstance(file, int) or not set(mode) & set("wxa+"):
            return self._open(file, mode, buffering, *rest, **options)
        self.operation("open", file)
        raw = _Raw(file, mode.replace("b", "").replace("t", ""))
        raw.faults = self
        if "b" in mode and buffering == 0:
            return raw
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        encoding, errors, newline = (*rest, None, None, None)[:3]
        return io.TextIOWrapper(buffered, options.get("encoding", encoding), options.get("errors", errors),
                                options.get("newline", newline))  # fmt: skip

    def __enter__(self) -> Self:
        self._open = io.open
        self._patch(io, "open", self.open)
        self._patch(builtins, "open", self.open)
        opened = os.open

        def open_descriptor(path: Any, flags: int, *rest: Any, **options: Any) -> int:
            if flags & WRITES:
                self.operation("open", path)
            return opened(path, flags, *rest, **options)

        self._patch(os, "open", open_descriptor)
        for name in ("fsync", "ftruncate", "pwrite", "write", "replace", "rename", "mkdir"):
            self._patch(os, name, self._counted(name, getattr(os, name)))
        return self

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def operation(path: Any, *rest: Any, **options: Any) -> Any:
            if name != "mkdir" or not os.path.isdir(path):  # noqa: PTH112 - what is there is not made
                self.operation(name, path)
            return real(path, *rest, **options)

        return operation

    def _patch(self, module: Any, name: str, value: Any) -> None:
        self._real.append((module, name, getattr(module, name)))
        setattr(module, name, value)

    def __exit__(self, *_: object) -> None:
        for module, name, value in reversed(self._real):
            setattr(module, name, value)
