"""Evaluation: the deterministic policy on frozen initial conditions, one row an episode.

Initial conditions depend on the suite and the episode's number alone: every method meets the same
ones (common random numbers), and no training draws them. All episodes fly side by side in one race.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.config import Config, LevelConfig, to_dict
from srlrace.files import atomic_write
from srlrace.learn.policy import act, load_policy
from srlrace.provenance import versions
from srlrace.recording import Flight, RecordingWriter, SceneObstacle
from srlrace.report.stats import wilson
from srlrace.runs import RunError, RunFolder
from srlrace.task.arrays import FINISHED, FLYING, MIN_CLEARANCE, OUTCOMES, PATH_LENGTH, PEAK_BODY_RATE, PEAK_SPEED
from srlrace.task.race import Race, RaceMode
from srlrace.task.reward import TERMS
from srlrace.world.field import ObstacleField
from srlrace.world.flyable import unseen_maps

logger = logging.getLogger(__name__)

EVALUATION_SEED = 20_240_401  # first word of every evaluation stream; ours, arbitrary, never a training seed
UNSEEN_MAPS = 100  # per level
SUITES = ("train_map", "level1", "level2", "level3")
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


@dataclass(frozen=True)
class Suite:
    """What a policy is evaluated on: a configuration to fly in, and the seeds of its maps."""

    name: str
    config: Config
    map_seeds: tuple[int, ...]
    field: ObstacleField


def preset_level(name: str) -> LevelConfig:
    """Return the obstacle level that ``level=NAME`` means."""
    from srlrace.hydra_bridge import compose

    return compose([f"level={name}"]).level


def make_suite(config: Config, name: str) -> Suite:
    """Build a suite for a run's configuration: its own maps, or certified ones that no training has seen.

    Initial conditions are those of ``randomization=init`` whatever the training drew.
    """
    from srlrace.hydra_bridge import compose

    if name not in SUITES:
        raise RunError(f"suite: got {name!r}, takes one of {', '.join(SUITES)}")
    level = config.level if name == "train_map" else preset_level(name.removeprefix("level"))
    flown = dataclasses.replace(config, level=level, randomization=compose(["randomization=init"]).randomization)
    if name == "train_map":
        seeds = tuple(range(level.map_seed, level.map_seed + level.maps))
    else:
        seeds = unseen_maps(flown.env, level, UNSEEN_MAPS, config.quad.arm_length)
    observation = flown.observation
    field = ObstacleField.of_seeds(flown.env, level, seeds, observation.obstacles, observation.range)
    return Suite(name, flown, seeds, field)


class History:
    """The trajectories of the first ``count`` episodes, kept step by step."""

    def __init__(self, race: Race, count: int) -> None:
        self.count = count
        self._rows: list[tuple[NDArray[Any], ...]] = []
        self._last = np.zeros(count, np.int64)  # row of each episode's last state
        self.keep(race, np.zeros((race.n, 4), np.float32), np.ones(race.n, np.bool_))

    def keep(self, race: Race, action: NDArray[np.float32], flying: NDArray[np.bool_]) -> None:
        """Keep the state that a step led to; ``flying`` are the episodes that were on when it began."""
        k, out = self.count, race.output
        started = bool(self._rows)
        collective = 0.5 * (np.clip(action[:k, :1], -1, 1) + 1) * race.rules.max_collective
        command = np.hstack([collective, np.clip(action[:k, 1:], -1, 1) * race.rules.body_rate_max])
        self._rows.append(
            (
                race.fleet.state[:, :k].copy(),
                command * started,
                out.reward_terms[:, :k] * started,
                out.clearance[:k] + race.rules.arm_length,
                race.fleet.target[:k].copy(),
            )
        )
        self._last[flying[:k]] = len(self._rows) - 1

    def flights(self, suite: Suite, race: Race, rows: list[dict[str, Any]]) -> Iterator[Flight]:
        """Yield the flights in the order of their episodes."""
        scenes = {m: tuple(scene_obstacle(o) for o in suite.field.obstacles(m)) for m in set(race.fleet.map.tolist())}
        state, command, terms, clearance, target = (np.stack(part) for part in zip(*self._rows, strict=True))
        for i in range(self.count):
            end = int(self._last[i]) + 1
            flown = state[:end, :, i]
            yield Flight(
                episode=i,
                seed=rows[i]["seed"],
                map_seed=rows[i]["map"],
                outcome=rows[i]["outcome"],
                finish_time=rows[i]["time_s"],
                time=np.arange(end, dtype=np.float64) * race.rules.dt,
                position_w=flown[:, 0:3],
                velocity_w=flown[:, 3:6],
                quaternion_wb=flown[:, 6:10],
                body_rate_b=flown[:, 10:13],
                rotor_thrust=flown[:, 13:17],
                action=command[:end, i],
                reward_terms=terms[:end, :, i],
                clearance=clearance[:end, i],
                target=race.rules.sequence[np.minimum(target[:end, i], len(race.rules.sequence) - 1)],
                waypoints=race.fleet.waypoints[:, :, i],
                scene=scenes[int(race.fleet.map[i])],
            )


def scene_obstacle(obstacle: Any) -> SceneObstacle:
    """Describe an obstacle of the world for drawing."""
    x, _, z = obstacle.size
    if obstacle.kind == "box":
        return SceneObstacle("box", obstacle.center, edge=x)
    return SceneObstacle(
        obstacle.kind, obstacle.center, radius=0.5 * x, height=z if obstacle.kind == "cylinder" else 0.0
    )


def fly(policy: ActorCriticPolicy, suite: Suite, episodes: int, recorded: int) -> tuple[Race, History | None]:
    """Fly ``episodes`` episodes of the suite to their ends, keeping the trajectories of the first ``recorded``."""
    race = Race(suite.config, RaceMode.evaluation(EVALUATION_SEED, np.arange(episodes)), suite.field)
    observation = race.reset()
    history = History(race, recorded) if recorded else None
    flying = np.ones(episodes, np.bool_)
    while flying.any():
        action = act(policy, observation)
        out = race.step(action)
        if history:
            history.keep(race, action, flying)
        flying = out.outcome == FLYING
    return race, history


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
        "seed": EVALUATION_SEED,
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
    return {
        "format": 1,
        "run": run_id,
        "suite": suite.name,
        "episodes": len(rows),
        "evaluation_seed": EVALUATION_SEED,
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


def recorded_count(record: str, episodes: int) -> int:
    """Return how many episodes ``--record`` asks for: all, none, or a number."""
    if record in ("all", "none"):
        return episodes if record == "all" else 0
    if record.isdecimal():
        return min(int(record), episodes)
    raise RunError(f"record: got {record!r}, takes all, none or a number of episodes")


def write_recording(path: Path, run: RunFolder, suite: Suite, flights: Iterator[Flight], episodes_csv: bytes) -> None:
    """Write the flights of an evaluation as one MCAP."""
    metadata = {"run": run.id, "suite": suite.name, "evaluation_seed": str(EVALUATION_SEED), **versions()}
    config_json = json.dumps(to_dict(suite.config), indent=1).encode()
    track = suite.config.env
    with RecordingWriter(
        path,
        metadata=metadata,
        reward_terms=TERMS,
        horizon=track.horizon,
        config_json=config_json,
        passing_radius=track.passing_radius,
    ) as writer:
        for flight in flights:
            writer.write(flight)
        writer.finish(episodes_csv)


def evaluate_run(run: RunFolder, episodes: int, suite: str = "train_map", record: str = "all") -> dict[str, Any]:
    """Evaluate a run's policy and write ``eval/<suite>/``; return the summary.

    Raises `RunError` for a bad request and `srlrace.files.FileError` for a policy that cannot be used.
    """
    if episodes < 1:
        raise RunError(f"episodes: got {episodes}, takes a whole number of at least 1")
    recorded = recorded_count(record, episodes)
    config = run.load_config()
    torch.set_num_threads(config.algo.threads)
    policy = load_policy(config, run.path / "policy.safetensors")
    prepared = make_suite(config, suite)
    race, history = fly(policy, prepared, episodes, recorded)
    rows = episode_rows(prepared, race)
    folder = run.path / "eval" / suite
    folder.mkdir(parents=True, exist_ok=True)
    table = rows_csv(rows)
    recording = folder / "trajectories.mcap"
    if history:
        write_recording(recording, run, prepared, history.flights(prepared, race, rows), table)
    else:
        recording.unlink(missing_ok=True)  # it would show another evaluation's flights
    summary = summarise(run.id, prepared, rows)
    atomic_write(folder / "episodes.csv", table)
    atomic_write(folder / "summary.json", json.dumps(summary, indent=1) + "\n")
    return summary
