"""A training on fresh maps that is stopped continues as if it never had been."""

from __future__ import annotations

import dataclasses

import pytest

from srlrace.config import run_id
from srlrace.learn import train as training
from srlrace.learn.train import Training, train
from srlrace.runs import RunFolder, State


@pytest.fixture(scope="module")
def fresh(config):
    """Twelve rollouts of 512 steps, a map of three replaced every 300 steps; flights of a second at most."""
    return config(
        "level=endless", "level.maps=3", "level.fresh_steps=300", "env.horizon=1",
        "algo.n_envs=16", "algo.n_steps=32", "algo.batch_size=128", "algo.n_epochs=2", "algo.total_steps=6144",
        "algo.policy_layers=[16,16]", "algo.value_layers=[16,16]",
        "curriculum.gate_starts=0.3", "curriculum.memory_starts=0.3", "curriculum.memory_size=4",
    )  # fmt: skip


def policy(folder) -> bytes:
    return (folder / "policy.safetensors").read_bytes()


def test_it_resumes_to_the_byte(fresh, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)
    undisturbed = train(fresh, tmp_path / "undisturbed")
    report, count = Training._report, iter(range(10**6))

    def failing(self, final):
        report(self, final)
        if next(count) in (3, 5):
            raise RuntimeError("lightning")

    monkeypatch.setattr(Training, "_report", failing)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="lightning"):
            train(fresh, tmp_path / "stopped")
    folder = train(fresh, tmp_path / "stopped")
    assert RunFolder(folder).state is State.FINISHED
    assert policy(folder) == policy(undisturbed)


def test_fresh_maps_make_another_run(fresh, tmp_path):
    lasting = dataclasses.replace(fresh, level=dataclasses.replace(fresh.level, fresh_steps=0))
    assert run_id(lasting) != run_id(fresh)
    assert policy(train(lasting, tmp_path)) != policy(train(fresh, tmp_path))
