"""Stopping on request: a signal asks for a checkpoint, a second one leaves at once."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Interrupted(Exception):
    """The user or the system asked the training to stop; its state has been saved."""

    def __init__(self, signum: int, run_id: str) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name}; resume with: srlrace resume {run_id}")
        self.signum = signum
        self.run_id = run_id


class StopRequest:
    """Which signal has asked to stop, if any."""

    signum: int | None = None

    def _handle(self, signum: int, frame: FrameType | None) -> None:
        if self.signum is not None:
            os._exit(128 + signum)  # files are written atomically: leaving here breaks nothing
        self.signum = signum


@contextmanager
def stop_request() -> Iterator[StopRequest]:
    """Catch `SIGNALS` for the duration of the block."""
    request = StopRequest()
    previous = {number: signal.signal(number, request._handle) for number in SIGNALS}
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
