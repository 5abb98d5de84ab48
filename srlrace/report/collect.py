"""Read the evaluated runs below a folder; what cannot be read is reported, never trusted and never fatal."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from srlrace.runs import TABLES, RunError, RunFolder, State, list_runs
from srlrace.schema import AlgoConfig, Config
from srlrace.suites import definition, disturbance_of, suite_names

GATES_LIMIT = 1_001_000  # a thousand laps of a thousand waypoints, the most that a track may have, and the first again
CRASHES = ("crashed", "out_of_bounds", "diverged")  # what the crash ratio counts
MANY = 100  # folders that are read by several processes: of fewer, one has read most when the others have started
READERS = 8  # processes: beyond that the disk is what is waited for
CHUNK = 16  # folders handed to a process at a time
OUTCOMES = ("finished", "timeout", *CRASHES)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """One suite flown by one run, one entry per episode; arrays are (episodes,)."""

    suite: str
    seed: int  # evaluation seed; -1 where the summary does not say
    horizon_s: float  # time limit of an episode
    newest: float  # when it was written, s since the epoch
    episode: npt.NDArray[np.int64]
    map_seed: npt.NDArray[np.int64]
    finished: npt.NDArray[np.bool_]
    crashed: npt.NDArray[np.bool_]
    time_s: npt.NDArray[np.float64]  # lap time on lap tracks, else time to the last waypoint; NaN unless finished
    total_time_s: npt.NDArray[np.float64]  # from the reset to the end of the course; NaN unless finished
    outcome: npt.NDArray[np.str_]  # one of OUTCOMES
    gates_passed: npt.NDArray[np.int64]
    min_clearance_m: npt.NDArray[np.float64]  # from the hull to the nearest obstacle; NaN where nothing stands


@dataclass(frozen=True, eq=False)
class Run:
    """One run folder, as far as the report needs it."""

    id: str
    path: Path
    config: Config
    state: State
    evaluations: dict[str, Evaluation] = field(default_factory=dict)

    @property
    def preset(self) -> tuple[object, ...]:
        """Everything that makes up the method and its task: all of the configuration but seed, budget and label."""
        return preset(self.config)

    @property
    def algo(self) -> AlgoConfig:
        """The algorithm and its budget."""
        return self.config.algo


def preset(config: Config) -> tuple[object, ...]:
    """Return the parts of a configuration that a table's row fixes: a run with one weight changed is another method."""
    return tuple(value for key, value in vars(config).items() if key not in ("seed", "name", "algo"))


def collect(root: Path) -> tuple[tuple[Run, ...], tuple[str, ...]]:
    """Return the runs below ``root`` and, for every file that could not be used, a line saying why."""
    read = _read_all(list_runs(root))
    return tuple(run for run, _ in read if run), tuple(line for _, problems in read for line in problems)


def _read_all(folders: list[RunFolder]) -> list[tuple[Run | None, list[str]]]:
    cores = os.cpu_count() or 1
    if len(folders) < MANY or cores == 1:
        return list(map(_read, folders))
    # Ctrl-C is for the one who waits: it stops handing out folders, and the processes end.
    workers = min(cores, READERS)
    with ProcessPoolExecutor(workers, None, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as readers:
        return list(readers.map(_read, folders, chunksize=CHUNK))


def _read(folder: RunFolder) -> tuple[Run | None, list[str]]:
    try:
        run = Run(folder.id, folder.path, folder.load_config(), folder.state)
    except RunError as error:
        return None, [str(error)]
    return run, _read_suites(folder, run)


def _read_suites(folder: RunFolder, run: Run) -> list[str]:
    problems = []
    for suite in _flown_suites(folder):
        try:
            run.evaluations[suite] = read_evaluation(folder, suite, run.config)
        except (OSError, ValueError, OverflowError) as error:
            problems.append(f"{run.id}: eval/{suite} cannot be read: {error}")
    return problems


def _flown_suites(folder: RunFolder) -> list[str]:
    """The suites with a table, in the order in which suites are listed."""
    try:
        present = {path.name for path in (folder.path / "eval").iterdir()}
    except OSError:
        return []
    known = [suite for suite in suite_names() if suite in present]
    return [suite for suite in known if any((folder.path / "eval" / suite / name).is_file() for name in TABLES)]


def read_evaluation(folder: RunFolder, suite: str, config: Config) -> Evaluation:
    """Read ``eval/<suite>``; raises OSError, ValueError or OverflowError with what is wrong."""
    path = folder.table(suite)
    summary = folder.summary(suite)
    if summary.get("disturbance", {}) != definition(disturbance_of(suite)):
        raise ValueError(f"flown under another disturbance; repeat: srlrace eval {folder.id} --suite {suite}")
    timed = "lap_time_s" if config.env.laps else "time_s"
    columns = {"episode", "map", "outcome", "gates_passed", "min_clearance_m", "time_s", timed}
    # Outcomes as plain objects: the library's own type of text is slower than all the rest of the file.
    content = BytesIO(folder.episodes(suite, summary))
    table = pd.read_csv(content, usecols=sorted(columns), dtype={"outcome": object})
    if table.empty:
        raise ValueError("no episode")
    unknown = set(table["outcome"].tolist()) - set(OUTCOMES)
    if unknown:
        raise ValueError(f"unknown outcome {min(map(str, unknown))[:40]!r}")
    outcome = table["outcome"].to_numpy(dtype=np.str_)
    finished = outcome == "finished"
    time_s = pd.to_numeric(table[timed]).to_numpy(dtype=np.float64)
    if not (np.isfinite(time_s[finished]) & (time_s[finished] > 0)).all():
        raise ValueError(f"a finished episode without {timed}")
    return Evaluation(
        suite=suite,
        seed=_evaluation_seed(summary),
        horizon_s=config.env.horizon,
        newest=path.stat().st_mtime,
        episode=table["episode"].to_numpy(dtype=np.int64),
        map_seed=table["map"].to_numpy(dtype=np.int64),
        finished=finished,
        crashed=np.isin(outcome, CRASHES),
        time_s=np.where(finished, time_s, np.nan),
        total_time_s=np.where(finished, pd.to_numeric(table["time_s"]).to_numpy(dtype=np.float64), np.nan),
        outcome=outcome,
        gates_passed=_counts(table["gates_passed"]),
        min_clearance_m=pd.to_numeric(table["min_clearance_m"]).to_numpy(dtype=np.float64),
    )


def _counts(column: pd.Series) -> npt.NDArray[np.int64]:
    counts = column.to_numpy(dtype=np.int64)
    if not ((counts >= 0) & (counts <= GATES_LIMIT)).all():
        raise ValueError("gates_passed out of range")
    return counts


def _evaluation_seed(summary: dict[str, Any]) -> int:
    seed = summary.get("evaluation_seed", -1)
    return seed if isinstance(seed, int) else -1
