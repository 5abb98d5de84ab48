"""Flying an evaluation: all episodes side by side in one race, and the trajectories that are kept of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.evaluation.suites import Suite
from srlrace.learn.policy import act
from srlrace.recording import Flight, SceneObstacle
from srlrace.task.arrays import FLYING
from srlrace.task.race import Race, commands
from srlrace.world.obstacles import Obstacle


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
        command = commands(race.rules, np.clip(action[:k], -1.0, 1.0))
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


def scene_obstacle(obstacle: Obstacle) -> SceneObstacle:
    """Describe an obstacle of the world for drawing."""
    x, _, z = obstacle.size
    if obstacle.kind == "box":
        return SceneObstacle("box", obstacle.center, edge=x)
    return SceneObstacle(
        obstacle.kind, obstacle.center, radius=0.5 * x, height=z if obstacle.kind == "cylinder" else 0.0
    )


def fly(policy: ActorCriticPolicy, suite: Suite, episodes: int, recorded: int) -> tuple[Race, History | None]:
    """Fly ``episodes`` episodes of the suite to their ends, keeping the trajectories of the first ``recorded``."""
    race = suite.race(np.arange(episodes))
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
