"""The race as Gymnasium environments: ``srlrace/Forest-v0`` and ``srlrace/SplitS-v0``, single and vector.

Registered by `srlrace.task.registration`, which importing this module does too.
``gymnasium.make(..., overrides=["reward=no_safety"])`` takes the overrides of ``srlrace train``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from srlrace.config import Config
from srlrace.task.arrays import FLYING, OUTCOMES, TIMEOUT
from srlrace.task.race import Race, RaceMode
from srlrace.task.registration import register
from srlrace.task.reward import TERMS
from srlrace.task.vec_env import action_space, observation_space

register()


def compose_config(track: str, overrides: Sequence[str]) -> Config:
    """Compose the configuration of an environment as ``srlrace train env=TRACK ...`` would."""
    from srlrace.hydra_bridge import compose

    return compose([f"env={track}", *overrides])


class DroneRaceEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One drone on one track; reaching the horizon truncates, every other end terminates."""

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium declares it so

    def __init__(self, track: str = "forest", overrides: Sequence[str] = (), config: Config | None = None) -> None:
        self.config = config or compose_config(track, overrides)
        self._race = self._make_race(self.config.seed)
        self.observation_space = observation_space(self._race.observation_size)
        self.action_space = action_space()

    def _make_race(self, seed: int, shared: Race | None = None) -> Race:
        mode = RaceMode.evaluation(seed, np.zeros(1, np.int64))
        return Race(self.config, mode, shared.field if shared else None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; ``seed`` restarts the random numbers."""
        super().reset(seed=seed)
        if seed is not None:
            self._race = self._make_race(seed, self._race)
        return self._race.reset()[0].copy(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Fly one control period with collective thrust and body rates in [-1, 1]^4."""
        out = self._race.step(np.asarray(action, np.float32).reshape(1, -1))
        outcome = int(out.outcome[0])
        info = {
            "outcome": OUTCOMES[outcome],
            "reward_terms": dict(zip(TERMS, out.reward_terms[:, 0].tolist(), strict=True)),
        }
        ended = outcome != FLYING
        observation = out.terminal_observation if ended else out.observation
        truncated = outcome == TIMEOUT
        return observation[0].copy(), float(out.reward[0]), ended and not truncated, truncated, info


class DroneRaceVectorEnv(VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]):
    """n drones stepped together; an episode that ends restarts within the same step."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self, num_envs: int = 1, track: str = "forest", overrides: Sequence[str] = (), config: Config | None = None
    ) -> None:
        self.config = config or compose_config(track, overrides)
        self.num_envs = num_envs
        self._race = self._make_race(self.config.seed)
        self.single_observation_space = observation_space(self._race.observation_size)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def _make_race(self, seed: int, shared: Race | None = None) -> Race:
        mode = RaceMode(seed, np.arange(self.num_envs), autoreset=True, curriculum=False)
        return Race(self.config, mode, shared.field if shared else None)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode of every drone; ``seed`` restarts the random numbers."""
        super().reset(seed=seed)
        if seed is not None:
            self._race = self._make_race(seed, self._race)
        return self._race.reset().copy(), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Advance every drone; ``infos`` holds ``final_obs`` and ``outcome`` of the episodes that ended."""
        out = self._race.step(np.ascontiguousarray(actions, np.float32))
        ended = out.outcome != FLYING
        truncated = out.outcome == TIMEOUT
        infos: dict[str, Any] = {}
        if ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(ended):
                final[i] = out.terminal_observation[i].copy()
            infos = {
                "final_obs": final,
                "_final_obs": ended.copy(),
                "outcome": np.array([OUTCOMES[code] for code in out.outcome], dtype=object),
                "_outcome": ended.copy(),
            }
        return out.observation.copy(), out.reward.astype(np.float64), ended & ~truncated, truncated, infos
