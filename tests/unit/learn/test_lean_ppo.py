"""The lean PPO is SB3's PPO: same update, same bootstrapped rollout."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from srlrace.hydra_bridge import compose
from srlrace.learn.lean_ppo import LeanPPO, correlate, log_density
from srlrace.learn.policy import act, build_policy
from srlrace.learn.ppo import build_ppo
from srlrace.task.vec_env import RaceVecEnv

SMALL = ["level=none", "algo.n_envs=16", "algo.n_steps=64", "algo.batch_size=256", "algo.n_epochs=3"]


def rolled_out(*overrides: str) -> tuple[LeanPPO, RaceVecEnv]:
    """A model in the middle of a training: a filled buffer, and Adam with a history."""
    config = compose([*SMALL, *overrides])
    env = RaceVecEnv(config)
    model = build_ppo(config, env)
    assert isinstance(model, LeanPPO)
    model.learn(2 * 16 * 64, log_interval=None)
    _, callback = model._setup_learn(10 * 16 * 64, None, reset_num_timesteps=False)
    model.collect_rollouts(env, callback, model.rollout_buffer, 64)
    model._current_progress_remaining = 0.7
    return model, env


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("algo.ent_coef=0.01", "algo.activation=tanh"),
        ("algo.clip_range=0.01", "algo.learning_rate=0.01"),  # most samples clipped
        ("algo.max_grad_norm=0.001", "algo.activation=elu"),  # every gradient clipped
        ("algo.policy_layers=[19]", "algo.value_layers=[7,130,5]"),  # no size fits a register
        ("algo.state_dependent_std=true",),
        ("algo.state_dependent_std=true", "algo.ent_coef=0.01", "algo.log_std_init=0.5"),  # the limit: half are beyond
    ],
)
def test_an_update_is_that_of_sb3(overrides: tuple[str, ...]) -> None:
    model, _ = rolled_out(*overrides)
    before = copy.deepcopy(model.policy.state_dict())
    adam, buffer = copy.deepcopy(model.policy.optimizer.state_dict()), copy.deepcopy(model.rollout_buffer)
    np.random.seed(3)
    model.train()
    lean = copy.deepcopy(model.policy.state_dict())
    logged = dict(model.logger.name_to_value)
    model.policy.load_state_dict(before)
    model.policy.optimizer.load_state_dict(adam)
    model.rollout_buffer = buffer
    np.random.seed(3)
    PPO.train(model)
    for name, value in model.policy.state_dict().items():
        step = float((value - before[name]).abs().max())
        assert step > 0.0, name
        torch.testing.assert_close(lean[name], value, rtol=1e-4, atol=1e-3 * step)
    for name in ("policy_gradient_loss", "value_loss", "entropy_loss", "clip_fraction", "explained_variance"):
        theirs = float(model.logger.name_to_value[f"train/{name}"])
        assert logged[f"train/{name}"] == pytest.approx(theirs, rel=1e-3, abs=1e-4), name


class Replay(VecEnv):
    """Gives two learners the same transitions, whatever they do."""

    def __init__(self, env: RaceVecEnv, steps: int) -> None:
        super().__init__(env.num_envs, env.observation_space, env.action_space)
        actions = np.random.default_rng(0).uniform(-0.3, 0.3, (steps, env.num_envs, 4)).astype(np.float32)
        self.first = env.reset()
        self.transitions = [env.step(action) for action in actions]
        self.at = 0

    def reset(self):  # type: ignore[no-untyped-def]
        self.at = 0
        return self.first

    def step_async(self, actions: np.ndarray) -> None:
        self.at += 1

    def step_wait(self):  # type: ignore[no-untyped-def]
        observation, reward, done, infos = self.transitions[self.at - 1]
        return observation, reward.copy(), done, infos

    def close(self) -> None: ...
    def get_attr(self, attr_name, indices=None):  # type: ignore[no-untyped-def]
        return [None] * self.num_envs

    def set_attr(self, attr_name, value, indices=None): ...  # type: ignore[no-untyped-def]
    def env_method(self, method_name, *args, indices=None, **kwargs): ...  # type: ignore[no-untyped-def]
    def env_is_wrapped(self, wrapper_class, indices=None): ...  # type: ignore[no-untyped-def]


def test_a_rollout_is_that_of_sb3_with_truncated_episodes_bootstrapped() -> None:
    # A horizon of ten steps truncates every episode; weights of the policy decide nothing here.
    config = compose([*SMALL, "env.horizon=0.2", "randomization=none"])
    env = RaceVecEnv(config)
    model = build_ppo(config, env)
    replay = Replay(env, 64)
    assert sum(info.get("TimeLimit.truncated", False) for *_, infos in replay.transitions for info in infos) > 50
    model.set_env(replay)  # type: ignore[arg-type]
    filled = []
    for collect in (LeanPPO.collect_rollouts, PPO.collect_rollouts):
        _, callback = model._setup_learn(64 * 16, None, reset_num_timesteps=True)
        model._last_obs = replay.reset()
        collect(model, replay, callback, model.rollout_buffer, 64)  # type: ignore[arg-type]
        filled.append(copy.deepcopy(model.rollout_buffer))
    lean, theirs = filled
    for name in ("observations", "rewards", "values", "episode_starts", "returns", "advantages"):
        np.testing.assert_allclose(getattr(lean, name), getattr(theirs, name), rtol=1e-5, atol=1e-5, err_msg=name)
    raw = np.stack([reward for _, reward, _, _ in replay.transitions])
    assert (np.abs(lean.rewards - raw) > 1e-6).any()


@pytest.mark.parametrize("by_state", ["false", "true"])
def test_the_log_density_is_that_of_the_gaussian(by_state: str) -> None:
    model, _ = rolled_out(f"algo.state_dependent_std={by_state}")
    buffer = model.rollout_buffer
    observation = torch.from_numpy(buffer.observations.reshape(-1, buffer.obs_shape[0]))
    action = torch.from_numpy(buffer.actions.reshape(-1, 4))
    with torch.no_grad():
        _, log_prob, _ = model.policy.evaluate_actions(observation, action)
    np.testing.assert_allclose(buffer.log_probs.flatten(), log_prob.numpy(), rtol=1e-4, atol=1e-4)


def test_correlated_noise_is_standard_normal_and_remembers_as_much_as_asked() -> None:
    white = np.random.default_rng(0).standard_normal((400, 200, 4)).astype(np.float32)
    noise = correlate(white.copy(), 0.6)
    for lag, expected in ((0, 1.0), (1, 0.6), (2, 0.36), (10, 0.6**10)):
        covariance = np.mean(noise[lag:] * noise[: len(noise) - lag])
        np.testing.assert_allclose(covariance, expected, atol=0.01)
    np.testing.assert_allclose(noise[0].std(), 1.0, atol=0.05)
    np.testing.assert_array_equal(correlate(white.copy(), 0.0), white)


@pytest.mark.parametrize("by_state", [False, True])
def test_a_rollout_explores_with_the_configured_correlation_and_knows_its_densities(by_state: bool) -> None:
    model, _ = rolled_out("algo.noise_correlation=0.8", f"algo.state_dependent_std={str(by_state).lower()}")
    buffer = model.rollout_buffer
    with torch.no_grad():
        observations = torch.from_numpy(buffer.observations.reshape(-1, buffer.obs_shape[0]))
        gaussian = model.policy.get_distribution(observations).distribution
    mean, std = (array.numpy().reshape(buffer.actions.shape) for array in (gaussian.mean, gaussian.stddev))
    noise = (buffer.actions - mean) / std
    np.testing.assert_allclose(np.mean(noise[1:] * noise[:-1]), 0.8, atol=0.1)
    np.testing.assert_allclose(buffer.log_probs, log_density(noise, np.log(std)), rtol=1e-3, atol=1e-3)
    assert (np.ptp(std, axis=(0, 1)) > 1e-3).all() == by_state
    assert model._std == pytest.approx(float(std.mean()), rel=1e-4)


def test_a_standard_deviation_by_state_starts_as_that_of_all_states() -> None:
    config = compose([*SMALL, "algo.state_dependent_std=true", "algo.log_std_init=-0.7"])
    policy = build_policy(config)
    observations = torch.randn(20, *policy.observation_space.shape or ())
    with torch.no_grad():
        gaussian = policy.get_distribution(observations).distribution
    torch.testing.assert_close(gaussian.stddev, torch.full((20, 4), math.exp(-0.7)))
    np.testing.assert_allclose(act(policy, observations.numpy()), gaussian.mean.numpy(), rtol=1e-4, atol=1e-6)
