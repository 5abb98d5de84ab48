"""Stopping on request: a signal asks for a checkpoint, a second one leaves at once."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from srlrace.signals import handling

ONE_REQUEST = 1.0  # s: a scheduler signals each process of a job, and its parent passes the same on


class Interrupted(Exception):
    """The user or the system asked the training to stop; its state has been saved."""

    def __init__(self, signum: int, run_id: str) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}; resume with: srlrace resume {run_id}")
        self.signum = signum
        self.run_id = run_id


class StopRequest:
    """Which signal has asked to stop, if any."""

    signum: int | None = None
    _since = 0.0  # s, when it asked

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is None:
            self.signum, self._since = signum, time.monotonic()
        elif time.monotonic() - self._since > ONE_REQUEST:
            os._exit(128 + signum)  # files are written atomically: leaving here breaks nothing


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Catch `srlrace.signals.SIGNALS` for the duration of the block."""
    request = StopRequest()
    with handling(request._handle):
        yield request
