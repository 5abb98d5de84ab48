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


def behind(error: BaseException, kind: type[BaseException]) -> BaseException | None:
    """The exception of a ``kind`` that ``error`` came of, or None.

    A handler's exception can come up in compiled code, which makes it the cause of an error of its own: CPython, of a
    `SystemError`.
    """
    left, seen = [error], set[int]()
    while left:
        link = left.pop()
        if isinstance(link, kind):
            return link
        seen.add(id(link))
        left += [other for other in (link.__context__, link.__cause__) if other is not None and id(other) not in seen]
    return None


def pass_on(signum: int) -> None:
    """Let the handler that was there before `handling` have a signal that came during it, now that all is saved."""
    handler = signal.getsignal(signum)
    if callable(handler):
        handler(signum, None)
