"""The throughput table: what it measures exists and is written; how fast it is is no test's business."""

import json

import pytest

from srlrace import bench
from srlrace.world.levels import generate_map


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(bench, "ROUNDS", 1)
    monkeypatch.setattr(bench, "ROUND_SECONDS", 0.001)


@pytest.mark.usefixtures("short")
def test_rows(config):
    settings = config("level=1")
    rows = [bench.bench_race(settings, "race step", 4), bench.bench_vec_env(settings)]
    assert [row.drones for row in rows] == [4, 100]
    assert all(row.best >= row.median > 0 for row in rows)
    trees = len(generate_map(settings.env, settings.level, 0))
    assert rows[0].work == f"nearest 10 of {trees} obstacles"


@pytest.mark.usefixtures("short")
def test_training_is_timed_beside_stock_sb3(config):
    words = ("level=none", "algo.n_envs=4", "algo.n_steps=8", "algo.batch_size=16", "algo.policy_layers=[8]")
    lean, stock = bench.bench_training(config(*words))
    assert (lean.what, stock.what) == ("training", "training, stock SB3")
    assert lean.work.startswith(stock.work)
    assert lean.work.endswith("times stock SB3")
    assert float(lean.work.split()[-4]) == pytest.approx(lean.median / stock.median, abs=0.01)


def test_a_rate_is_steps_times_drones_by_seconds(monkeypatch):
    clock = iter([0.0, 0.0, 1.0, 1.0, 2.0, 2.0])
    monkeypatch.setattr(bench, "ROUNDS", 1)
    monkeypatch.setattr(bench, "ROUND_SECONDS", 2.0)
    monkeypatch.setattr(bench.time, "perf_counter", lambda: next(clock, 2.0))
    calls = []
    best, median = bench.rates(calls.append, 10)
    timed = len(calls) - bench.ACTIONS
    assert best == median == timed * 10 / 2.0


def test_the_table_is_written(tmp_path, monkeypatch, capsys):
    row = bench.Row("race step", "nearest 10", "float32", 100, 1, 2.5e6, 2.25e6)
    monkeypatch.setattr(bench, "measure", lambda: [row])
    monkeypatch.setenv("COLUMNS", "200")
    bench.run(tmp_path / "bench.json")
    written = json.loads((tmp_path / "bench.json").read_text())
    assert written["rows"][0]["best"] == 2.5e6
    assert "cpu" in written["machine"]
    assert "2,500" in capsys.readouterr().out
