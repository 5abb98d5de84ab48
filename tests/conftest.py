"""Shared by the tests of task, learning and evaluation: composed configs, a race, and a pilot that can fly."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from typing import Any

import guards
import hypothesis
import numpy as np
import pytest

from srlrace.config import Config
from srlrace.hydra_bridge import compose
from srlrace.task.observation import SPEED_SCALE, TARGET_SCALE
from srlrace.task.race import Race, RaceMode

# Random examples look for new failures while developing; CI repeats the same ones.
hypothesis.settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    hypothesis.settings.load_profile("ci")

GRAVITY = 9.81  # m/s^2
COLLECTIVE = 4 * 8.505 / 0.752  # m/s^2, all rotors at their limit (conf/quad/kingfisher.yaml)
RATES = np.array([6.0, 6.0, 2.0])  # rad/s, same file


@functools.cache
def composed(*overrides: str) -> Config:
    """The config of ``srlrace train OVERRIDES``; composing takes a quarter of a second, so keep them."""
    return compose(list(overrides))


def evaluation_race(config: Config, n: int, seed: int = 1) -> Race:
    """A race as evaluation has it, reset."""
    race = Race(config, RaceMode.evaluation(seed, np.arange(n)))
    race.reset()
    return race


def training_race(config: Config, n: int, seed: int = 1) -> Race:
    """A race as training has it, reset."""
    race = Race(config, RaceMode.training(seed, n))
    race.reset()
    return race


def hover_action(n: int) -> Any:
    """Actions (n, 4) that hold an upright drone where it is."""
    action = np.zeros((n, 4), np.float32)
    action[:, 0] = 2 * GRAVITY / COLLECTIVE - 1
    return action


def put(race: Race, position: Any, velocity: Any = (0, 0, 0), target: Any = None) -> None:
    """Put every drone somewhere: upright, not turning, hovering, without drag, so that it flies straight on."""
    state = race.fleet.state
    state[:] = 0
    state[6] = 1
    state[0:3] = np.broadcast_to(np.asarray(position, float), (race.n, 3)).T
    state[3:6] = np.broadcast_to(np.asarray(velocity, float), (race.n, 3)).T
    state[13:17] = race.rules.hover_thrust
    race.fleet.plant[0:3] = 0
    if target is not None:
        race.fleet.target[:] = target


def pilot_action(observation: Any) -> Any:
    """Fly towards the next waypoint, slower when close, knowing nothing of obstacles; paper or song observations."""
    song = observation.shape[1] == 18
    rotation, velocity, target = (3, 0, 12) if song else (3, 12, 18)
    body_to_world = observation[:, rotation : rotation + 9].reshape(-1, 3, 3).astype(float)
    v = observation[:, velocity : velocity + 3] * SPEED_SCALE
    to = observation[:, target : target + 3] * TARGET_SCALE
    far = np.linalg.norm(to, axis=1, keepdims=True)
    pull = 3.0 * (to / far * np.minimum(8.0, 2.0 + 1.5 * far) - v)
    pull *= np.minimum(1.0, 15.0 / np.linalg.norm(pull, axis=1, keepdims=True))
    pull[:, 2] += GRAVITY
    strength = np.linalg.norm(pull, axis=1)
    x, y, z = np.einsum("nij,ni->jn", body_to_world, pull) / strength
    rates = 10.0 * np.stack([-y, x, np.zeros_like(x)], axis=1)
    thrust = 2 * np.maximum(strength * z, 0.0) / COLLECTIVE - 1
    return np.clip(np.column_stack([thrust, rates / RATES]), -1, 1).astype(np.float32)


@pytest.fixture(scope="session", autouse=True)
def nothing_unpickled_nothing_fetched() -> Iterator[None]:
    """No test unpickles anything or reaches beyond this machine, nor does what it tests."""
    with pytest.MonkeyPatch.context() as patch:
        guards.forbid_unpickling(patch.setattr)
        guards.forbid_network(patch.setattr)
        yield


@pytest.fixture(scope="session")
def config() -> Any:
    return composed


@pytest.fixture(scope="session")
def flown() -> Any:
    return evaluation_race


@pytest.fixture(scope="session")
def trained() -> Any:
    return training_race


@pytest.fixture(scope="session")
def hover() -> Any:
    return hover_action


@pytest.fixture(scope="session")
def place_drones() -> Any:
    return put


@pytest.fixture(scope="session")
def pilot() -> Any:
    return pilot_action
