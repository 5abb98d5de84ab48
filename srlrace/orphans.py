"""Leaving no process behind: a child that is told to ends when its parent does, however that ended."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping

PARENT = "SRLRACE_PARENT"  # the process whose end is to be followed
LEASE = "SRLRACE_LEASE"  # the lease that a child is to renew: its token and path
PR_SET_PDEATHSIG = 1  # linux/prctl.h


def followed(environment: Mapping[str, str]) -> dict[str, str]:
    """An environment that makes a ``srlrace`` started with it follow this process."""
    return {**environment, PARENT: str(os.getpid())}


def follow_parent() -> None:
    """If asked to by `followed`, get SIGTERM when the parent dies, and so save and stop; only Linux can do that."""
    parent = os.environ.pop(PARENT, "")
    if not parent or not sys.platform.startswith("linux"):
        return
    import ctypes  # a hundredth of a second that other commands need not spend

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if str(os.getppid()) != parent:  # it died before it could be followed
        raise SystemExit(128 + signal.SIGTERM)
