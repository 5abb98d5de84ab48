"""Leases: one holder at a time, without anybody's wall-clock and, between machines, without file locks."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from srlrace.sweep import lease as leasing
from srlrace.sweep.lease import BEAT, GIVE_UP, LOST, PATIENCE, Leases, describe, renew

RUN = "forest-srl-s0-d94c5d84"


class Clock:
    """A monotonic clock that goes when it is told to."""

    def __init__(self, now=0.0):
        self.now = now

    def __call__(self):
        return self.now


def other(root, clock=None, machine="elsewhere"):
    """The leases as a process on another machine sees them: it learns nothing from the kernel's locks."""
    return Leases(root, machine, clock or Clock())


def test_one_holds_it_and_lets_go(tmp_path):
    first, second = Leases(tmp_path), Leases(tmp_path)
    held = first.claim(RUN)
    assert held is not None
    assert first.claim(RUN) is None
    assert second.claim(RUN) is None
    assert other(tmp_path).claim(RUN) is None
    assert str(os.getpid()) in describe(second.current(RUN))
    assert second.claim("forest-srl-s1-d94c5d84") is not None
    held.release()
    assert second.claim(RUN) is not None


def test_on_one_machine_a_killed_holder_is_succeeded_at_once(tmp_path):
    code = (
        "import sys, time, pathlib; from srlrace.sweep.lease import Leases\n"
        f"assert Leases(pathlib.Path({str(tmp_path)!r})).claim({RUN!r}); print('held', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        assert Leases(tmp_path).claim(RUN) is None
        holder.kill()
        holder.wait()
        assert other(tmp_path).claim(RUN) is None  # another machine cannot know it yet
        assert Leases(tmp_path).claim(RUN) is not None


@pytest.mark.parametrize("skew", [-300, 0, 300])  # s between the holder's wall-clock and the observer's
@pytest.mark.parametrize("uptime", [0.0, 1e6])  # s between their monotonic clocks
def test_a_clock_that_is_minutes_off_changes_nothing(tmp_path, monkeypatch, skew, uptime):
    held = other(tmp_path, machine="holder").claim(RUN)
    clock = Clock(uptime)
    observer = other(tmp_path, clock)
    monkeypatch.setattr(time, "time", lambda: 1e9 + skew)

    def stamp():  # what the holder's file system writes, with the holder's clock
        os.utime(held.path, (1e9 - skew, 1e9 - skew))

    for _ in range(60):  # ten minutes of life
        assert renew(held.path, held.token)
        stamp()
        assert observer.claim(RUN) is None
        clock.now += BEAT
    for _ in range(int(PATIENCE / BEAT) - 1):  # and then none
        assert observer.claim(RUN) is None
        clock.now += BEAT
    clock.now -= 1.0
    assert observer.claim(RUN) is None
    clock.now += 1.0
    taken = observer.claim(RUN)
    assert taken is not None
    assert not renew(held.path, held.token)  # who was thought dead notices, and brings nothing back
    assert renew(taken.path, taken.token)
    assert [path.name for path in observer.folder.iterdir()] == [f"{RUN}.2"]


def test_a_holder_gives_up_well_before_others_take_over():
    assert 3 * BEAT < GIVE_UP < PATIENCE - 3 * BEAT


def contend(root, barrier, wins, stale):
    clock = Clock()
    leases = other(root, clock, machine=f"machine {os.getpid()}")
    if stale:
        assert leases.claim(RUN) is None  # the first look begins the watch
    clock.now += PATIENCE
    barrier.wait()
    if lease := leases.claim(RUN):
        wins.put(lease.path.name)


@pytest.mark.parametrize("stale", [False, True])
def test_of_many_at_one_instant_at_most_one_gets_it(tmp_path, stale):
    context = multiprocessing.get_context("fork")
    for attempt in range(8):
        root = tmp_path / str(attempt)
        if stale:
            assert other(root, machine="dead").claim(RUN)
        barrier, wins = context.Barrier(6), context.SimpleQueue()
        crowd = [context.Process(target=contend, args=(root, barrier, wins, stale)) for _ in range(6)]
        for process in crowd:
            process.start()
        for process in crowd:
            process.join()
            assert process.exitcode == 0
        won = []
        while not wins.empty():
            won.append(wins.get())
        files = [path.name for path in (root / leasing.FOLDER).iterdir()]
        assert won in ([], [f"{RUN}.{1 + stale}"])  # all may have withdrawn, but never two have it
        assert files == (won or ([f"{RUN}.1"] if stale else []))


def test_two_that_saw_the_same_dead_lease(tmp_path):
    """The one that comes late finds the next generation there, gone again, or a new beginning."""
    dead = other(tmp_path, machine="dead").claim(RUN)
    clocks = [Clock(), Clock()]
    early, late = (other(tmp_path, clock, f"machine {index}") for index, clock in enumerate(clocks))
    assert early.claim(RUN) is None
    assert late.claim(RUN) is None
    for clock in clocks:
        clock.now += PATIENCE
    seen = late.current(RUN)
    successor = early.claim(RUN)
    assert successor is not None
    late.current = lambda run: seen  # it looked just before that
    assert late.claim(RUN) is None  # the name is taken
    successor.release()
    fresh = other(tmp_path, machine="third").claim(RUN)
    assert fresh is not None
    assert late.claim(RUN) is None  # the one it wants to bury is not there any more
    assert renew(fresh.path, fresh.token)
    assert not dead.path.samefile(fresh.path) or fresh.token in fresh.path.read_text()


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff\xfe", b'{"machine": 3, "beat": []}', b" " * 5000])
def test_a_lease_of_nonsense_is_one_that_does_not_change(tmp_path, content):
    clock = Clock()
    observer = other(tmp_path, clock)
    observer.folder.mkdir()
    (observer.folder / f"{RUN}.1").write_bytes(content)
    (observer.folder / f"{RUN}.x").write_bytes(content)
    first = observer.claim(RUN)
    clock.now += PATIENCE
    assert first is not None or observer.claim(RUN) is not None


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(leasing.fcntl, "flock", refuse)
    clock = Clock()
    held, rival = Leases(tmp_path).claim(RUN), Leases(tmp_path, clock=clock)
    assert json.loads(held.path.read_text())["locked"] is False
    assert rival.claim(RUN) is None
    clock.now += PATIENCE
    assert rival.claim(RUN) is not None


def test_a_child_leaves_when_its_lease_is_lost(tmp_path):
    held = other(tmp_path).claim(RUN)
    code = (
        "import time; from srlrace.sweep import lease; lease.BEAT = 0.05; lease.keep_lease()\n"
        "print('at work', flush=True); time.sleep(60)"
    )
    environment = held.child_environment(os.environ)
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"at work\n"
        give_up = time.monotonic() + 30
        while json.loads(held.path.read_text())["beat"] < "000000000003" and time.monotonic() < give_up:
            time.sleep(0.02)
        held.path.unlink()
        assert child.wait(timeout=30) == LOST


def test_children_end_with_a_killed_parent(tmp_path):
    """SIGKILL leaves a parent no time to say anything: the kernel tells the child."""
    code = (
        "import os, subprocess, sys, time; from srlrace.orphans import followed\n"
        "child = 'import time; from srlrace.orphans import follow_parent; follow_parent()\\n'\n"
        "child += 'print(1, flush=True); time.sleep(60)'\n"
        "process = subprocess.Popen([sys.executable, '-c', child], env=followed(os.environ), stdout=subprocess.PIPE)\n"
        "process.stdout.readline(); print(process.pid, flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as parent:
        child = int(parent.stdout.readline())
        assert os.getpgid(child)
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        give_up = time.monotonic() + 30
        while alive(child) and time.monotonic() < give_up:
            time.sleep(0.02)
        assert not alive(child)


def alive(pid):
    try:
        with open(f"/proc/{pid}/stat") as stream:  # noqa: PTH123
            return stream.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
