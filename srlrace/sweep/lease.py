"""Leases: whose run it is, also between machines that see one runs folder but not each other's file locks.

A lease is a file ``.leases/<run>.<generation>`` that its holder changes every `BEAT` seconds. Nobody's wall-clock
matters: an observer measures on its own monotonic clock for how long it has seen no change, and takes over after
`PATIENCE`; a holder measures on its own for how long it could not renew, and stops after `GIVE_UP`, well before.
Where holder and observer run on one machine, the kernel's lock on the file says at once whether the holder lives.
The process that writes the run's files renews the lease: whatever stops one stops the other.

A generation is created by linking a complete file to its name, which fails if the name exists, on network file
systems, too. Whoever takes over links the next generation, then looks again: another claim than its own and the
one it buried means that it came second, and it withdraws.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from srlrace.console import fail
from srlrace.files import FileError, read_limited
from srlrace.orphans import LEASE

BEAT = 10.0  # s between two renewals
GIVE_UP = 40.0  # s without a renewal after which a holder stops working; ours: four beats
PATIENCE = 90.0  # s without a change after which an observer takes over; GIVE_UP and the slowest file system's delay
LIMIT = 4096  # bytes of a lease file
FOLDER = ".leases"
LOST = 75  # exit status of a process whose run somebody else has taken over (EX_TEMPFAIL of sysexits.h)

logger = logging.getLogger(__name__)


def boot_id() -> str:
    """What tells one running kernel from another: its file locks reach no further."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return socket.gethostname()


@dataclass(frozen=True)
class Seen:
    """A lease file as found: its place and what stood in it."""

    path: Path
    content: bytes

    @property
    def generation(self) -> int:
        """Each takeover counts one up."""
        return int(self.path.suffix[1:])

    @property
    def facts(self) -> Mapping[str, Any]:
        """What the holder wrote; empty when it is not readable."""
        with suppress(ValueError):
            facts = json.loads(self.content)
            return facts if isinstance(facts, dict) else {}
        return {}


@dataclass(frozen=True)
class Lease:
    """A lease that this process holds, until it lets go or dies."""

    path: Path
    token: str
    descriptor: int  # holds the kernel's lock on the file

    def child_environment(self, environment: Mapping[str, str]) -> dict[str, str]:
        """The environment of a child that works on the run and renews the lease meanwhile."""
        return {**environment, LEASE: f"{self.token} {self.path}"}

    def release(self) -> None:
        """Let go; somebody else's lease is left alone."""
        if _token(self.path) == self.token:
            self.path.unlink(missing_ok=True)
        os.close(self.descriptor)


@dataclass
class Leases:
    """The leases of one runs folder, as one process sees them over time."""

    root: Path
    machine: str = field(default_factory=boot_id)
    clock: Callable[[], float] = time.monotonic
    _watched: dict[str, tuple[Seen, float]] = field(default_factory=dict)

    @property
    def folder(self) -> Path:
        """Where the lease files are."""
        return self.root / FOLDER

    def claim(self, run: str) -> Lease | None:
        """Take the lease of a run; None while somebody else has it, or may still have it."""
        held = self.current(run)
        if held is not None and not self._dead(run, held):
            return None
        lease = self._create(run, held.generation + 1 if held else 1)
        if lease is None:
            return None
        others = [seen for seen in self._all(run) if seen.path != lease.path]
        if others != ([held] if held else []):
            lease.release()
            return None
        if held is not None:
            held.path.unlink(missing_ok=True)
            logger.info("%s: taken over from %s", run, describe(held))
        self._watched.pop(run, None)
        return lease

    def current(self, run: str) -> Seen | None:
        """The newest lease of a run, whoever holds it and whether alive or not."""
        return max(self._all(run), key=lambda seen: seen.generation, default=None)

    def _all(self, run: str) -> list[Seen]:
        paths = sorted(self.folder.glob(f"{run}.*"))
        return [_look(path) for path in paths if path.suffix[1:].isdigit() and path.stem == run and path.exists()]

    def _dead(self, run: str, held: Seen) -> bool:
        if held.facts.get("machine") == self.machine and held.facts.get("locked") is True:
            return _unlocked(held.path)
        seen, since = self._watched.get(run, (None, 0.0))
        if seen != held:
            self._watched[run] = (held, self.clock())
            return False
        return self.clock() - since >= PATIENCE

    def _create(self, run: str, generation: int) -> Lease | None:
        self.folder.mkdir(parents=True, exist_ok=True)
        token = secrets.token_hex(8)
        draft, path = self.folder / f".{token}.tmp", self.folder / f"{run}.{generation}"
        descriptor = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            facts = {"token": token, "machine": self.machine, "locked": _locked(descriptor),
                     "host": socket.gethostname(), "pid": os.getpid()}  # fmt: skip
            os.pwrite(descriptor, _content(facts, 0), 0)
            os.fsync(descriptor)
            os.link(draft, path)
        except FileExistsError:
            os.close(descriptor)
            return None
        finally:
            draft.unlink(missing_ok=True)
        return Lease(path, token, descriptor)


def _look(path: Path) -> Seen:
    try:
        return Seen(path, read_limited(path, LIMIT))
    except FileError:
        return Seen(path, b"")  # what cannot be read is a lease that does not change


def describe(seen: Seen) -> str:
    """Who holds a lease, in words; nothing in it is trusted."""
    return f"process {str(seen.facts.get('pid', '?'))[:10]} on {str(seen.facts.get('host', '?'))[:64]!r}"


def renew(path: Path, token: str) -> bool:
    """Show that the holder lives; False when the lease is somebody else's by now. Raises OSError."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        facts = Seen(path, os.pread(descriptor, LIMIT, 0)).facts
        if facts.get("token") != token:
            return False
        os.pwrite(descriptor, _content(facts, int(facts["beat"]) + 1), 0)
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
    return True


def keep_lease() -> None:
    """In a child of a sweep: renew the lease that it was given, and leave at once when it is lost."""
    token, _, path = os.environ.pop(LEASE, "").partition(" ")
    if path:
        threading.Thread(target=_keep, args=(Path(path), token), daemon=True).start()


def _keep(path: Path, token: str) -> None:
    renewed = time.monotonic()
    while True:
        try:
            if not renew(path, token):
                break
            renewed = time.monotonic()
        except OSError:
            if time.monotonic() - renewed > GIVE_UP:
                break
        time.sleep(BEAT)
    fail(f"{path.stem}: somebody else has taken it over; left to them")
    os._exit(LOST)  # files are written atomically: leaving here breaks nothing


def _content(facts: Mapping[str, Any], beat: int) -> bytes:
    """What stands in a lease file; of one length for all beats, so that it can be replaced in place."""
    return (json.dumps({**facts, "beat": f"{beat:012d}"}) + "\n").encode()


def _token(path: Path) -> str:
    with suppress(FileError):
        return str(Seen(path, read_limited(path, LIMIT)).facts.get("token"))
    return ""


def _locked(descriptor: int) -> bool:
    """Lock a file until this process closes it; False on a file system without locks, where the heartbeat has to do."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _unlocked(path: Path) -> bool:
    """Whether no process of this machine has the file locked."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True
