"""Handling the signals that ask a command to stop."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# SIGUSR2 is what schedulers are asked to send ahead of the end of a job's time.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2)


@contextmanager
def handling(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Let ``handler`` have `SIGNALS` for the duration of the block."""
    previous = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def pass_on(signum: int) -> None:
    """Let the handler that was there before `handling` have a signal that came during it, now that all is saved."""
    handler = signal.getsignal(signum)
    if callable(handler):
        handler(signum, None)
