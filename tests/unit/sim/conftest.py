"""Quadrotors, states and commands for the tests of the physics."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from srlrace.config import QuadConfig
from srlrace.sim.airframe import Airframe
from srlrace.sim.dynamics import advance

QUADS = Path(__file__).parents[3] / "conf" / "quad"
Array = NDArray[np.float64]


def read_quad(path: Path) -> QuadConfig:
    plain = yaml.safe_load(path.read_text())
    return QuadConfig(**{key: tuple(value) if isinstance(value, list) else value for key, value in plain.items()})


@pytest.fixture(scope="session", params=sorted(path.stem for path in QUADS.glob("*.yaml")))
def any_quad(request: pytest.FixtureRequest) -> QuadConfig:
    """Every quadrotor preset in turn."""
    return read_quad(QUADS / f"{request.param}.yaml")


@pytest.fixture(scope="session")
def quad() -> QuadConfig:
    """The paper's quadrotor."""
    return read_quad(QUADS / "kingfisher.yaml")


@pytest.fixture(scope="session")
def airframe(quad: QuadConfig) -> Airframe:
    """The paper's quadrotor, as the kernel knows it."""
    return Airframe(quad)


@pytest.fixture(scope="session")
def random_states(quad: QuadConfig) -> Callable[[int, int], Array]:
    """Function (n, seed) to states (17, n) all over the flight envelope."""

    def draw(n: int, seed: int) -> Array:
        rng = np.random.default_rng(seed)
        attitude = rng.normal(size=(4, n))
        rows = (
            rng.uniform(-10, 10, (3, n)),
            rng.uniform(-10, 10, (3, n)),
            attitude / np.linalg.norm(attitude, axis=0),
            rng.uniform(-6, 6, (3, n)),
            rng.uniform(0, quad.thrust_max, (4, n)),
        )
        return np.concatenate(rows)

    return draw


@pytest.fixture(scope="session")
def random_commands(quad: QuadConfig, airframe: Airframe) -> Callable[[int, int], Array]:
    """Function (n, seed) to commands (4, n) over the whole action range."""

    def draw(n: int, seed: int) -> Array:
        highest = np.array([airframe.max_collective, *quad.body_rate_max])[:, None]
        lowest = np.array([0.0, *(-rate for rate in quad.body_rate_max)])[:, None]
        return np.random.default_rng(seed).uniform(lowest, highest, (4, n))

    return draw


@pytest.fixture(scope="session")
def fly(airframe: Airframe) -> Callable[..., Array]:
    """Function that flies states (17, n) under a held command in a float type, and returns the new states."""

    def run(
        state: Array, command: Array, *, steps: int = 1, drag: Array | None = None, gain: float = 1.0,
        body: Airframe = airframe, dtype: type = np.float64, substeps: int = 8,
    ) -> Array:  # fmt: skip
        n = state.shape[1]
        plant = np.ones((4, n), dtype)
        plant[:3] = np.reshape(body.drag_acceleration() if drag is None else drag, (3, 1))
        plant[3] = gain
        flown = np.array(state, dtype)
        held = np.ascontiguousarray(np.broadcast_to(np.reshape(command, (4, -1)), (4, n)), dtype)
        for _ in range(steps):
            advance(flown, held, plant, body.pack(dtype), 0.02, substeps)
        return flown

    return run


@pytest.fixture(scope="session")
def at_rest(airframe: Airframe) -> Callable[[float], Array]:
    """Function (rotor thrust [N]) to one level drone at rest (17, 1)."""

    def make(thrust: float) -> Array:
        state = np.zeros((17, 1))
        state[6] = 1.0
        state[13:] = thrust
        return state

    return make
