"""Solved references as files, named by the content of their problems: those that ship, and those solved here.

Reading takes numpy only, so a report shows its gaps without the solver. Nothing read is unpickled.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from srlrace.bound.accept import Rejected, accept
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Reference, Trajectory
from srlrace.config import to_dict
from srlrace.files import FileError, atomic_write, read_json, read_limited
from srlrace.schema import LevelConfig

SHIPPED = Path(__file__).parent / "data"
UNSEEN = SHIPPED / "unseen"  # solutions of unseen maps; single precision is enough for the acceptance tests
TIMES = SHIPPED / "unseen.json"  # their times by `sample_key` and map seed, s, so that a report need not read them all
LIMIT = 4 * 2**20  # bytes of a file: a thousand waypoints


Content = TypeVar("Content")


def cache_folder() -> Path:
    """Where solved references are kept between commands: ``$XDG_CACHE_HOME/srlrace/bound``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "srlrace" / "bound"


def load(problem: Problem) -> Reference | None:
    """Return the stored reference of a problem, shipped or solved here; None where there is none that still passes."""

    def read(path: Path) -> Reference:
        reference = _read(path)
        accept(problem, reference.trajectory, reference.point_mass_time)
        return reference

    return first_sound(problem.key, (SHIPPED, UNSEEN), "", read)


def first_sound(key: str, shipped: Sequence[Path], kind: str, read: Callable[[Path], Content]) -> Content | None:
    """Read the file named ``key`` from the folders that ship, then from the cache's folder of a ``kind``.

    Returns what ``read`` makes of the first that is there and sound, None where there is none.
    """
    folders = list(shipped)
    with suppress(RuntimeError):  # no home folder
        folders.append(cache_folder() / kind)
    for path in (folder / f"{key}.npz" for folder in folders):
        try:
            if path.is_file():
                return read(path)
        except (FileError, Rejected, ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error):
            continue
    return None


def keep(folder: Path, key: str, **arrays: ArrayLike) -> Path:
    """Write named arrays to the file named ``key`` of a folder; returns it."""
    folder.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    path = folder / f"{key}.npz"
    atomic_write(path, content.getvalue())
    return path


def reference_time(problem: Problem) -> float | None:
    """Return T_ref of a problem as stored, s; None where it is not solved."""
    reference = load(problem)
    return reference.time if reference else None


def sample_key(free: Problem, level: LevelConfig) -> str:
    """Name of the maps of a level on a track, by content; ``free`` is the problem without obstacles."""
    drawn = ("name", "maps", "map_seed", "fresh_steps")  # say which maps are drawn; the rest, what each is like
    settings = {key: value for key, value in to_dict(level).items() if key not in drawn}
    text = json.dumps([free.key, settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def unseen_times(free: Problem, level: LevelConfig) -> dict[int, float | None]:
    """Return T_ref, s, of the maps of a level that ship solved, by map seed; None where no solution was found.

    A sample in the order of evaluation: of the presets the first maps, of anything else none.
    """
    return {int(seed): time for seed, time in _samples(TIMES).get(sample_key(free, level), {}).items()}


@cache
def _samples(path: Path) -> dict[str, dict[str, float | None]]:
    return dict(read_json(path))


def save(problem: Problem, reference: Reference, folder: Path | None = None, width: type = np.float64) -> Path:
    """Keep a reference for later commands, its states in floats of a ``width``; returns its file."""
    best = reference.trajectory
    return keep(
        folder or cache_folder(),
        problem.key,
        state=best.state.astype(width),
        thrust=best.thrust.astype(width),
        step=best.step,
        times=reference.times,
        point_mass_time=reference.point_mass_time,
    )


def _read(path: Path) -> Reference:
    with np.load(io.BytesIO(read_limited(path, LIMIT)), allow_pickle=False) as data:
        state, thrust, step = (np.asarray(data[name], np.float64) for name in ("state", "thrust", "step"))
        times, floor = np.asarray(data["times"], np.float64), float(data["point_mass_time"])
    n = NODES * len(step)
    if state.shape != (n + 1, 13) or thrust.shape != (n, 4) or times.ndim != 1 or not len(times):
        raise FileError(f"cannot read {path}: not a reference")
    return Reference(Trajectory(state, thrust, step), times, floor)
