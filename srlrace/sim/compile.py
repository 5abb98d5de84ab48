"""How srlrace compiles its numba functions, and where the machine code is kept.

Numba's cache notices an edit of the file that defines a function, but not of the files that function calls
into. The cache folder therefore carries a hash of every source file with kernels in it: any edit starts an
empty cache, and old machine code is never run.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba import njit
from numba.core import config as numba_config

# Reordering and contraction only: no "nnan" or "ninf", so that tests for NaN and infinity keep their meaning.
FASTMATH = frozenset({"contract", "nsz", "arcp", "reassoc", "afn"})
LAYERS = ("sim", "world", "task", "learn")  # packages with kernels; each calls only itself and those before it
KEPT = 8  # cache folders of a layer, some megabytes each: ours, room for checkouts and versions used side by side


def source_digest(root: Path, layers: tuple[str, ...]) -> str:
    """Hash every Python source below `root`/`layers`, and the versions of the compiler."""
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {sys.version}".encode())
    for layer in layers:
        for path in sorted((root / layer).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]


def user_cache_folder() -> Path:
    """Folder for cached data: ``NUMBA_CACHE_DIR`` where the user set it, else srlrace's own."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "srlrace"


def private_folder(path: Path) -> bool:
    """Make `path` and tell whether only its owner, who is us, can write to it: cached kernels are executed."""
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.stat()
    except OSError:
        return False
    ours = not hasattr(os, "getuid") or status.st_uid == os.getuid()
    return ours and not status.st_mode & 0o022 and os.access(path, os.W_OK | os.X_OK)


def keep_newest(path: Path) -> None:
    """Note that the cache folder `path` is in use, and remove those of its layer that were not for longest."""
    name = re.compile(re.escape(path.name.rpartition("-")[0]) + "-[0-9a-f]{16}")
    with suppress(OSError):  # another process may be doing the same
        os.utime(path)
        with os.scandir(path.parent) as entries:
            found = [entry for entry in entries if name.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)]
        for old in sorted(found, key=lambda entry: entry.stat().st_mtime_ns, reverse=True)[KEPT:]:
            shutil.rmtree(old, ignore_errors=True)


@functools.cache
def cache_folder(layer: str) -> str:
    """Content-addressed folder for the kernels of `layer`; a fresh temporary one where ours is not usable."""
    below = LAYERS[: LAYERS.index(layer) + 1] if layer in LAYERS else LAYERS
    try:
        path = user_cache_folder() / f"kernels-{below[-1]}-{source_digest(Path(__file__).parents[1], below)}"
    except RuntimeError:  # no home directory
        return tempfile.mkdtemp(prefix="srlrace-kernels-")
    if not private_folder(path):
        return tempfile.mkdtemp(prefix="srlrace-kernels-")
    keep_newest(path)
    return str(path)


def _compile(function: Callable[..., Any], **options: Any) -> Any:
    # The folder is numba-wide: set it for this decoration only, so that other users of numba keep theirs.
    layer = function.__module__.removeprefix("srlrace.").split(".")[0]
    config: Any = numba_config
    previous, config.CACHE_DIR = config.CACHE_DIR, cache_folder(layer)
    try:
        return njit(cache=True, nogil=True, error_model="numpy", fastmath=set(FASTMATH), **options)(function)
    finally:
        config.CACHE_DIR = previous


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that Python calls at every step, once per combination of argument types.

    Without numba's reference counting (``_nrt``): counting the dozens of arrays that a step passes around, with
    atomic instructions, would take longer than the step itself. Such functions cannot allocate arrays.

    Better call `inline` functions from a kernel than other kernels: of those, a process that compiles and one that
    loads from the cache may run different copies, which may round differently.
    """
    return _compile(function, _nrt=False)


def inline(function: Callable[..., Any]) -> Any:
    """Compile a small function that kernels call; LLVM always merges it into its caller. Cannot allocate arrays."""
    return _compile(function, forceinline=True, _nrt=False)


def builder(function: Callable[..., Any]) -> Any:
    """Compile a function of the set-up, which may allocate arrays."""
    return _compile(function)
