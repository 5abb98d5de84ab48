"""What a training reports while it runs: ``progress.csv`` and TensorBoard."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srlrace.task.reward import TERMS

if TYPE_CHECKING:
    from srlrace.learn.events import EventFile

LEARNER = ("approx_kl", "clip_fraction", "value_loss", "policy_gradient_loss", "explained_variance", "std")
COLUMNS = (
    "steps",
    "wall_s",
    "steps_per_s",
    "episodes",
    "success_ratio",
    "crash_ratio",
    "obstacle_ratio",
    "out_of_bounds_ratio",
    "timeout_ratio",
    "time_s",
    "gates_passed",
    "reward",
    *(f"reward/{term}" for term in TERMS),
    "collision_weight",
    "learning_rate",
    *(f"train/{name}" for name in LEARNER),
)


def outcome_ratios(ledger: dict[str, float], steps: int) -> dict[str, float | None]:
    """Turn a race's ledger over ``steps`` steps into ratios and means; None where no episode ended."""
    episodes, finished = ledger["episodes"], ledger["finished"]

    def per_episode(total: float) -> float | None:
        return total / episodes if episodes else None

    terms = {f"reward/{term}": ledger[f"reward/{term}"] / steps for term in TERMS}
    return {
        "episodes": episodes,
        "success_ratio": per_episode(finished),
        "crash_ratio": per_episode(ledger["crashed"] + ledger["out_of_bounds"] + ledger["diverged"]),
        "obstacle_ratio": per_episode(ledger["crashed"]),
        "out_of_bounds_ratio": per_episode(ledger["out_of_bounds"]),
        "timeout_ratio": per_episode(ledger["timeout"]),
        "time_s": ledger["finish_time"] / finished if finished else None,
        "gates_passed": per_episode(ledger["gates_passed"]),
        "reward": sum(terms.values()),
        **terms,
    }


def row_text(row: dict[str, Any]) -> str:
    """Return one line of ``progress.csv``."""
    line = io.StringIO()
    values = [row.get(column) for column in COLUMNS]
    csv.writer(line, lineterminator="\n").writerow(
        "" if v is None else (f"{v:.6g}" if isinstance(v, float) and not v.is_integer() else f"{v:.0f}") for v in values
    )
    return line.getvalue()


class ProgressFile:
    """``progress.csv``, cut back to the checkpoint's length when a training resumes."""

    def __init__(self, path: Path, length: int) -> None:
        self._stream = path.open("r+b" if path.exists() else "w+b")
        self._stream.truncate(min(length, os.path.getsize(path)))  # noqa: PTH202 - of the open file
        self._stream.seek(0, os.SEEK_END)
        if self._stream.tell() == 0:
            self._stream.write((",".join(COLUMNS) + "\n").encode())

    def append(self, row: dict[str, Any]) -> None:
        """Add a row."""
        self._stream.write(row_text(row).encode())

    def sync(self) -> int:
        """Put what was written on disk; return the file's length."""
        self._stream.flush()
        os.fsync(self._stream.fileno())
        return self._stream.tell()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def figures_text(row: dict[str, Any]) -> str:
    """Return speed, outcome ratios, time and reward of a progress row in a few words."""

    def figure(name: str, scale: float, form: str) -> str:
        value = row.get(name)
        return "-" if value is None else form.format(value * scale)

    return "  ".join(
        (
            figure("steps_per_s", 1e-3, "{:.0f} k/s"),
            f"finished {figure('success_ratio', 100, '{:.0f} %')}",
            f"crashed {figure('crash_ratio', 100, '{:.0f} %')}",
            figure("time_s", 1, "{:.2f} s"),
            f"reward {figure('reward', 1, '{:.2f}')}",
        )
    )


def write_scalars(writer: EventFile, row: dict[str, Any]) -> None:
    """Write a progress row to TensorBoard."""
    for name, value in row.items():
        if value is not None and name != "steps":
            writer.add_scalar(name if "/" in name else f"race/{name}", value, int(row["steps"]))
