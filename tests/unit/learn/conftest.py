"""Trainings small enough for a test: seconds, not minutes, with everything that a real one has."""

from __future__ import annotations

from typing import Any

import pytest

TINY = (
    "level=none", "algo.n_envs=16", "algo.n_steps=32", "algo.batch_size=128", "algo.n_epochs=2",
    "algo.policy_layers=[16,16]", "algo.value_layers=[16,16]", "algo.total_steps=6144",
    "curriculum.gate_starts=0.3", "curriculum.memory_starts=0.3", "curriculum.memory_size=4",
)  # fmt: skip


@pytest.fixture(scope="session")
def tiny(config: Any) -> Any:
    """Twelve rollouts of 512 steps."""
    return config(*TINY)
