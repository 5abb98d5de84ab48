"""Stopping on request: a signal ends a training where that is safe, a second one leaves at once."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from srlrace.signals import handling

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
        self.deferring = False  # within `deferred`
        self._raised = False

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is None:
            self.signum, self._since = signum, time.monotonic()
            if not self.deferring:
                self.check()
        elif signum == signal.SIGINT or time.monotonic() - self._since > ONE_REQUEST:
            if sys.stderr.isatty():
                os.write(2, SHOW_CURSOR)
            os._exit(128 + signum)  # files are written atomically: leaving here breaks nothing

    def check(self) -> None:
        """Raise `Interrupted` if a signal has come."""
        if self.signum is not None:
            self._raised = True
            raise Interrupted(self.signum, self.run_id)

    @contextmanager
    def deferred(self, check: bool = True) -> Iterator[None]:
        """Let the block, which moves the run from one complete state to the next, come to its end.

        Where ``check`` is set it is not begun after a signal, not even one whose `Interrupted` got lost.
        """
        if check:
            self.check()
        self.deferring = True
        try:
            yield
        finally:
            self.deferring = False
        if check:
            self.check()

    @contextmanager
    def enforced(self) -> Iterator[None]:
        """Raise `Interrupted` whatever else the block ends in once it was raised there.

        It comes up anywhere. Where that is compiled code, CPython makes a `SystemError` of it; in a library's callback
        it is lost, and what the library does next fails for want of what the callback had to do.
        """
        try:
            yield
        except Exception as error:
            if self._raised and self.signum is not None:
                raise Interrupted(self.signum, self.run_id) from error
            raise


@contextmanager
def stop_request(run_id: str) -> Iterator[StopRequest]:
    """Catch `srlrace.signals.SIGNALS` for the duration of the block."""
    request = StopRequest(run_id)
    with handling(request._handle), _raised_again(request):
        yield request


@contextmanager
def _raised_again(request: StopRequest) -> Iterator[None]:
    """Where an `Interrupted` gets lost in a callback, print no traceback of it, but raise it in the next call."""
    hook, profile = sys.unraisablehook, sys.getprofile()

    def next_call(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and not request.deferring:
            sys.setprofile(profile)
            request.check()

    def tell(lost: sys.UnraisableHookArgs) -> None:
        if isinstance(lost.exc_value, Interrupted):
            sys.setprofile(next_call)
        else:
            hook(lost)

    sys.unraisablehook = tell
    try:
        yield
    finally:
        sys.setprofile(profile)
        sys.unraisablehook = hook
