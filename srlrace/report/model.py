"""What a report says, typed: renderers only lay it out."""

from __future__ import annotations

from dataclasses import dataclass

from srlrace.report.experiments import Experiment, PaperCell


@dataclass(frozen=True)
class Estimate:
    """A value and its 95 % interval, in the unit of the quantity."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Numbers:
    """What the runs of one cell show."""

    time_s: Estimate | None  # mean over seeds of the mean over finished flights; None if none finished
    time_iqm_s: Estimate | None  # interquartile mean over seeds; None with fewer than four
    crash_pct: Estimate  # mean over seeds of the crash ratio
    crash_iqm_pct: Estimate | None
    penalised_time_s: float  # like the time, but over all flights, a failure counting as the horizon
    finished: int  # flights, over all seeds
    crashed: int
    episodes: int
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Cell:
    """One row of a table: a method in an environment, on one suite."""

    environment: str
    method: str
    suite: str
    paper: PaperCell
    command: str  # fills the cell, or completes its seeds
    numbers: Numbers | None = None  # None: not run
    t_ref_s: float | None = None  # time-optimal reference
    compared_s: float | None = None  # mean time of the flights held against it; None: of all that finished
    runs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def gap_pct(self) -> float | None:
        """How much slower than the time-optimal reference."""
        if self.t_ref_s is None or self.numbers is None or self.numbers.time_s is None:
            return None
        flown = self.numbers.time_s.value if self.compared_s is None else self.compared_s
        return 100 * (flown / self.t_ref_s - 1)


@dataclass(frozen=True)
class Comparison:
    """A paired difference of two cells on the seeds that both have."""

    environment: str
    first: str
    second: str
    quantity: str
    seeds: int
    difference: Estimate  # first minus second, in s or percentage points


@dataclass(frozen=True)
class Table:
    """One experiment's cells."""

    experiment: Experiment
    cells: tuple[Cell, ...]
    comparisons: tuple[Comparison, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class OtherRun:
    """An evaluated run that stands in no table."""

    run: str
    method: str
    suite: str
    numbers: Numbers


@dataclass(frozen=True)
class Report:
    """The tables, the evaluated runs outside them, and what could not be read."""

    tables: tuple[Table, ...]
    others: tuple[OtherRun, ...]
    problems: tuple[str, ...]
