"""Finds T_ref of the unseen maps that policies are judged on (``make unseen-references``), for the package.

Map by map, the suites in turn; what is solved is kept. Stopped, or with a larger count, it goes on where it was.
"""

from __future__ import annotations

import itertools
import json
import logging
import sys
import time
from dataclasses import replace

import numpy as np

from srlrace.bound.command import clear_paths
from srlrace.bound.model import Model, quick_body
from srlrace.bound.problem import problem_of
from srlrace.bound.solver import BoundError, find_reference
from srlrace.bound.store import TIMES, UNSEEN, load, sample_key, save, unseen_times
from srlrace.bound.trajectory import Reference
from srlrace.config import Config
from srlrace.console import setup_logging
from srlrace.files import atomic_write, read_json
from srlrace.hydra_bridge import compose
from srlrace.task.certificate import unseen_maps

RESTARTS = {"1": 1, "2": 1, "3": 2}  # by level: in a dense wood different starts lead to different ways through it
logger = logging.getLogger("srlrace.bound")


def solve_map(config: Config, free: Reference, body: Model) -> float | None:
    """Solve and keep the reference of a configuration's map; return its time, s, None where no start leads to one."""
    problem = problem_of(config)
    try:
        paths = clear_paths(config, problem, free.trajectory)
        reference = find_reference(problem, RESTARTS[config.level.name], paths, free, body)
    except BoundError as error:
        logger.warning("map %d: %s", config.level.map_seed, error)
        return None
    save(problem, reference, UNSEEN, np.float32)
    kept = load(problem)
    return round(kept.time, 6) if kept else None


def enter(key: str, seed: int, seconds: float | None) -> None:
    """Add the time of a map to the table that ships."""
    table = read_json(TIMES)
    table[key] = table.get(key, {}) | {str(seed): seconds}
    atomic_write(TIMES, json.dumps(table, indent=0, sort_keys=True) + "\n")


def main(count: int, levels: tuple[str, ...]) -> None:
    """Solve the first ``count`` maps of each level's suite."""
    track = compose(["env=forest", "level=none"])
    problem = problem_of(track)
    free = load(problem)
    if free is None:
        raise SystemExit("the track without obstacles comes first: srlrace bound env=forest level=none")
    suites = [compose(["env=forest", f"level={level}"]) for level in levels]
    seeds = [unseen_maps(suite, count) for suite in suites]
    pairs = list(zip(suites, seeds, strict=True))
    with quick_body(problem) as body:
        for index, (suite, drawn) in itertools.product(range(count), pairs):
            if drawn[index] in unseen_times(problem, suite.level):
                continue
            began = time.process_time()
            config = replace(suite, level=replace(suite.level, map_seed=drawn[index]))
            solved = solve_map(config, free, body)
            enter(sample_key(problem, suite.level), drawn[index], solved)
            spent = time.process_time() - began
            logger.info("level %s, map %d: %s s, %.1f s of CPU", suite.level.name, drawn[index], solved, spent)


if __name__ == "__main__":
    setup_logging()
    main(int(sys.argv[1]), tuple(sys.argv[2:]) or tuple(RESTARTS))
