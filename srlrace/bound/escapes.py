"""Ways out of hard starts, for training to learn from: where an episode begins, and what to do there at first.

Some starts of an episode are survived by hardly any sequence of actions: close to a tree, tilted towards it; low and
falling. Exploration does not find what saves a drone there (docs/training.md), a search does
(`srlrace.evaluation.escape`).
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srlrace.bound.store import SHIPPED, cache_folder, first_sound, keep
from srlrace.config import to_dict
from srlrace.files import FileError, read_limited
from srlrace.schema import Config
from srlrace.task.reset import record_size

REVISION = 1  # of the search: a change that moves results makes older ones obsolete
ACTIONS, HOLD = 5, 4  # actions of a way out, and control periods for which each is held: 0.4 s
LIMIT = 2**21  # bytes of a file: some ten thousand ways out
FOLDER_NAME = "escapes"
FOLDER = SHIPPED / FOLDER_NAME


@dataclass(frozen=True, eq=False)
class Escapes:
    """Hard starts of one map, each with a way out."""

    start: NDArray[np.float64]  # (m, record size), as `srlrace.task.reset` remembers a passing
    action: NDArray[np.float64]  # (m, ACTIONS, 4), within [-1, 1]


def escapes_key(config: Config) -> str:
    """Name of the ways out for a training configuration: a hash of all that they depend on."""
    parts = {name: to_dict(getattr(config, name)) for name in ("env", "level", "quad", "sim", "randomization")}
    for name in ("name", "laps", "horizon"):  # a start knows nothing of these
        del parts["env"][name]
    return hashlib.sha256(f"{REVISION} {json.dumps(parts, sort_keys=True)}".encode()).hexdigest()[:16]


def load_escapes(config: Config) -> Escapes | None:
    """Return the ways out for a configuration, shipped or found here; None where there are none that are sound."""
    size = record_size(len(config.env.waypoints))
    return first_sound(escapes_key(config), (FOLDER,), FOLDER_NAME, lambda path: _read(path, size))


def save_escapes(config: Config, found: Escapes, folder: Path | None = None) -> Path:
    """Keep ways out for later commands; returns their file."""
    start, action = found.start.astype(np.float32), found.action.astype(np.float16)
    return keep(folder or cache_folder() / FOLDER_NAME, escapes_key(config), start=start, action=action)


def _read(path: Path, size: int) -> Escapes:
    with np.load(io.BytesIO(read_limited(path, LIMIT)), allow_pickle=False) as data:
        start, action = np.asarray(data["start"], np.float64), np.asarray(data["action"], np.float64)
    m = len(start)
    fits = m > 0 and start.shape == (m, size) and action.shape == (m, ACTIONS, 4)
    sound = fits and np.isfinite(start).all() and (np.abs(action) <= 1.0).all()
    begins = sound and (start[:, -2:] == 0.0).all()  # no step flown, on the only map
    if not begins or not np.allclose(np.linalg.norm(start[:, 6:10], axis=1), 1.0, atol=1e-3):
        raise FileError(f"cannot read {path}: not ways out of starts")
    return Escapes(start, action)
