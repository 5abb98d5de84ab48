"""Synthetic flights and a small recording of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from srlrace.recording import Flight, RecordingWriter, SceneObstacle

TERMS = ("progress", "safety", "collision")
CONFIG = b'{"seed": 1}\n'
TABLE = b"episode,outcome\n0,finished\n1,crashed\n2,finished\n"
SCENE = (
    SceneObstacle("sphere", (1.0, 2.0, 3.0), radius=0.5),
    SceneObstacle("cylinder", (4.0, 5.0, 3.0), radius=0.3, height=6.0),
    SceneObstacle("box", (7.0, 8.0, 1.0), edge=2.0),
)


def synthetic_flight(episode: int, steps: int = 40, finish_time: float | None = None) -> Flight:
    """A flight of random numbers that only this episode has."""
    rng = np.random.default_rng(episode)
    quaternion = rng.normal(size=(steps, 4))
    return Flight(
        episode=episode,
        seed=100 + episode,
        map_seed=1_000_000 + episode,
        outcome="crashed" if finish_time is None else "finished",
        finish_time=finish_time,
        time=np.arange(steps) * 0.02,
        position_w=rng.normal(size=(steps, 3)),
        velocity_w=rng.normal(size=(steps, 3)),
        quaternion_wb=quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        body_rate_b=rng.normal(size=(steps, 3)),
        rotor_thrust=rng.uniform(0, 8, size=(steps, 4)),
        action=rng.normal(size=(steps, 4)),
        reward_terms=rng.normal(size=(steps, len(TERMS))),
        clearance=rng.uniform(0, 10, size=steps),
        target=np.arange(steps) // 20,
        waypoints=rng.normal(size=(5, 3)),
        scene=SCENE,
    )


def record(path: Path, flights: Sequence[Flight], table: bytes = TABLE) -> Path:
    """A finished recording of these flights."""
    metadata = {"run": "forest-srl-s1", "seed": "1"}
    with RecordingWriter(path, metadata=metadata, reward_terms=TERMS, horizon=10.0, config_json=CONFIG) as writer:
        for flight in flights:
            writer.write(flight)
        writer.finish(table)
    return path


@pytest.fixture(scope="session")
def flights() -> tuple[Flight, ...]:
    return synthetic_flight(0, finish_time=0.78), synthetic_flight(1, steps=25), synthetic_flight(2, finish_time=0.5)


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory, flights: tuple[Flight, ...]) -> Path:
    return record(tmp_path_factory.mktemp("recording") / "trajectories.mcap", flights)


@pytest.fixture
def make_recording(tmp_path: Path) -> Callable[[Sequence[Flight]], Path]:
    return lambda flights: record(tmp_path / "made.mcap", flights)


@pytest.fixture(scope="session")
def make_flight() -> Callable[..., Flight]:
    return synthetic_flight
