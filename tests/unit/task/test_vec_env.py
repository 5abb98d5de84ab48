"""The `VecEnv` against drones flown one at a time, SB3's checks, and the bootstrapping of time limits."""

import dataclasses

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env

from srlrace.learn.ppo import build_ppo
from srlrace.task.arrays import FLYING, OUTCOMES, TIMEOUT
from srlrace.task.gym_env import DroneRaceEnv
from srlrace.task.race import Race, RaceMode
from srlrace.task.vec_env import RaceVecEnv

N = 7


@pytest.fixture(scope="module")
def settings(config):
    """Short episodes among trees: crashes, ends of the world and timeouts all happen."""
    plain = config(
        "level=3", "curriculum=none", "algo.n_envs=7", "algo.batch_size=50", "algo.reward_scale=0.25", "seed=4"
    )
    return dataclasses.replace(plain, env=dataclasses.replace(plain.env, horizon=0.6))


def actions(steps, n):
    return np.random.default_rng(5).uniform(-1, 1, (steps, n, 4)).astype(np.float32)


def test_every_drone_against_itself_flown_alone(settings):
    env = RaceVecEnv(settings)
    modes = [RaceMode(settings.seed, np.array([i]), autoreset=False, curriculum=False) for i in range(N)]
    alone = [Race(settings, mode, env.race.field) for mode in modes]
    observation = env.reset()
    for i, race in enumerate(alone):
        np.testing.assert_array_equal(race.reset()[0], observation[i])
    seen, returns, lengths = set(), np.zeros(N), np.zeros(N, int)
    for action in actions(150, N):
        observation, reward, done, infos = env.step(action)
        for i, race in enumerate(alone):
            out = race.step(action[i : i + 1])
            outcome = int(out.outcome[0])
            assert reward[i] == out.reward[0] * np.float32(0.25)
            assert done[i] == (outcome != FLYING)
            returns[i], lengths[i] = returns[i] + out.reward[0], lengths[i] + 1
            if outcome == FLYING:
                np.testing.assert_array_equal(observation[i], out.observation[0])
                assert infos[i] == {}
                continue
            info = infos[i]
            seen.add(outcome)
            np.testing.assert_array_equal(info["terminal_observation"], out.terminal_observation[0])
            assert info["TimeLimit.truncated"] == (outcome == TIMEOUT)
            assert info["outcome"] == OUTCOMES[outcome]
            assert info["is_success"] is False
            assert info["episode"]["l"] == lengths[i]
            assert info["episode"]["r"] == pytest.approx(returns[i], rel=1e-4, abs=1e-4)
            np.testing.assert_array_equal(race.reset()[0], observation[i])  # the next episode has begun
            returns[i], lengths[i] = 0, 0
    assert {OUTCOMES[k] for k in seen} >= {"timeout", "crashed"}


def test_the_first_drone_is_the_single_environment(settings):
    vector, single = RaceVecEnv(settings), DroneRaceEnv(config=settings)
    observation = vector.reset()
    np.testing.assert_array_equal(single.reset()[0], observation[0])
    for action in actions(80, N):
        observation, reward, done, infos = vector.step(action)
        alone, alone_reward, terminated, truncated, info = single.step(action[0])
        assert reward[0] == np.float32(alone_reward) * np.float32(0.25)
        assert sum(info["reward_terms"].values()) == pytest.approx(alone_reward, abs=1e-5)
        assert done[0] == (terminated or truncated)
        if done[0]:
            assert infos[0]["TimeLimit.truncated"] == truncated
            assert infos[0]["outcome"] == info["outcome"]
            np.testing.assert_array_equal(infos[0]["terminal_observation"], alone)
            alone = single.reset()[0]
        np.testing.assert_array_equal(observation[0], alone)


def test_a_finish_is_a_success(config, place_drones, hover):
    env = RaceVecEnv(config("level=none", "curriculum=none"), 1)
    env.reset()
    place_drones(env.race, np.array([20.0, 0.0, 1.12]) - [0.8, 0, 0], (20, 0, 0), target=8)
    assert not env.step(hover(1))[2][0]
    _, _, done, [info] = env.step(hover(1))
    assert done[0]
    assert (info["is_success"], info["outcome"], info["TimeLimit.truncated"]) == (True, "finished", False)
    assert info["episode"]["l"] == 2
    assert info["episode"]["t"] == pytest.approx(0.5 / 20, abs=1e-5)


def test_what_a_step_returned_is_not_overwritten(settings):
    env = RaceVecEnv(settings)
    first = env.reset()
    kept = first.copy()
    second = env.step(actions(1, N)[0])
    copies = [np.copy(part) for part in second[:3]]
    env.step(actions(2, N)[1])
    np.testing.assert_array_equal(first, kept)
    for part, copy in zip(second[:3], copies, strict=True):
        np.testing.assert_array_equal(part, copy)


def test_sb3_checks_the_single_environment():
    check_env(DroneRaceEnv("forest", ["level=1"]), warn=True)


def test_time_limits_are_bootstrapped_and_crashes_are_not(config, hover):
    """With a value function that says 3.5 everywhere, a timeout's reward is higher by gamma times that."""
    plain = config(
        "level=none", "randomization=none", "curriculum=none", "algo.n_envs=4", "algo.n_steps=8", "algo.batch_size=32"
    )
    short = dataclasses.replace(plain.env, horizon=0.1)
    settings = dataclasses.replace(plain, env=short)
    env = RaceVecEnv(settings)
    model = build_ppo(settings, env)
    value = 3.5
    with torch.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.fill_(value)
    rewards, dones, limits = [], [], []
    inner = env.step_wait

    def step_wait():
        if len(rewards) == 1:
            env.race.fleet.state[3, 2] = np.nan  # drone 2 crashes
        result = inner()
        rewards.append(result[1].copy())
        dones.append(result[2].copy())
        limits.append(np.array([info.get("TimeLimit.truncated", False) for info in result[3]]))
        return result

    env.step_wait = step_wait
    model._setup_learn(32, callback=BaseCallbackStub())
    model.collect_rollouts(env, BaseCallbackStub(model), model.rollout_buffer, 8)
    rewards, dones, limits = np.array(rewards), np.array(dones), np.array(limits)
    assert limits.sum() == 4
    assert (dones & ~limits).sum() == 1
    expected = rewards + settings.algo.gamma * value * limits
    np.testing.assert_allclose(model.rollout_buffer.rewards, expected, rtol=1e-6)


class BaseCallbackStub(BaseCallback):
    def __init__(self, model=None):
        super().__init__()
        if model is not None:
            self.init_callback(model)

    def _on_step(self) -> bool:
        return True


def test_it_is_configured_by_its_config_alone(settings):
    env = RaceVecEnv(settings)
    assert env.seed(settings.seed) == [settings.seed] * N
    with pytest.raises(ValueError, match=f"seeded with {settings.seed} by its Config, not 77"):
        env.seed(77)
    with pytest.raises(AttributeError, match="configured by its Config"):
        env.set_attr("race", None)
    assert env.get_attr("num_envs", [0, 1]) == [N, N]
    assert env.env_is_wrapped(gymnasium.Wrapper) == [False] * N
    ledger = env.env_method("take_ledger", indices=0)
    assert len(ledger) == 1
    assert "episodes" in ledger[0]
    env.close()
