"""Locks between processes: files that the kernel unlocks when their holder dies, however it dies."""

from __future__ import annotations

import fcntl
import json
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from srlrace.files import naming, read_limited

logger = logging.getLogger(__name__)

PATIENCE = 0.5  # s: a lister holds a shared lock for microseconds; whoever holds it longer is at work
LOCK_LIMIT = 4096  # bytes
WAIT = "SRLRACE_WAIT"  # set to 1: wait for whoever is at work instead of leaving


class RunError(ValueError):
    """A run that cannot be found, read or written; the message is one line for a person."""


@contextmanager
def hold(path: Path, name: str) -> Iterator[None]:
    """Hold the lock file ``path``; raises `RunError` saying who holds ``name`` already, or waits where `WAIT` is 1."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise RunError(f"{path.parent}: cannot write there ({error.strerror})") from None
    try:
        _acquire(descriptor, path, name)
        who = {"pid": os.getpid(), "host": socket.gethostname(), "since": now()}
        with naming(path):
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps(who).encode(), 0)
        yield
    finally:
        os.close(descriptor)


def _acquire(descriptor: int, path: Path, name: str) -> None:
    give_up = time.monotonic() + PATIENCE
    while True:
        try:
            return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > give_up:
                break
            time.sleep(0.01)
    if os.environ.get(WAIT) != "1":
        raise RunError(f"{name} is held by {_holder_text(path)}; wait for it or stop it")
    logger.info("%s is held by %s; waiting", name, _holder_text(path))
    fcntl.flock(descriptor, fcntl.LOCK_EX)


def holder(path: Path) -> str | None:
    """Who holds the lock file ``path`` (pid, host, since), or None when nobody does."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return _holder_text(path)
    finally:
        os.close(descriptor)
    return None


def _holder_text(path: Path) -> str:
    try:
        data = json.loads(read_limited(path, LOCK_LIMIT))
        return f"process {int(data['pid'])} on {str(data['host'])[:64]!r} since {str(data['since'])[:32]}"
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError):
        return "another process"


def now() -> str:
    """The time, to the second, in UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
