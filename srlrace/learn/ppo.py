"""Stable-Baselines3's PPO on the race, and the complete state from which it continues exactly."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch import nn

from srlrace.bound.demonstration import Demonstration, load_demonstration
from srlrace.bound.escapes import Escapes, load_escapes
from srlrace.config import AlgoConfig, Config, ConfigError
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.policy import load_state, policy_arguments, policy_class, state_arrays
from srlrace.learn.polish import Polish
from srlrace.learn.room_ascent import RoomAscent
from srlrace.learn.teacher import Teacher
from srlrace.learn.tensors import TensorFileError
from srlrace.sim.airframe import GRAVITY
from srlrace.task.vec_env import RaceVecEnv


class LearningRate:
    """Adam's step size along the training: held, then falling linearly or geometrically to its final value."""

    def __init__(self, algo: AlgoConfig) -> None:
        self._algo = algo

    def __call__(self, remaining: float) -> float:
        """Return the rate when ``remaining`` (1 to 0) of the training is left."""
        algo = self._algo
        left = min(remaining / (1.0 - algo.learning_rate_hold), 1.0)
        start, end = algo.learning_rate, algo.learning_rate_final
        return end * (start / end) ** left if algo.learning_rate_decay == "geometric" else end + (start - end) * left


def build_ppo(config: Config, env: RaceVecEnv, learner: type[PPO] = LeanPPO) -> PPO:
    """Build PPO as configured, seeded, on ``env``."""
    algo: AlgoConfig = config.algo
    torch.set_num_threads(algo.threads)
    model = learner(
        policy_class(algo),
        env,
        learning_rate=LearningRate(algo),
        n_steps=algo.n_steps,
        batch_size=algo.batch_size,
        n_epochs=algo.n_epochs,
        gamma=algo.gamma,
        gae_lambda=algo.gae_lambda,
        clip_range=algo.clip_range,
        ent_coef=algo.ent_coef,
        vf_coef=algo.vf_coef,
        max_grad_norm=algo.max_grad_norm,
        policy_kwargs=policy_arguments(algo),
        seed=config.seed,
        device="cpu",
    )
    if isinstance(model, LeanPPO):
        model.noise_correlation = algo.noise_correlation
        shown = what_is_shown(config)
        model.teacher = Teacher(env.race, *shown) if shown else None
        flown = env.race, model.policy, model.mean_action, shown[1] if shown else None
        if config.curriculum.room_rate > 0.0:
            model.room_ascent = RoomAscent(*flown)
        if config.curriculum.polish_rounds > 0:
            model.polish = Polish(*flown)
    start_hovering(model, env)
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def what_is_shown(config: Config) -> tuple[Demonstration, Escapes | None] | None:
    """Return the flight and the ways out that the curriculum asks to show, if any.

    Raises `ConfigError` where they are not on file.
    """
    curriculum = config.curriculum
    if curriculum.teaching == 0.0:
        return None
    flight = load_demonstration(config)
    if flight is None:
        raise ConfigError(
            "curriculum.teaching: no flight of this track, level, quadrotor and displacement of waypoints is on file; "
            "find one with: srlrace bound --demonstrate, and the same settings"
        )
    escapes = load_escapes(config) if curriculum.escape_starts > 0.0 else None
    if curriculum.escape_starts > 0.0 and escapes is None:
        raise ConfigError(
            "curriculum.escape_starts: no ways out of hard starts of this track, level, quadrotor and randomization "
            "are on file; find some with: srlrace bound --escapes, and the same settings"
        )
    return flight, escapes


def start_hovering(model: PPO, env: RaceVecEnv) -> None:
    """Bias the untrained policy to hover thrust: an action of zero is twice that, and leaves through the ceiling."""
    with torch.no_grad():
        cast(nn.Linear, model.policy.action_net).bias[0] = 2.0 * GRAVITY / float(env.race.rules.max_collective) - 1.0


def optimizer_arrays(optimizer: torch.optim.Optimizer) -> dict[str, NDArray[Any]]:
    """Return Adam's state as arrays: ``<parameter index>.<name>``."""
    state = optimizer.state_dict()["state"]
    return {f"{i}.{name}": value.numpy() for i, entry in state.items() for name, value in entry.items()}


