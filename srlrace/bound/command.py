"""``srlrace bound``: find, store, print and record the time-optimal reference of a training configuration."""

from __future__ import annotations

import importlib.util
import logging
from dataclasses import replace
from pathlib import Path

from rich.table import Table

from srlrace.bound.demonstration import Demonstration, load_demonstration, save_demonstration
from srlrace.bound.problem import Problem, problem_of
from srlrace.bound.record import write_recording
from srlrace.bound.store import cache_folder, load, save
from srlrace.bound.trajectory import Array, Reference, Trajectory
from srlrace.checks import check_single_map
from srlrace.config import Config, ConfigError
from srlrace.world.flyable import clear_path

logger = logging.getLogger("srlrace.bound")


def bound(config: Config, race: bool, stop: bool, restarts: int, again: bool, out: Path | None) -> tuple[Table, Path]:
    """Return the table to print and the recording's path; raises `ConfigError` or `srlrace.bound.solver.BoundError`."""
    problem = problem_of(config, "race" if race else "lap", stop)
    if problem.lap and stop:
        raise ConfigError("--stop: a flying lap has no end to stop at; add --race")
    reference = None if again else load(problem)
    if reference is None:
        reference = solve(config, problem, restarts)
        save(problem, reference)
    path = out or cache_folder() / f"{problem.key}.mcap"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_recording(path, config, problem, reference)
    return _table(config, problem, reference), path


def demonstrate(config: Config, again: bool) -> tuple[Table, Path]:
    """Find the flight that ``curriculum=taught`` shows and keep it; returns what to print, and its file."""
    check_single_map(config, "--demonstrate")
    found, problem = None if again else load_demonstration(config), problem_of(config, "race")
    if found is None:
        reference = load(problem)
        if reference is None:
            reference = solve(config, problem, 1)
            save(problem, reference)
        found = _demonstrated(config, reference.trajectory)
    path = save_demonstration(config, found)
    table = Table(show_header=False, box=None)
    table.add_row("track", f"{config.env.name}, level {config.level.name}, from rest")
    table.add_row("demonstrated", f"{found.duration:.3f} s")
    table.add_row("kind", "of the quadrotor as simulated, with room for errors; what curriculum=taught shows at first")
    return table, path


def _demonstrated(config: Config, reference: Trajectory) -> Demonstration:
    _need_solver()
    from srlrace.bound.demonstrate import find_demonstration

    return find_demonstration(config, reference)


def solve(config: Config, problem: Problem, restarts: int) -> Reference:
    """Solve a problem; with obstacles, the way through them is sought near the flight without them."""
    _need_solver()
    from srlrace.bound.solver import find_reference

    if not problem.obstacles:
        return find_reference(problem, restarts)
    free_problem = replace(problem, obstacles=(), keep_out=0.0)
    free = load(free_problem)
    if free is None:
        free = find_reference(free_problem, 1)
        save(free_problem, free)
    logger.info("without obstacles: %.3f s", free.time)
    return find_reference(problem, restarts, clear_paths(config, problem, free.trajectory), free)


def _need_solver() -> None:
    if importlib.util.find_spec("casadi") is None:
        raise ConfigError("srlrace bound needs CasADi to solve; install it with: pip install 'srlrace[bound]'")


def clear_paths(config: Config, problem: Problem, free: Trajectory) -> list[list[Array]]:
    """Ways through the obstacles of a course: the clear path nearest to the flight without them, and the roomiest."""
    if problem.lap:
        return []
    found = (clear_path(config.env, problem.obstacles, problem.keep_out, near) for near in (free.state[:, :3], None))
    return [path for path in found if path]


def _table(config: Config, problem: Problem, reference: Reference) -> Table:
    table = Table(show_header=False, box=None)
    what = "flying lap" if problem.lap else "from rest, to rest" if problem.stop else "from rest"
    solid = f", {len(problem.obstacles)} obstacles" if problem.obstacles else ""
    table.add_row("track", f"{config.env.name}, level {config.level.name}{solid}, {what}")
    table.add_row("T_ref", f"{reference.time:.3f} s")
    spread = ", ".join(f"{time:.3f}" for time in sorted(reference.times))
    table.add_row("restarts", f"{spread} s")
    table.add_row("point mass", f"{reference.point_mass_time:.3f} s")
    table.add_row("thrust-to-weight", f"{problem.max_collective / 9.81:.2f}")
    table.add_row("kind", "best known, of a model without rotor lag and control period; no proof of optimality")
    return table
