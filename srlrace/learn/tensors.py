"""Arrays on disk: safetensors, which hold data only and cannot run code, read with limits."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from srlrace.files import FileError, read_limited

MAX_BYTES = 512 * 2**20  # of a whole file; the largest of ours, a checkpoint of 2 x 256 units, has 5 MiB
MAX_HEADER = 2**20  # bytes of JSON in front of the data

Arrays = dict[str, NDArray[Any]]


class TensorFileError(FileError):
    """A tensor file that cannot be used, with the reason."""


def pack(arrays: Arrays, metadata: dict[str, str]) -> bytes:
    """Return the bytes of a safetensors file holding ``arrays``."""
    return safetensors.numpy.save({name: np.ascontiguousarray(a) for name, a in arrays.items()}, metadata)


def unpack(data: bytes, source: str) -> tuple[Arrays, dict[str, str]]:
    """Return arrays and metadata of a safetensors file's bytes; ``source`` names it in errors."""
    try:
        (header_size,) = struct.unpack("<Q", data[:8])
        if header_size > min(MAX_HEADER, len(data)):
            raise TensorFileError(f"{source}: header of {header_size} bytes")
        header = json.loads(data[8 : 8 + header_size])
        metadata = header.get("__metadata__", {})
        if not all(isinstance(k, str) and isinstance(v, str) for k, v in metadata.items()):
            raise TensorFileError(f"{source}: metadata is not text")
        return safetensors.numpy.load(data), metadata
    except TensorFileError:
        raise
    except (struct.error, ValueError, RecursionError, KeyError, AttributeError, TypeError) as error:
        raise TensorFileError(f"{source}: not a safetensors file ({error})") from None
    except safetensors.SafetensorError as error:
        raise TensorFileError(f"{source}: not a safetensors file ({error})") from None


def read_arrays(path: Path, limit: int = MAX_BYTES) -> tuple[Arrays, dict[str, str]]:
    """Return arrays and metadata of a safetensors file; `TensorFileError` or `FileError` says why it cannot be read."""
    return unpack(read_limited(path, limit), str(path))
