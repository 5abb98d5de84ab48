"""Locks: whoever finds one held says by whom, also when the holder has not said so yet."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import subprocess
import sys

import pytest

from srlrace import locks
from srlrace.locks import RunError, hold, holder


class Clock:
    """Time that passes only while somebody waits; ``then`` happens after so many waits."""

    def __init__(self, waits: int, then) -> None:
        self.now, self._waits, self._then = 0.0, waits, then

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now, self._waits = self.now + seconds, self._waits - 1
        if self._waits == 0:
            self._then()


@pytest.fixture
def held(tmp_path):
    """A lock file that is locked, and names nobody yet."""
    path = tmp_path / "lock"
    with path.open("wb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield path


def name(pid: int, host: str = "") -> bytes:
    return json.dumps({"pid": pid, "host": host or socket.gethostname(), "since": "noon"}).encode()


def refusal(path) -> str:
    with pytest.raises(RunError) as refused, hold(path, "it"):
        pytest.fail("held twice")
    return str(refused.value)


def dead() -> int:
    """The number of a process that is gone."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        pass
    return process.pid


@pytest.mark.parametrize("before", [lambda: b"", lambda: b'{"pid": 12, "ho', lambda: name(dead())])
def test_a_holder_that_has_not_said_who_it_is_is_waited_for(held, monkeypatch, before):
    held.write_bytes(before())
    clock = Clock(round(2 * locks.PATIENCE / 0.01), lambda: held.write_bytes(name(os.getpid())))
    monkeypatch.setattr(locks, "time", clock)
    assert refusal(held) == (
        f"it is held by process {os.getpid()} on {socket.gethostname()!r} since noon; wait for it or stop it"
    )
    assert 2 * locks.PATIENCE <= clock.now < 2 * locks.PATIENCE + 0.1


@pytest.mark.parametrize("who", [lambda: name(os.getpid()), lambda: name(dead(), "elsewhere")])
def test_a_holder_that_said_it_is_named_at_once(held, monkeypatch, who):
    """On another machine nobody can see whether it lives."""
    held.write_bytes(who())
    clock = Clock(-1, lambda: None)
    monkeypatch.setattr(locks, "time", clock)
    assert " is held by process " in refusal(held)
    assert clock.now < locks.PATIENCE + 0.1


def test_a_holder_that_never_says_it_is_not_waited_for_without_end(held, monkeypatch):
    clock = Clock(-1, lambda: None)
    monkeypatch.setattr(locks, "time", clock)
    assert refusal(held) == "it is held by another process; wait for it or stop it"
    assert clock.now < locks.PATIENCE + locks.NAMING + 0.1


def test_a_lock_that_comes_free_meanwhile_is_taken(tmp_path, monkeypatch):
    path = tmp_path / "lock"
    with path.open("wb") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        monkeypatch.setattr(locks, "time", Clock(100, stream.close))
        with hold(path, "it"):
            assert str(os.getpid()) in (holder(path) or "")


def test_a_holder_says_who_it_is_over_whatever_was_there(tmp_path):
    path = tmp_path / "lock"
    path.write_bytes(b"x" * 1000)
    with hold(path, "it"):
        assert json.loads(path.read_bytes())["pid"] == os.getpid()
    assert holder(path) is None
