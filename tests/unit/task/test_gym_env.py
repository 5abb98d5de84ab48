"""Gymnasium: registration, its checkers, and the vector environment against single ones."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import RecordEpisodeStatistics

from srlrace.task.arrays import OUTCOMES
from srlrace.task.gym_env import DroneRaceEnv, DroneRaceVectorEnv
from srlrace.task.race import Race, RaceMode

NAMES = ("srlrace/Forest-v0", "srlrace/SplitS-v0")


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_checks_it(name):
    env = gymnasium.make(name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # an unbounded observation is meant: positions have no limit that a drone could not pass by a step
        warnings.filterwarnings("ignore", message=".*minimum value is -infinity.*")
        warnings.filterwarnings("ignore", message=".*maximum value is infinity.*")
        check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (34,)
    assert env.action_space.shape == (4,)


def test_overrides_are_those_of_train():
    env = gymnasium.make("srlrace/Forest-v0", overrides=["observation=rays", "level=1", "seed=5"])
    assert env.observation_space.shape == (56,)
    assert env.unwrapped.config.seed == 5
    assert env.unwrapped.config.level.name == "1"


def test_tracks():
    tracks = [gymnasium.make(name).unwrapped.config.env.name for name in NAMES]
    assert tracks == ["forest", "split_s"]


def test_a_seed_restarts_and_none_goes_on():
    env = gymnasium.make("srlrace/Forest-v0").unwrapped
    first, _ = env.reset(seed=3)
    second, _ = env.reset()
    assert (first != second).any()
    np.testing.assert_array_equal(env.reset(seed=3)[0], first)
    np.testing.assert_array_equal(env.reset()[0], second)
    assert (env.reset(seed=4)[0] != first).any()


def test_the_vector_environment_keeps_its_spaces_and_types():
    env = gymnasium.make_vec("srlrace/Forest-v0", num_envs=5, overrides=["level=1"])
    assert isinstance(env.unwrapped, DroneRaceVectorEnv)
    assert env.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    observation, info = env.reset(seed=1)
    assert info == {}
    assert env.observation_space.contains(observation)
    env.action_space.seed(0)
    for _ in range(60):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert (reward.shape, reward.dtype) == ((5,), np.float64)
        assert terminated.dtype == truncated.dtype == np.bool_
        assert not (terminated & truncated).any()
    again, _ = env.reset(seed=1)
    assert (again != observation).any()
    np.testing.assert_array_equal(env.reset(seed=1)[0], again)
    env.close()


def test_the_vector_environment_against_single_drones(config):
    settings = config("level=3", "env.horizon=0.6", "seed=2")
    env = DroneRaceVectorEnv(4, config=settings)
    modes = [RaceMode(8, np.array([i]), autoreset=False, curriculum=False) for i in range(4)]
    alone = [Race(settings, mode, env._race.field) for mode in modes]
    observation, _ = env.reset(seed=8)
    np.testing.assert_array_equal(observation, [race.reset()[0] for race in alone])
    seen = set()
    for action in np.random.default_rng(0).uniform(-1, 1, (120, 4, 4)).astype(np.float32):
        observation, reward, terminated, truncated, info = env.step(action)
        for i, race in enumerate(alone):
            out = race.step(action[i : i + 1])
            outcome = OUTCOMES[out.outcome[0]]
            assert reward[i] == out.reward[0]
            assert (terminated[i], truncated[i]) == (outcome not in ("flying", "timeout"), outcome == "timeout")
            if outcome != "flying":
                seen.add(outcome)
                assert info["_final_obs"][i]
                assert info["outcome"][i] == outcome
                np.testing.assert_array_equal(info["final_obs"][i], out.terminal_observation[0])
                race.reset()
            elif info:
                assert not info["_final_obs"][i]
                assert info["final_obs"][i] is None
            np.testing.assert_array_equal(observation[i], race.output.observation[0])
    assert seen >= {"timeout", "crashed"}


def test_gymnasiums_vector_wrappers_take_it():
    env = RecordEpisodeStatistics(gymnasium.make_vec("srlrace/Forest-v0", num_envs=3, overrides=["level=3"]))
    env.reset(seed=0)
    env.action_space.seed(0)
    episodes = 0
    for _ in range(150):
        info = env.step(env.action_space.sample())[4]
        if "episode" in info:
            done = info["_episode"]
            episodes += done.sum()
            assert (info["episode"]["l"][done] > 0).all()
    assert episodes == env.episode_count > 3


def test_sync_vectorization_works_too():
    env = gymnasium.make_vec("srlrace/Forest-v0", num_envs=2, vectorization_mode="sync", overrides=["level=none"])
    assert env.reset(seed=0)[0].shape == (2, 34)
    assert isinstance(env.envs[0].unwrapped, DroneRaceEnv)


@pytest.mark.parametrize(
    "words",
    [
        "import gymnasium, srlrace",
        "import srlrace.task.gym_env, gymnasium",
        "import srlrace, srlrace.task.gym_env, gymnasium",
    ],
)
def test_importing_registers(words):
    code = f"{words}; print(gymnasium.spec('srlrace/Forest-v0').id, gymnasium.spec('srlrace/SplitS-v0').id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == list(NAMES)


def test_importing_srlrace_imports_nothing_heavy():
    code = "import sys, srlrace; print([m for m in ('gymnasium', 'torch', 'numpy', 'numba') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    code = "import sys, gymnasium, srlrace; print([m for m in ('torch', 'numba', 'hydra') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
