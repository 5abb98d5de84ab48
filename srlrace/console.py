"""Words to the user: one line at a time, with nothing that a file could smuggle into the terminal."""

from __future__ import annotations

import logging
import unicodedata

from rich.console import Console
from rich.text import Text

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


def clean(text: object) -> str:
    """Text without control and direction characters: a stored name cannot move the cursor or hide letters."""
    return "".join(c if unicodedata.category(c)[0] != "C" else "\ufffd" for c in str(text))


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
