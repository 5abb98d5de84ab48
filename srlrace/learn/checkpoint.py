"""Checkpoints: the complete state of a training, written so that a kill at any moment loses nothing.

Each generation is two files, ``<steps>.safetensors`` and ``<steps>.json``. The JSON file is written last
and carries the SHA-256 of the other and of itself: a generation counts only when both agree. The two newest
generations are kept, so a file that was damaged later still leaves the one before it.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from srlrace.files import FileError, atomic_write, naming, read_json, read_limited, write_sealed
from srlrace.learn.tensors import MAX_BYTES, TensorFileError, pack, unpack

logger = logging.getLogger(__name__)

KEPT = 2  # generations


@dataclass(frozen=True)
class Checkpoint:
    """One complete state: arrays, and what is said about them."""

    steps: int
    arrays: dict[str, NDArray[Any]]
    facts: dict[str, Any]


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a generation and drop those that are no longer needed.

    The folder is not synced, which would take a third of the time: after a power cut the generation before may be
    the newest.
    """
    folder.mkdir(exist_ok=True)
    data = pack(checkpoint.arrays, {})
    stem = f"{checkpoint.steps:015d}"
    atomic_write(folder / f"{stem}.safetensors", data, durable=False)
    facts = {"steps": checkpoint.steps, "sha256": hashlib.sha256(data).hexdigest(), "facts": checkpoint.facts}
    write_sealed(folder / f"{stem}.json", facts, durable=False)
    keep = {path.stem for path in sorted(folder.glob("*.json"))[-KEPT:]}
    with naming(folder):
        for suffix in (".json", ".safetensors"):  # in this order: no seal is ever without what it seals
            for path in folder.glob(f"*{suffix}"):
                if path.stem not in keep:
                    path.unlink(missing_ok=True)


def load_generation(seal_path: Path) -> Checkpoint:
    """Load one generation; `TensorFileError` says what is wrong with it."""
    try:
        seal = read_json(seal_path)
        digest, steps, facts = str(seal["sha256"]), int(seal["steps"]), dict(seal["facts"])
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise TensorFileError(f"{seal_path}: {error}") from None
    path = seal_path.with_suffix(".safetensors")
    data = read_limited(path, MAX_BYTES)
    if hashlib.sha256(data).hexdigest() != digest:
        raise TensorFileError(f"{path}: checksum does not match")
    return Checkpoint(steps, unpack(data, str(path))[0], facts)


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """Return the newest complete state, or None; damaged generations are named in a warning and passed over."""
    if not folder.is_dir():
        return None
    for seal_path in sorted(folder.glob("*.json"), reverse=True):
        try:
            return load_generation(seal_path)
        except (FileError, OSError) as error:
            logger.warning("checkpoint passed over, using the one before it: %s", error)
    return None
