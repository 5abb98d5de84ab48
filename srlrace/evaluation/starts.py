"""Which of a suite's starts no sequence of actions survives: failures that no policy can be blamed for.

    python -m srlrace.evaluation.starts env=forest level=mixed --suite level2

searches, for each start, among random sequences of held actions and variations of those that lasted longest. A start
counts as lost when none of them flies on for `LASTING` seconds. The search may miss a way out, so its count is one from
above; what it finds is flown in the simulator of the evaluation, so that every other start is survivable for that long.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from srlrace.config import ConfigError
from srlrace.console import setup_logging
from srlrace.evaluation.suites import Suite, make_suite
from srlrace.hydra_bridge import compose
from srlrace.runs import RunError
from srlrace.task.arrays import FLYING
from srlrace.task.race import Race

LASTING = 0.8  # s; who hits what stands beside the start has done so by then
PLANS = 4096  # sequences of actions a round
ROUNDS = 12
ELITE = 64  # sequences of a round that the next one varies
HOLD = (2, 20)  # control periods that an action is held for, from and below
KEPT = 0.9  # share of a sequence's actions that a variation keeps
EXTREMES = (-1.0, 0.0, 1.0)  # of each action, as policies give them

logger = logging.getLogger("srlrace.starts")


def lost_starts(suite: Suite, episodes: Iterable[int], seed: int = 0) -> list[int]:
    """Return those of the episodes whose start no sequence of actions was found to survive."""
    rng = np.random.default_rng(seed)
    steps = round(LASTING / suite.config.sim.control_period)
    left = np.array(list(episodes))
    for _ in range(ROUNDS):  # most starts need no search
        lived = fly_plans(suite.race(left), random_plans(rng, steps, len(left)))
        left = left[lived < steps]
    return [episode for episode in left.tolist() if not _survivable(suite, episode, rng, steps)]


def _survivable(suite: Suite, episode: int, rng: np.random.Generator, steps: int) -> bool:
    elite: NDArray[np.float32] | None = None
    for _ in range(ROUNDS):
        plans = random_plans(rng, steps, PLANS)
        if elite is not None:
            half = PLANS // 2
            keep = rng.random((steps, half, 1)) < KEPT
            plans[:, :half] = np.where(keep, elite[:, rng.integers(0, ELITE, half)], plans[:, :half])
        lived = fly_plans(suite.race(np.full(PLANS, episode)), plans)
        if lived.max() >= steps:
            return True
        elite = plans[:, np.argsort(lived)[-ELITE:]]
    return False


def random_plans(rng: np.random.Generator, steps: int, count: int) -> NDArray[np.float32]:
    """Draw sequences of extreme actions, each held for a while: (steps, count, 4)."""
    plans = np.empty((steps, count, 4), np.float32)
    action, left = np.zeros((count, 4), np.float32), np.zeros(count, np.int64)
    for step in range(steps):
        over = left == 0
        action[over] = rng.choice(EXTREMES, size=(int(over.sum()), 4))
        left[over] = rng.integers(*HOLD, int(over.sum()))
        plans[step] = action
        left -= 1
    return plans


def fly_plans(race: Race, plans: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the number of steps after which each drone was still flying, (n,)."""
    race.reset()
    lived = np.zeros(race.n, np.int64)
    for actions in plans:
        flying = race.step(actions).outcome == FLYING
        lived += flying
        if not flying.any():
            break
    return lived


def main(arguments: list[str]) -> None:
    """Search a suite of a configuration: overrides, ``--suite``, its name."""
    if len(arguments) < 2 or arguments[-2] != "--suite":
        raise SystemExit("usage: python -m srlrace.evaluation.starts [OVERRIDE ...] --suite NAME")
    *overrides, _, name = arguments
    try:
        suite = make_suite(compose(overrides), name)
    except (ConfigError, RunError) as error:
        raise SystemExit(str(error)) from None
    lost = lost_starts(suite, range(1000))
    logger.info("%s: %d of 1000 starts are survived by no sequence of actions: %s", name, len(lost), lost)


if __name__ == "__main__":
    setup_logging()
    main(sys.argv[1:])
