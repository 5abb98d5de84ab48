"""The race as one Stable-Baselines3 `VecEnv`: n drones in one process, one kernel call a step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from srlrace.config import Config
from srlrace.task.arrays import EPISODE_RETURN, FINISHED, FLYING, OUTCOMES, TIMEOUT
from srlrace.task.race import ACTION_SIZE, Race, RaceMode


def observation_space(size: int) -> spaces.Box[np.float32]:
    """Return the space of an observation of ``size`` scaled values."""
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


def action_space() -> spaces.Box[np.float32]:
    """Return the space of an action: collective thrust and body rates, each in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (ACTION_SIZE,), np.float32)


class RaceVecEnv(VecEnv):
    """n drones racing; an episode that ends restarts within the same step.

    The info of a drone whose episode ended carries ``terminal_observation``, ``TimeLimit.truncated``
    (true for a timeout, which is then bootstrapped), ``outcome``, ``is_success`` and SB3's ``episode``.
    """

    render_mode = None

    def __init__(self, config: Config, n_envs: int | None = None) -> None:
        n = n_envs or config.algo.n_envs
        self.race = Race(config, RaceMode.training(config.seed, n))
        self._action = np.zeros((n, ACTION_SIZE), np.float32)
        self._reward_scale = np.float32(config.algo.reward_scale)
        super().__init__(n, observation_space(self.race.observation_size), action_space())
        self.reset_infos = [{} for _ in range(n)]

    def reset(self) -> VecEnvObs:
        """Start a new episode of every drone."""
        return self.race.reset().copy()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions (n, 4) for `step_wait`."""
        self._action[...] = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Advance every drone by one control step."""
        out = self.race.step(self._action)
        dones = out.outcome != FLYING
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            infos[i] = self._episode_info(i)
        return out.observation.copy(), out.reward * self._reward_scale, dones, infos

    def _episode_info(self, i: int) -> dict[str, Any]:
        out = self.race.output
        outcome = int(out.outcome[i])
        seconds = float(out.time[i])
        return {
            "terminal_observation": out.terminal_observation[i].copy(),
            "TimeLimit.truncated": outcome == TIMEOUT,
            "outcome": OUTCOMES[outcome],
            "is_success": outcome == FINISHED,
            "episode": {
                "r": float(out.final_tally[EPISODE_RETURN, i]),
                "l": math.ceil(seconds / self.race.rules.dt - 1e-3),  # a finish is timed within its step
                "t": seconds,
            },
        }

    def close(self) -> None:
        """Nothing to release."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the race, once per drone asked for."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Refuse: drones share one race, and its settings come from the `Config`."""
        raise AttributeError(f"cannot set {attr_name}: a race is configured by its Config")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the race, which concerns all drones, once."""
        result = getattr(self.race, method_name)(*method_args, **method_kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No drone is wrapped in a `gymnasium.Wrapper`."""
        return [False] * len(list(self._get_indices(indices)))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Refuse to be reseeded behind the run's back, but accept the seed of the run itself."""
        if seed not in (None, self.race.config.seed):
            raise ValueError(f"this race was seeded with {self.race.config.seed} by its Config, not {seed}")
        return [seed] * self.num_envs
