"""What an evaluation says: ``episodes.csv``, one row an episode, and ``summary.json``."""

from __future__ import annotations

import csv
import io
import math
from typing import Any

import numpy as np

from srlrace.evaluation.suites import Suite
from srlrace.provenance import versions
from srlrace.report.stats import wilson
from srlrace.suites import definition
from srlrace.task.arrays import FINISHED, MIN_CLEARANCE, OUTCOMES, PATH_LENGTH, PEAK_BODY_RATE, PEAK_SPEED
from srlrace.task.race import Race

CRASHES = ("crashed", "out_of_bounds", "diverged")
COLUMNS = (
    "episode",
    "seed",
    "map",
    "outcome",
    "time_s",
    "lap_time_s",
    "last_gate_time_s",
    "gates_passed",
    "min_clearance_m",
    "mean_speed_mps",
    "peak_speed_mps",
    "path_length_m",
    "peak_body_rate_radps",
)


def episode_rows(suite: Suite, race: Race) -> list[dict[str, Any]]:
    """Return one row of `COLUMNS` per episode."""
    return [episode_row(suite, race, i) for i in range(race.n)]


def episode_row(suite: Suite, race: Race, i: int) -> dict[str, Any]:
    """Return the row of episode ``i``; times that do not exist are None."""
    out, track = race.output, suite.config.env
    seconds = float(out.time[i])
    passed = int(out.final_target[i])
    passing = out.final_passing_time[:, i]
    gates = len(track.waypoints)
    finished = out.outcome[i] == FINISHED
    obstacles = suite.field.obstacles(int(race.fleet.map[i]))
    has_lap = track.laps > 0 and passed > gates
    return {
        "episode": i,
        "seed": suite.seed,
        "map": suite.map_seeds[int(race.fleet.map[i])],
        "outcome": OUTCOMES[int(out.outcome[i])],
        "time_s": seconds if finished else None,
        "lap_time_s": float(passing[gates]) - float(passing[0]) if has_lap else None,
        "last_gate_time_s": float(passing[gates - 1]) if passed >= gates else None,
        "gates_passed": passed,
        "min_clearance_m": float(out.final_tally[MIN_CLEARANCE, i]) if obstacles else None,
        "mean_speed_mps": float(out.final_tally[PATH_LENGTH, i]) / seconds,
        "peak_speed_mps": float(out.final_tally[PEAK_SPEED, i]),
        "path_length_m": float(out.final_tally[PATH_LENGTH, i]),
        "peak_body_rate_radps": float(out.final_tally[PEAK_BODY_RATE, i]),
    }


def rows_csv(rows: list[dict[str, Any]]) -> bytes:
    """Return ``episodes.csv``: floats with six decimals, so that equal episodes are equal bytes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for row in rows:
        values = (row[column] for column in COLUMNS)
        writer.writerow("" if v is None else f"{v:.6f}" if isinstance(v, float) else v for v in values)
    return text.getvalue().encode()


def mean_or_none(values: list[float]) -> float | None:
    """Return the mean, or None of nothing."""
    return math.fsum(values) / len(values) if values else None


def summarise(run_id: str, suite: Suite, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return ``summary.json``: counts, crash ratio with its interval, and times that say what they cover."""
    outcomes = {name: sum(row["outcome"] == name for row in rows) for name in OUTCOMES[1:]}
    crashes = sum(outcomes[name] for name in CRASHES)
    timed = "lap_time_s" if suite.config.env.laps else "time_s"
    finished = [row for row in rows if row["outcome"] == "finished"]
    times = [row[timed] for row in finished]
    horizon = suite.config.env.horizon
    mean = mean_or_none(times)
    disturbed = definition(suite.disturbance)
    return {
        "format": 1,
        "run": run_id,
        "suite": suite.name,
        **({"disturbance": disturbed} if disturbed else {}),
        "episodes": len(rows),
        "evaluation_seed": suite.seed,
        "maps": len(suite.map_seeds),
        "horizon_s": horizon,
        "timed": timed,
        "outcomes": outcomes,
        "crash_ratio": crashes / len(rows),
        "crash_interval": list(wilson(crashes, len(rows))),
        "time_mean_s": mean,
        "time_std_s": float(np.std(times)) if times else None,
        "penalised_time_s": (math.fsum(times) + horizon * (len(rows) - len(times))) / len(rows),
        "mean_speed_mps": mean_or_none([row["mean_speed_mps"] for row in finished]),
        "peak_speed_mps": max(row["peak_speed_mps"] for row in rows),
        "min_clearance_m": min(
            (row["min_clearance_m"] for row in finished if row["min_clearance_m"] is not None), default=None
        ),
        "versions": versions(),
    }