def load_optimizer(optimizer: torch.optim.Optimizer, arrays: dict[str, NDArray[Any]]) -> None:
    """Load what `optimizer_arrays` returned."""
    state: dict[int, dict[str, torch.Tensor]] = {}
    for key, array in arrays.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = torch.from_numpy(np.array(array))
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for number, moments in state.items():
        if any(moments[name].shape != parameters[number].shape for name in ("exp_avg", "exp_avg_sq")):
            raise ValueError(f"the moments of parameter {number} have another shape")
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def capture(model: PPO, env: RaceVecEnv, average: nn.Module | None = None) -> dict[str, NDArray[Any]]:
    """Return everything that the rest of the training depends on, valid between two rollouts.

    Policy, Adam, the random numbers of torch and numpy (SB3 shuffles minibatches with numpy's global
    generator), the race with its streams and remembered passings, last observation, episode starts and
    counters; the ``average`` of policies, the steps towards more room and the rounds of polish, where there are
    such. The rollout buffer is empty then.
    """
    numpy_state = np.random.get_state(legacy=False)
    ascent, polish = (model.room_ascent, model.polish) if isinstance(model, LeanPPO) else (None, None)
    groups = {
        "policy": state_arrays(model.policy),
        "average": state_arrays(average) if average else {},
        "optimizer": optimizer_arrays(model.policy.optimizer),
        "room_optimizer": optimizer_arrays(ascent.optimizer) if ascent else {},
        "room": {"hard": ascent.hard} if ascent else {},
        "polish": polish.capture() if polish else {},
        "race": env.race.snapshot(),
        "random": {
            "torch": torch.get_rng_state().numpy(),
            "numpy": np.asarray(numpy_state["state"]["key"]),
            "numpy_position": np.array([numpy_state["state"]["pos"], numpy_state["has_gauss"]], np.int64),
            "numpy_gauss": np.array(numpy_state["gauss"], np.float64),
        },
        "loop": {
            "last_observation": np.asarray(model._last_obs),
            "last_episode_starts": np.asarray(model._last_episode_starts, np.bool_),
            "counters": np.array([model.num_timesteps, model._n_updates], np.int64),
        },
    }
    return {f"{group}/{name}": np.array(array) for group, arrays in groups.items() for name, array in arrays.items()}


def reinstate(model: PPO, env: RaceVecEnv, arrays: dict[str, NDArray[Any]], average: nn.Module | None = None) -> None:
    """Continue from what `capture` returned; `TensorFileError` when it is not the state of such a training."""
    try:
        _reinstate(model, env, arrays, average)
    except (KeyError, ValueError, TypeError, IndexError, RuntimeError) as error:
        raise TensorFileError(f"checkpoint: not the state of this training ({error})") from None


def _reinstate(model: PPO, env: RaceVecEnv, arrays: dict[str, NDArray[Any]], average: nn.Module | None) -> None:
    def group(name: str) -> dict[str, NDArray[Any]]:
        return {key.split("/", 1)[1]: array for key, array in arrays.items() if key.startswith(f"{name}/")}

    load_state(model.policy, group("policy"), "checkpoint")
    if average:
        load_state(average, group("average"), "checkpoint")
    load_optimizer(model.policy.optimizer, group("optimizer"))
    if isinstance(model, LeanPPO) and model.room_ascent:
        load_optimizer(model.room_ascent.optimizer, group("room_optimizer"))
        model.room_ascent.restore_hard(group("room")["hard"])
    if isinstance(model, LeanPPO) and model.polish:
        model.polish.restore(group("polish"))
    env.race.restore(group("race"))
    random, loop = group("random"), group("loop")
    model._last_obs = loop["last_observation"]
    model._last_episode_starts = loop["last_episode_starts"]
    model.num_timesteps, model._n_updates = (int(counter) for counter in loop["counters"])
    torch.set_rng_state(torch.from_numpy(random["torch"]))
    position, has_gauss = (int(value) for value in random["numpy_position"])
    np.random.set_state(("MT19937", random["numpy"], position, has_gauss, float(random["numpy_gauss"].item())))
