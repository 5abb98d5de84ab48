"""Words to the user: one line at a time, with nothing that a file could smuggle into the terminal."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.text import Text

from srlrace.text import clean

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Tell the user something, on stderr."""
    err.print(Text(clean(message)), soft_wrap=True)


def fail(message: str) -> None:
    """Tell the user what went wrong, in one line on stderr."""
    err.print(Text.assemble(("error: ", "bold red"), clean(" ".join(message.split()))), soft_wrap=True)


class _Handler(logging.Handler):
    """Log records as plain lines through the console, so that they do not tear a progress bar."""

    def emit(self, record: logging.LogRecord) -> None:
        prefix = "" if record.levelno <= logging.INFO else f"{record.levelname.lower()}: "
        say(prefix + record.getMessage())


def setup_logging() -> None:
    """Show the package's log records from INFO up, once, whatever others have configured."""
    logger = logging.getLogger("srlrace")
    if not any(isinstance(handler, _Handler) for handler in logger.handlers):
        logger.addHandler(_Handler())
    logger.setLevel(logging.INFO)
    logger.propagate = False


class _Plain(logging.Formatter):
    """One line a record, dated in UTC, without anything that could move a cursor."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:
        """Return when it happened, to the second."""
        return datetime.fromtimestamp(record.created, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")

    def format(self, record: logging.LogRecord) -> str:
        return clean(" ".join(super().format(record).split("\n")))


class _Lines(logging.StreamHandler[TextIO] if TYPE_CHECKING else logging.StreamHandler):  # type: ignore[misc]
    """Records as lines of a file; a disk that takes no more of them stops nothing that matters."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Lose the record."""


@contextmanager
def logged(path: Path) -> Iterator[logging.Handler]:
    """Append the package's log records to a file while the ``with`` statement lasts; a link raises OSError."""
    flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    logger = logging.getLogger("srlrace")
    with os.fdopen(os.open(path, flags, 0o644), "a", encoding="utf-8") as stream:
        handler = _Lines(stream)
        handler.setFormatter(_Plain("%(asctime)s %(levelname)-7s %(message)s"))
        logger.addHandler(handler)
        try:
            yield handler
        finally:
            logger.removeHandler(handler)
