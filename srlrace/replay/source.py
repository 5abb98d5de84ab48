"""Where a replay's flights come from: a recording, or the run's evaluation flown once more."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd

from srlrace.config import Config, ConfigError, method_name, parse_config
from srlrace.console import say
from srlrace.files import FileError
from srlrace.recording import (
    CorruptRecording,
    Flight,
    read_config,
    read_episodes,
    read_flight,
    read_metadata,
    recorded_episodes,
)
from srlrace.runs import RunError, RunFolder, State, find

UNTOLD = 20  # episodes that are flown of a run that was never evaluated
COLUMNS = {
    "episode": np.int64,
    "map": np.int64,
    "outcome": str,
    "time_s": np.float64,
    "lap_time_s": np.float64,
    "gates_passed": np.int64,
}
"""Columns of a table of episodes that a replay uses; recovered recordings lack the last two."""


@dataclass(frozen=True, eq=False)
class Source:
    """Flights of one policy: their table, and the recording or the run that they are read from."""

    name: str  # the run's id, or the file's name
    method: str
    suite: str
    config: Config
    table: pd.DataFrame
    recording: Path | None
    run: RunFolder | None

    @property
    def recorded(self) -> pd.DataFrame:
        """The rows of the table whose flights need not be flown again."""
        if self.recording is None:
            return self.table.iloc[:0]
        return self.table[self.table["episode"].isin(recorded_episodes(self.recording))]

    def flights(self, episodes: Sequence[int]) -> list[Flight]:
        """The flights of these episodes; what is not recorded is flown again, with a word about it.

        Raises `RunError` when that is impossible, CorruptRecording for a damaged file.
        """
        kept = set(self.recorded["episode"])
        missing = [number for number in episodes if number not in kept]
        flown = {flight.episode: flight for flight in self._fly(missing)} if missing else {}
        recording = self.recording
        return [flown[n] if n in flown or recording is None else read_flight(recording, n) for n in episodes]

    def _fly(self, episodes: list[int]) -> list[Flight]:
        if self.run is None or self.run.state is not State.FINISHED:
            raise RunError(f"{self.name} has no recording of episode {episodes[0]}, and no policy to fly it with")
        say(f"{self.name}: not recorded; flying the {len(self.table)} episodes of {self.suite} again. "
            f"To keep them: srlrace eval {self.name} --suite {self.suite}")  # fmt: skip
        return fly_again(self, episodes)


def open_source(root: Path, query: str, suite: str) -> Source:
    """The flights that an argument means: an MCAP file, or a run by id, unique prefix or folder.

    Raises `RunError`, `ConfigError`, CorruptRecording or OSError with a message to the user.
    """
    if query.endswith(".mcap"):
        return _of_recording(Path(query))
    run = find(root, query)
    path = run.file("eval", suite, "trajectories.mcap")
    if path.is_file():
        return replace(_of_recording(path), name=run.id, suite=suite, run=run)
    config = run.load_config()
    table = _table(run, suite)
    if table is None:
        say(f"{run.id}: not evaluated on {suite} yet; flying {UNTOLD} episodes")
        table = flown_table(run, suite, UNTOLD)
    return Source(run.id, method_name(config), suite, config, table, None, run)


def _of_recording(path: Path) -> Source:
    metadata = read_metadata(path)
    config = recorded_config(path)
    table = check_table(read_episodes(path), str(path))
    name, suite = metadata.get("run", path.stem), metadata.get("suite", "")
    return Source(name, method_name(config), suite, config, table, path, None)


def recorded_config(path: Path) -> Config:
    """The configuration that a recording carries; raises CorruptRecording when it is not valid."""
    try:
        return parse_config(json.loads(read_config(path)))
    except (ConfigError, ValueError, RecursionError) as error:
        raise CorruptRecording(f"{path}: its config.json is not valid: {error}") from None


def _table(run: RunFolder, suite: str) -> pd.DataFrame | None:
    """The stored table of an evaluation, or None when there is none."""
    path = run.table(suite)
    if not path.is_file():
        return None
    try:
        table = pd.read_csv(BytesIO(run.episodes(suite)))
    except (ValueError, OverflowError) as error:
        if isinstance(error, (RunError, FileError)):
            raise
        raise RunError(f"{path}: no table of episodes ({str(error).splitlines()[0]})") from None
    return check_table(table, str(path))


def check_table(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """What a replay needs of a table of episodes, as numbers and text; raises `RunError` where that is not in it."""
    if table.empty or not {"episode", "map", "outcome", "time_s"} <= set(table):
        raise RunError(f"{name}: no table of episodes with columns episode, map, outcome, time_s")
    try:
        known = {column: table[column].astype(kind) for column, kind in COLUMNS.items() if column in table}
    except (ValueError, TypeError, OverflowError):
        raise RunError(f"{name}: its table of episodes has text where numbers are expected") from None
    if known["episode"].duplicated().any() or (known["episode"] < 0).any():
        raise RunError(f"{name}: its table of episodes numbers them wrongly")
    return pd.DataFrame(known)


def flown_table(run: RunFolder, suite: str, count: int) -> pd.DataFrame:
    """The table of the first ``count`` episodes, flown now and not stored."""
    from srlrace.replay.fly import fly_suite

    return fly_suite(run, suite, count, 0)[0]


def fly_again(source: Source, episodes: list[int]) -> list[Flight]:
    """Fly the evaluation once more as it was flown, and keep these episodes.

    The whole of it: the policy's arithmetic depends on how many episodes are flown side by side, in the last bit.
    """
    from srlrace.replay.fly import fly_suite

    assert source.run is not None
    table, flights = fly_suite(source.run, source.suite, len(source.table), max(episodes) + 1)
    told, flown = (t.set_index("episode").loc[episodes, "outcome"] for t in (source.table, table))
    for number in flown.index[(told != flown).to_numpy()]:
        say(f"episode {number} {flown[number]} this time; the table of {source.name} says {told[number]}")
    return [flight for flight in flights if flight.episode in set(episodes)]
