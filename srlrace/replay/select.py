"""Which episodes of an evaluation a replay shows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from srlrace.runs import RunError

MAX_FLIGHTS = 40  # in one page, 25 kB each: more are neither told apart nor scrolled through
FAILURES = 3  # failed flights that a page of one run brings along


@dataclass(frozen=True)
class Wish:
    """What the command line asked for; at most one of them."""

    episodes: tuple[int, ...] = ()
    worst: bool = False
    crashes: bool = False
    overlay: int = 0

    def __post_init__(self) -> None:
        wishes = {
            "--episode": self.episodes,
            "--worst": self.worst,
            "--crashes": self.crashes,
            "--overlay": self.overlay,
        }
        asked = [name for name, value in wishes.items() if value]
        if len(asked) > 1:
            raise RunError(f"{' and '.join(asked)} exclude each other")
        if max(len(self.episodes), self.overlay) > MAX_FLIGHTS:
            raise RunError(f"a replay holds at most {MAX_FLIGHTS} flights")

    @property
    def needs_table(self) -> bool:
        """Whether all episodes must be compared, not only those that happen to be recorded."""
        return self.worst or self.crashes


@dataclass(frozen=True)
class Selection:
    """Episodes in the page, those of them that it shows at first, and why, in words."""

    episodes: tuple[int, ...]
    shown: tuple[int, ...]
    why: str


def select(table: pd.DataFrame, wish: Wish) -> Selection:
    """Choose episodes from a table of them (columns ``episode``, ``outcome``, ``map``, times).

    Raises `RunError` when no episode is as wished.
    """
    if wish.episodes:
        return _named(table, wish.episodes)
    if wish.worst:
        return _worst(table)
    if wish.crashes:
        return _crashes(table)
    if wish.overlay:
        return _overlay(table, wish.overlay)
    return _typical(table)


def timed(table: pd.DataFrame) -> pd.Series:
    """The time of each finished flight [s], NaN for others: the lap's where laps are timed, else to the last gate."""
    if "lap_time_s" in table and table["lap_time_s"].notna().any():
        return table["lap_time_s"].where(table["outcome"] == "finished")
    return table["time_s"].where(table["outcome"] == "finished")


def _named(table: pd.DataFrame, wanted: tuple[int, ...]) -> Selection:
    missing = sorted(set(wanted) - set(table["episode"]))
    if missing:
        raise RunError(f"episode {missing[0]}: there are {len(table)} episodes, {_span(table)}")
    unique = tuple(dict.fromkeys(wanted))
    return Selection(unique, unique, f"episode{'s' if len(unique) > 1 else ''} {_list(unique)}")


def _worst(table: pd.DataFrame) -> Selection:
    failed = _failed(table)
    if failed.empty:
        slowest = int(np.nanargmax(timed(table).to_numpy()))
        number = int(table["episode"].iloc[slowest])
        return Selection((number,), (number,), f"episode {number}, the slowest: none of {len(table)} failed")
    order = [name for name in ("gates_passed", "episode") if name in failed]
    worst = failed.sort_values(order, kind="stable").iloc[0]
    number = int(worst["episode"])
    after = f" after {int(worst['gates_passed'])} gates" if "gates_passed" in failed else ""
    return Selection((number,), (number,), f"episode {number}, the worst of {len(table)}: {worst['outcome']}{after}")


def _crashes(table: pd.DataFrame) -> Selection:
    failed = _failed(table)
    if failed.empty:
        raise RunError(f"none of {len(table)} episodes failed")
    numbers = tuple(int(number) for number in failed["episode"][:MAX_FLIGHTS])
    first = f"the first {len(numbers)} of " if len(numbers) < len(failed) else ""
    return Selection(numbers, numbers[:1], f"{first}{len(failed)} failed of {len(table)} episodes")


def _overlay(table: pd.DataFrame, count: int) -> Selection:
    same = table[table["map"] == table["map"].iloc[0]]
    numbers = tuple(int(number) for number in same["episode"][:count])
    short = "" if len(numbers) == count else f" (all on the map of episode {numbers[0]})"
    return Selection(numbers, numbers, f"{len(numbers)} flights on one map{short}")


def _typical(table: pd.DataFrame) -> Selection:
    """The flight of median time first, with the fastest, the slowest and some failures to compare it with."""
    ranked = table.loc[timed(table).dropna().sort_values(kind="stable").index, "episode"].astype(int).tolist()
    failures = [int(number) for number in _failed(table)["episode"][:FAILURES]]
    if not ranked:
        return Selection(tuple(failures), tuple(failures[:1]), f"episode {failures[0]}: none of {len(table)} finished")
    median = ranked[(len(ranked) - 1) // 2]
    numbers = tuple(dict.fromkeys([median, ranked[0], ranked[-1], *failures]))
    others = f", with the fastest, the slowest{' and failures' if failures else ''}" if len(numbers) > 1 else ""
    return Selection(numbers, (median,), f"episode {median}, of median time among {len(ranked)} finished{others}")


def _failed(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["outcome"] != "finished"]


def _list(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers))


def _span(table: pd.DataFrame) -> str:
    return f"{table['episode'].min()} to {table['episode'].max()}"
