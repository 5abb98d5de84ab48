"""Handling the signals that ask a command to stop."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

# SIGUSR2 is what schedulers are asked to send ahead of the end of a job's time.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR2)
PATIENCE = 30  # s for an answer of scontrol


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


def preempted() -> bool:
    """Whether this process is a job of submitit's that Slurm has told to make room for another.

    Slurm requeues such a job when it kills it, after a time of grace; one that saves and ends by then has failed. So
    it must be requeued as one out of time is: by `pass_on` with SIGUSR2.
    """
    job = os.environ.get("SLURM_JOB_ID")
    if not job or os.environ.get("SUBMITIT_EXECUTOR") != "slurm":
        return False
    try:
        done = subprocess.run(["scontrol", "--oneliner", "show", "job", job], capture_output=True, text=True,
                              check=True, timeout=PATIENCE)  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return False
    facts = dict(word.partition("=")[::2] for word in done.stdout.split())
    return facts.get("JobState") == "RUNNING" and facts.get("PreemptTime", "None") != "None"
