"""Solved references as files, named by the content of their problems: those that ship, and those solved here.

Reading takes numpy only, so a report shows its gaps without the solver. Nothing read is unpickled.
"""

from __future__ import annotations

import io
import math
import os
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from srlrace.bound.accept import Rejected, accept
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Reference, Trajectory
from srlrace.files import FileError, atomic_write, read_json, read_limited

SHIPPED = Path(__file__).parent / "data"
SAMPLES = "unseen.json"  # keys of the solved unseen maps, by the key of the track without obstacles and by suite
LIMIT = 4 * 2**20  # bytes of a file: a thousand waypoints


def cache_folder() -> Path:
    """Where solved references are kept between commands: ``$XDG_CACHE_HOME/srlrace/bound``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "srlrace" / "bound"


def load(problem: Problem) -> Reference | None:
    """Return the stored reference of a problem, shipped or solved here; None where there is none that still passes."""
    for path in _places(problem):
        try:
            reference = _read(path)
            accept(problem, reference.trajectory, reference.point_mass_time)
        except (FileError, Rejected, ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error):
            continue
        return reference
    return None


def reference_time(problem: Problem) -> float | None:
    """Return T_ref of a problem as stored, s; None where it is not solved."""
    reference = load(problem)
    return reference.time if reference else None


def mean_unseen_time(free: Problem, suite: str) -> float | None:
    """Return the mean T_ref over the solved sample of a suite's unseen maps, s; None where there is no sample.

    ``free`` is the problem without obstacles; samples ship for the presets only.
    """
    sample = read_json(SHIPPED / SAMPLES).get(free.key, {}).get(suite, [])
    times = [_read(SHIPPED / f"{key}.npz").time for key in sample]
    return math.fsum(times) / len(times) if times else None


def save(problem: Problem, reference: Reference, folder: Path | None = None) -> Path:
    """Keep a reference for later commands; returns its file."""
    folder = folder or cache_folder()
    folder.mkdir(parents=True, exist_ok=True)
    best, content = reference.trajectory, io.BytesIO()
    np.savez_compressed(
        content,
        state=best.state,
        thrust=best.thrust,
        step=best.step,
        times=reference.times,
        point_mass_time=reference.point_mass_time,
    )
    path = folder / f"{problem.key}.npz"
    atomic_write(path, content.getvalue())
    return path


def _places(problem: Problem) -> Iterator[Path]:
    try:
        folders = [SHIPPED, cache_folder()]
    except RuntimeError:  # no home folder
        folders = [SHIPPED]
    return (path for path in (folder / f"{problem.key}.npz" for folder in folders) if path.is_file())


def _read(path: Path) -> Reference:
    with np.load(io.BytesIO(read_limited(path, LIMIT)), allow_pickle=False) as data:
        state, thrust, step = (np.asarray(data[name], np.float64) for name in ("state", "thrust", "step"))
        times, floor = np.asarray(data["times"], np.float64), float(data["point_mass_time"])
    n = NODES * len(step)
    if state.shape != (n + 1, 13) or thrust.shape != (n, 4) or times.ndim != 1 or not len(times):
        raise FileError(f"cannot read {path}: not a reference")
    return Reference(Trajectory(state, thrust, step), times, floor)
