"""Copies finished runs to where they are published: all that a reader can check a number by, and small.

Run it as ``make reference``. Checkpoints, recordings and locks stay behind; tables of episodes are packed, and
``progress.csv`` keeps at most `ROWS` rows: a learning curve is drawn from fewer.
"""

import gzip
import math
import sys
from pathlib import Path

from srlrace.files import atomic_write, read_limited
from srlrace.report.learning_figure import PROGRESS_LIMIT
from srlrace.runs import TABLES, RunFolder, State, list_runs

ROWS = 100  # of progress.csv, evenly spaced
WHOLE = ("config.json", "run.json", "policy.safetensors")  # files that are copied as they are
POLICY_LIMIT = 64 * 2**20  # bytes


def publish(run: RunFolder, target: Path) -> None:
    """Copy a finished run to the folder ``target``; raises `RunError` or `FileError` where a file is damaged."""
    for name in WHOLE:
        _write(target / name, read_limited(run.file(name), POLICY_LIMIT))
    _write(target / "progress.csv", thinned(read_limited(run.file("progress.csv"), PROGRESS_LIMIT)))
    for suite in run.evaluations:
        folder = target / "eval" / suite
        for name in ("summary.json", "learning.json"):
            if (run.path / "eval" / suite / name).is_file():
                _write(folder / name, read_limited(run.file("eval", suite, name)))
        plain, packed = (folder / name for name in TABLES)
        _write(packed, gzip.compress(run.episodes(suite), mtime=0))  # equal episodes are equal bytes
        plain.unlink(missing_ok=True)


def thinned(progress: bytes) -> bytes:
    """Return the header of a ``progress.csv`` and at most `ROWS` of its rows: one in so many, counted from the last."""
    header, *rows = progress.splitlines(keepends=True)
    spacing = max(1, math.ceil(len(rows) / ROWS))
    return b"".join([header, *rows[(len(rows) - 1) % spacing :: spacing]])


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, content)


if __name__ == "__main__":
    source, published = map(Path, sys.argv[1:])
    for run in list_runs(source):
        if run.state == State.FINISHED and run.evaluations:
            publish(run, published / run.id)
