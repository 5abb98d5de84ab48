"""Throughput on this machine: dynamics, race step, VecEnv step and training, one thread each.

Every figure is the best and the median of several rounds: on a shared machine the best round is the
one that was disturbed least. Rates are environment steps per second, one step being one control period
(20 ms of flight) of one drone.
"""

from __future__ import annotations

import json
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO

from srlrace.config import Config
from srlrace.files import atomic_write
from srlrace.hydra_bridge import compose
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.ppo import build_ppo
from srlrace.provenance import cpu_name, versions
from srlrace.sim.dynamics import advance
from srlrace.task.race import Race, RaceMode, commands
from srlrace.task.vec_env import RaceVecEnv

ROUNDS = 9
ROUND_SECONDS = 0.25
DRONES = 100  # as the paper trains
ACTIONS = 64  # random action batches, used in turn


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    what: str
    work: str
    precision: str
    drones: int
    threads: int
    best: float  # environment steps per second
    median: float  # environment steps per second


def random_actions(drones: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return batches of random actions, (batches, drones, 4)."""
    return np.random.default_rng(0).uniform(-1, 1, (ACTIONS, drones, 4)).astype(np.float32)


def rates(step: Callable[[int], Any], drones: int) -> tuple[float, float]:
    """Return the best and the median rate of ``step``, called with a running number."""
    for k in range(ACTIONS):
        step(k)
    figures = []
    for _ in range(ROUNDS):
        calls, began = 0, time.perf_counter()
        while (spent := time.perf_counter() - began) < ROUND_SECONDS:
            for k in range(ACTIONS):
                step(k)
            calls += ACTIONS
        figures.append(calls * drones / spent)
    return max(figures), statistics.median(figures)


def bench_dynamics(config: Config, dtype: Any) -> Row:
    """Time the dynamics alone, fed with random commands; states are put back before they drift away."""
    race = Race(config, RaceMode.training(0, DRONES), dtype=dtype)
    race.reset()
    rules, start = race.rules, race.fleet.state.copy()
    state = start.copy()
    asked = np.ascontiguousarray(commands(rules, random_actions(DRONES)).transpose(0, 2, 1), dtype)

    def step(k: int) -> None:
        if k == 0:
            state[:] = start
        advance(state, asked[k], race.fleet.plant, rules.airframe, rules.dt, rules.substeps)

    best, median = rates(step, DRONES)
    work = f"rate controller and RK4, {rules.substeps} substeps"
    return Row("dynamics", work, np.dtype(dtype).name, DRONES, 1, best, median)


def bench_race(config: Config, what: str, drones: int = DRONES) -> Row:
    """Time the fused race step, resets included."""
    race = Race(config, RaceMode.training(0, drones))
    race.reset()
    actions = random_actions(drones)
    best, median = rates(lambda k: race.step(actions[k]), drones)
    obstacles = len(race.field.obstacles(0))
    return Row(what, f"nearest {race.rules.nearest} of {obstacles} obstacles", "float32", drones, 1, best, median)


def bench_vec_env(config: Config) -> Row:
    """Time the complete step as SB3 sees it, infos and copies included."""
    env = RaceVecEnv(config, DRONES)
    env.reset()
    actions = random_actions(DRONES)
    best, median = rates(lambda k: env.step(actions[k]), DRONES)
    obstacles = len(env.race.field.obstacles(0))
    return Row("VecEnv step", f"race step and SB3 interface, {obstacles} obstacles", "float32", DRONES, 1, best, median)


def bench_training(config: Config) -> list[Row]:
    """Time whole training iterations, rollout and update, in turn with those of stock SB3 at the same settings."""
    algo = config.algo
    batch = algo.n_envs * algo.n_steps
    learners = {"training": LeanPPO, "training, stock SB3": PPO}
    models = [build_ppo(config, RaceVecEnv(config), learner) for learner in learners.values()]
    seconds: list[list[float]] = [[] for _ in models]
    for _ in range(ROUNDS + 1):
        for model, spent in zip(models, seconds, strict=True):
            began = time.perf_counter()
            model.learn(batch, reset_num_timesteps=False)
            spent.append(time.perf_counter() - began)
    seconds = [spent[1:] for spent in seconds]  # the first rounds compile and allocate
    ratio = statistics.median(stock / lean for lean, stock in zip(*seconds, strict=True))
    network = "-".join(str(units) for units in algo.policy_layers)
    work = f"{algo.n_envs} x {algo.n_steps}, batch {algo.batch_size}, {algo.n_epochs} epochs, net {network}"
    notes = (f"{work}; {ratio:.2f} times stock SB3", work)
    return [
        Row(what, note, "float32", algo.n_envs, algo.threads, batch / min(spent), batch / statistics.median(spent))
        for what, note, spent in zip(learners, notes, seconds, strict=True)
    ]


def measure() -> list[Row]:
    """Measure every row of the table, one thread."""
    torch.set_num_threads(1)
    config = compose([])
    return [
        bench_dynamics(config, np.float32),
        bench_dynamics(config, np.float64),
        bench_race(compose(["level=none"]), "race step, no obstacles"),
        bench_race(config, "race step"),
        bench_race(compose(["level=3"]), "race step, dense"),
        bench_race(compose(["observation=rays"]), "race step, rays"),
        bench_race(config, "race step, many drones", 1000),
        bench_vec_env(config),
        *bench_training(config),
    ]


def table(rows: list[Row]) -> Table:
    """Return the rows for the terminal."""
    drawn = Table(title=f"env-steps per second, thousands ({cpu_name()}, {platform.system()})")
    for heading in ("what", "work of one step", "precision"):
        drawn.add_column(heading)
    for heading in ("drones", "threads", "best", "median"):
        drawn.add_column(heading, justify="right")
    for row in rows:
        figures = (f"{row.best / 1e3:,.0f}", f"{row.median / 1e3:,.0f}")
        drawn.add_row(row.what, row.work, row.precision, str(row.drones), str(row.threads), *figures)
    return drawn


def run(path: Path | None = None) -> None:
    """Measure, print the table, and write it as JSON to ``path`` if given."""
    rows = measure()
    Console().print(table(rows))
    if path is not None:
        machine = {"cpu": cpu_name(), "platform": platform.platform(), "versions": versions()}
        atomic_write(path, json.dumps({"machine": machine, "rows": [asdict(row) for row in rows]}, indent=1) + "\n")
