"""Stopping on request: a signal ends a training where that is safe, a second one leaves at once."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from srlrace.signals import behind, handling

ONE_REQUEST = 1.0  # s: a scheduler signals each process of a job, and its parent passes the same on
SHOW_CURSOR = b"\x1b[?25h"  # a progress bar hides it


class Interrupted(BaseException):
    """The user or the system asked the training to stop; its state has been saved.

    No `Exception`: it is raised wherever the program happens to be, and no library on the way may take it for its own.
    """

    def __init__(self, signum: int, run_id: str) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}; resume with: srlrace resume {run_id}")
        self.signum = signum
        self.run_id = run_id


class StopRequest:
    """Which signal has asked to stop, if any; it raises `Interrupted` at once, or at the end of `deferred`."""

    def __init__(self, run_id: str) -> None:
        self.run_id = run_id
        self.signum: int | None = None
        self._since = 0.0  # s, when it asked
        self._deferring = False

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is None:
            self.signum, self._since = signum, time.monotonic()
            if not self._deferring:
                self.check()
        elif signum == signal.SIGINT or time.monotonic() - self._since > ONE_REQUEST:
            if sys.stderr.isatty():
                os.write(2, SHOW_CURSOR)
            os._exit(128 + signum)  # files are written atomically: leaving here breaks nothing

    def check(self) -> None:
        """Raise `Interrupted` if a signal has come."""
        if self.signum is not None:
            raise Interrupted(self.signum, self.run_id)

    @contextmanager
    def deferred(self, check: bool = True) -> Iterator[None]:
        """Let the block, which moves the run from one complete state to the next, come to its end."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        if check:
            self.check()


@contextmanager
def stop_request(run_id: str) -> Iterator[StopRequest]:
    """Catch `srlrace.signals.SIGNALS` for the duration of the block."""
    request = StopRequest(run_id)
    with handling(request._handle):
        yield request


@contextmanager
def unwrapped() -> Iterator[None]:
    """Raise `Interrupted` where the block ended in another error that it was the cause of."""
    try:
        yield
    except Exception as error:
        stop = behind(error, Interrupted)
        if not isinstance(stop, Interrupted):
            raise
        raise Interrupted(stop.signum, stop.run_id) from error
