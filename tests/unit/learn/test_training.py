"""Training a run: what it leaves behind, how it stops, and that it continues as if it never had."""

import csv
import ctypes
import dataclasses
import json
import logging
import signal
import sys

import numpy as np
import pytest
import torch

from srlrace.config import load_config, run_id
from srlrace.learn import train as training
from srlrace.learn.checkpoint import load_checkpoint
from srlrace.learn.interrupt import Interrupted, stop_request
from srlrace.learn.policy import load_policy, state_arrays
from srlrace.learn.progress import COLUMNS, ProgressFile, figures_text, outcome_ratios
from srlrace.learn.train import Diverged, Training, train
from srlrace.runs import RunError, RunFolder, State
from srlrace.task.arrays import LEDGER
from srlrace.task.reward import TERMS

ROLLOUT, TOTAL = 512, 6144  # steps, of the tiny config
TIMED = ("wall_s", "steps_per_s")


@pytest.fixture(autouse=True)
def save_always(monkeypatch):
    """A checkpoint at every boundary; when they are written must not matter."""
    monkeypatch.setattr(training, "SAVE_EVERY", 0.0)


def progress(folder) -> list[dict[str, str]]:
    with (folder / "progress.csv").open() as stream:
        return list(csv.DictReader(stream))


@pytest.fixture(scope="module")
def reference(tiny, tmp_path_factory):
    """A run that nothing disturbed, with checkpoints as seldom as by default."""
    return train(tiny, tmp_path_factory.mktemp("reference"), ["srlrace", "train"])


def same_result(folder, reference) -> bool:
    rows, expected = progress(folder), progress(reference)
    for row in (*rows, *expected):
        for column in TIMED:
            row.pop(column)
    assert rows == expected
    return (folder / "policy.safetensors").read_bytes() == (reference / "policy.safetensors").read_bytes()


def test_what_a_run_leaves_behind(tiny, reference):
    assert reference.name == run_id(tiny)
    assert RunFolder(reference).state is State.FINISHED
    assert load_config(reference / "config.json") == tiny
    facts = json.loads((reference / "run.json").read_text())
    assert facts["steps"] == TOTAL
    assert facts["argv"] == ["srlrace", "train"]
    assert len(facts["attempts"]) == 1
    assert load_checkpoint(reference / "checkpoint").steps == TOTAL
    assert list(reference.glob("events.*"))
    assert not (reference / "error.txt").exists()


def test_progress_has_every_term_by_name(tiny, reference):
    rows = progress(reference)
    assert tuple(rows[0]) == COLUMNS
    assert [int(row["steps"]) for row in rows] == list(range(ROLLOUT, TOTAL + 1, ROLLOUT))
    assert {f"reward/{term}" for term in TERMS} <= set(rows[0])
    for row in rows:
        assert sum(float(row[f"reward/{term}"]) for term in TERMS) == pytest.approx(float(row["reward"]), abs=1e-4)
        assert float(row["reward/time"]) <= 0
    assert float(rows[-1]["collision_weight"]) == pytest.approx(tiny.reward.collision)
    rates = [float(row["learning_rate"]) for row in rows]
    assert rates == sorted(rates, reverse=True)
    assert rates[-1] < rates[0]
    assert sum(int(row["episodes"]) for row in rows) > 20


def test_other_seeds_are_other_runs(config, tiny, reference, tmp_path):
    other = train(dataclasses.replace(tiny, seed=1), tmp_path)
    assert (other / "policy.safetensors").read_bytes() != (reference / "policy.safetensors").read_bytes()


def on_report(monkeypatch, number, action):
    """Do something at the n-th report of an attempt."""
    report, count = Training._report, iter(range(10**6))

    def patched(self, final):
        report(self, final)
        if next(count) == number:
            action(self)

    monkeypatch.setattr(Training, "_report", patched)


def test_a_finished_run_is_skipped(tiny, reference, monkeypatch, caplog):
    before = {path: path.stat().st_mtime_ns for path in reference.rglob("*") if path.name != "lock"}
    monkeypatch.setattr(Training, "__init__", lambda *_: pytest.fail("trained again"))
    with caplog.at_level(logging.INFO):
        assert train(tiny, reference.parent) == reference
    assert "finished; skipped" in caplog.text
    assert before == {path: path.stat().st_mtime_ns for path in reference.rglob("*") if path.name != "lock"}


def test_whoever_comes_second_is_told(tiny, tmp_path):
    run = RunFolder(tmp_path / run_id(tiny))
    with run.lock(), pytest.raises(RunError, match=rf"{run.id} is held by process \d+ on"):
        train(tiny, tmp_path)
    assert not (run.path / "error.txt").exists()


def test_an_error_in_the_middle_costs_nothing(tiny, reference, tmp_path, monkeypatch):
    def fail(_):
        raise RuntimeError("lightning")

    with monkeypatch.context() as patch:
        on_report(patch, 6, fail)
        with pytest.raises(RuntimeError, match="lightning"):
            train(tiny, tmp_path)
    run = RunFolder(tmp_path / run_id(tiny))
    assert run.state is State.FAILED
    assert "lightning" in (run.path / "error.txt").read_text()
    assert load_checkpoint(run.path / "checkpoint").steps == 6 * ROLLOUT
    assert len(progress(run.path)) in (6, 7)  # the row after the checkpoint will be cut off
    train(tiny, tmp_path)
    assert same_result(run.path, reference)
    assert not (run.path / "error.txt").exists()


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_and_says_how_to_go_on(tiny, reference, tmp_path, monkeypatch, signum):
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    monkeypatch.setattr(training, "SAVE_EVERY", 1e9)  # the signal alone makes it save
    with monkeypatch.context() as patch:
        on_report(patch, 4, lambda _: signal.raise_signal(signum))
        with pytest.raises(Interrupted, match=f"{signum.name}; resume with: srlrace resume {run_id(tiny)}") as stop:
            train(tiny, tmp_path)
    assert stop.value.signum == signum
    run = RunFolder(tmp_path / run_id(tiny))
    assert run.state is State.INTERRUPTED
    assert load_checkpoint(run.path / "checkpoint").steps == 5 * ROLLOUT
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == handlers
    train(tiny, tmp_path)
    assert same_result(run.path, reference)


def wrapped() -> None:
    """A signal within compiled code, as CPython reports what its handler raised."""
    try:
        signal.raise_signal(signal.SIGTERM)
    except Interrupted as stop:
        raise SystemError("<a dispatcher> returned a result with an exception set") from stop


def lost() -> None:
    """A signal within a callback: what its handler raised is printed and goes no further."""
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGTERM))()


def lost_and_missed() -> None:
    """The same in a library that then misses what the callback had to do, as compilers have it."""
    lost()
    raise RuntimeError("no compiled object yet")


def stop_within(monkeypatch, owner, name, number, stop):
    """Something at the n-th call of something."""
    inner, count = getattr(owner, name), iter(range(10**6))

    def patched(*values, **options):
        if next(count) == number:
            stop()
        return inner(*values, **options)

    monkeypatch.setattr(owner, name, patched)


@pytest.mark.parametrize("stop", [wrapped, lost, lost_and_missed])
@pytest.mark.parametrize(("name", "number", "kept"), [
    ("check_rollout", 4, 4 * ROLLOUT), ("RaceVecEnv", 0, None), ("build_ppo", 0, None),
])  # fmt: skip
def test_a_signal_is_one_wherever_it_comes(tiny, reference, tmp_path, monkeypatch, stop, name, number, kept):
    """Even where the exception that its handler raises becomes another one, or none."""
    monkeypatch.setattr(training, "SAVE_EVERY", 1e9)
    told = []
    with monkeypatch.context() as patch:
        patch.setattr(sys, "unraisablehook", told.append)
        stop_within(patch, training, name, number, stop)
        with pytest.raises(Interrupted, match="SIGTERM; resume with"):
            train(tiny, tmp_path)
        assert told == []
    run = RunFolder(tmp_path / run_id(tiny))
    assert run.state is State.INTERRUPTED  # not failed: nothing left an error.txt
    found = load_checkpoint(run.path / "checkpoint")
    assert (found.steps if found else None) == kept
    train(tiny, tmp_path)
    assert same_result(run.path, reference)


def test_a_stop_leaves_gradients_as_they_were(tiny, tmp_path, monkeypatch):
    """Even where it comes within `torch.no_grad`'s own way out."""

    def halfway():
        torch.set_grad_enabled(False)
        signal.raise_signal(signal.SIGTERM)

    stop_within(monkeypatch, training, "RaceVecEnv", 0, halfway)
    with pytest.raises(Interrupted):
        train(tiny, tmp_path)
    assert torch.is_grad_enabled()


def test_a_signal_that_got_lost_is_not_for_long():
    """The next call of a Python function is the last, were there a million of a compilation left."""
    calls = []

    def work():
        lost()
        for _ in range(10**6):
            step()

    def step():
        calls.append(1)

    with stop_request("x"), pytest.raises(Interrupted):
        work()
    assert calls == []
    assert sys.getprofile() is None


def test_a_save_that_fails_after_a_signal_is_a_failure(tiny, tmp_path, monkeypatch):
    """Though the signal was what it came of: nothing was saved, and no one may say so."""
    monkeypatch.setattr(training, "SAVE_EVERY", 1e9)
    stop_within(monkeypatch, training, "check_rollout", 4, wrapped)
    monkeypatch.setattr(training, "save_checkpoint", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match="No space left"):
        train(tiny, tmp_path)


def test_stopped_at_every_single_rollout(tiny, reference, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        on_report(patch, 0, lambda _: None)
        report = Training._report

        def stopping(self, final):
            report(self, final)
            signal.raise_signal(signal.SIGTERM)

        patch.setattr(Training, "_report", stopping)
        for _ in range(TOTAL // ROLLOUT - 1):
            with pytest.raises(Interrupted):
                train(tiny, tmp_path)
        folder = train(tiny, tmp_path)  # the last rollout ends the training: nothing is left to stop
    assert same_result(folder, reference)
    assert len(json.loads((folder / "run.json").read_text())["attempts"]) == TOTAL // ROLLOUT


def test_a_damaged_checkpoint_costs_one_interval(tiny, reference, tmp_path, monkeypatch, caplog):
    with monkeypatch.context() as patch:
        on_report(patch, 4, lambda _: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(Interrupted):
            train(tiny, tmp_path)
    folder = tmp_path / run_id(tiny)
    newest = sorted((folder / "checkpoint").glob("*.safetensors"))[-1]
    newest.write_bytes(newest.read_bytes()[:-1] + b"\xff")
    train(tiny, tmp_path)
    assert "checksum does not match" in caplog.text
    assert same_result(folder, reference)


def test_a_run_stopped_between_its_end_and_its_policy(tiny, reference, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(training, "save_policy", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(OSError, match="No space"):
            train(tiny, tmp_path)
    folder = tmp_path / run_id(tiny)
    assert RunFolder(folder).state is State.FAILED
    train(tiny, tmp_path)
    assert same_result(folder, reference)


def broken_model(monkeypatch, rollout, damage):
    """Damage the model after its update on the n-th rollout."""
    build = training.build_ppo

    def patched(config, env):
        model = build(config, env)
        update, count = model.train, iter(range(1, 10**6))

        def train_and_break():
            update()
            if next(count) == rollout:
                damage(model)

        model.train = train_and_break
        return model

    monkeypatch.setattr(training, "build_ppo", patched)


def test_weights_that_are_no_numbers_stop_the_training(tiny, reference, tmp_path, monkeypatch):
    def damage(model):
        with torch.no_grad():
            next(model.policy.action_net.parameters())[0, 0] = np.nan

    with monkeypatch.context() as patch:
        broken_model(patch, 4, damage)
        with pytest.raises(Diverged, match="loss or weights are not finite after the update at step 2048"):
            train(tiny, tmp_path)
    folder = tmp_path / run_id(tiny)
    kept = load_checkpoint(folder / "checkpoint")
    assert kept.steps == 3 * ROLLOUT
    assert all(np.isfinite(a).all() for name, a in kept.arrays.items() if name.startswith(("policy", "optimizer")))
    assert not (folder / "policy.safetensors").exists()
    assert "Diverged" in (folder / "error.txt").read_text()
    train(tiny, tmp_path)  # it was no fault of the training's own: continued, it ends as it should
    assert same_result(folder, reference)


@pytest.mark.parametrize(("part", "index"), [("observation", 0), ("reward", 1)])
def test_what_the_environment_gives_must_be_finite(tiny, tmp_path, monkeypatch, part, index):
    build = training.build_ppo

    def patched(config, env):
        inner, count = env.step_wait, iter(range(10**6))

        def step_wait():
            result = inner()
            if next(count) == 70:
                result[index].flat[5] = np.nan
            return result

        env.step_wait = step_wait
        return build(config, env)

    monkeypatch.setattr(training, "build_ppo", patched)
    with pytest.raises(Diverged, match=f"{part} is not finite in the rollout that ended at step {3 * ROLLOUT}"):
        train(tiny, tmp_path)
    assert load_checkpoint(tmp_path / run_id(tiny) / "checkpoint").steps == 2 * ROLLOUT


def test_ratios_of_a_ledger():
    ledger = dict.fromkeys([*LEDGER, *(f"reward/{term}" for term in TERMS)], 0.0)
    empty = outcome_ratios(ledger, 100)
    assert empty["success_ratio"] is None
    assert empty["time_s"] is None
    ledger |= {
        "episodes": 20.0,
        "finished": 10.0,
        "crashed": 4.0,
        "out_of_bounds": 3.0,
        "diverged": 1.0,
        "timeout": 2.0,
    }
    ledger |= {"finish_time": 73.0, "gates_passed": 120.0, "reward/progress": 50.0, "reward/time": -2.0}
    ratios = outcome_ratios(ledger, 100)
    expected = {
        "success_ratio": 0.5, "crash_ratio": 0.4, "obstacle_ratio": 0.2, "out_of_bounds_ratio": 0.15,
        "timeout_ratio": 0.1, "time_s": 7.3, "gates_passed": 6.0, "reward/progress": 0.5,
        "reward/time": -0.02, "reward": 0.48,
    }  # fmt: skip
    assert {name: ratios[name] for name in expected} == pytest.approx(expected)
    assert "50 %" in figures_text({**ratios, "steps_per_s": 70e3})
    assert "-" in figures_text({**empty, "steps_per_s": 70e3})


def test_progress_is_cut_back_to_the_checkpoint(tmp_path):
    path = tmp_path / "progress.csv"
    file = ProgressFile(path, 0)
    file.append({"steps": 1})
    length = file.sync()
    file.append({"steps": 2})
    file.close()
    file = ProgressFile(path, length)
    file.append({"steps": 3, "time_s": None, "reward": -0.123456789})
    file.close()
    rows = path.read_text().splitlines()
    assert [row.split(",")[0] for row in rows] == ["steps", "1", "3"]
    assert "-0.123457" in rows[2]
    ProgressFile(path, 10**9).close()
    assert path.read_text().splitlines() == rows


@pytest.fixture(scope="module")
def averaging(tiny):
    """A configuration whose policy is the mean of those of the last third: four of twelve."""
    return dataclasses.replace(tiny, algo=dataclasses.replace(tiny.algo, averaged=1 / 3))


def test_the_last_policies_are_averaged(averaging, reference, tmp_path, monkeypatch):
    flown = []
    report = Training._report

    def patched(self, final):
        flown.append({name: array.copy() for name, array in state_arrays(self.model.policy).items()})
        report(self, final)

    monkeypatch.setattr(Training, "_report", patched)
    run = train(averaging, tmp_path)
    assert len(flown) == TOTAL // ROLLOUT
    last = state_arrays(load_policy(averaging, reference / "policy.safetensors"))
    for name, mean in state_arrays(load_policy(averaging, run / "policy.safetensors")).items():
        np.testing.assert_allclose(mean, np.mean([arrays[name] for arrays in flown[-4:]], axis=0), atol=1e-6)
        np.testing.assert_array_equal(flown[-1][name], last[name])  # the training itself is the same
    assert (run / "snapshots" / f"{TOTAL}.safetensors").read_bytes() == (run / "policy.safetensors").read_bytes()
    first = run / "snapshots" / f"{ROLLOUT}.safetensors"
    assert first.read_bytes() == (reference / "snapshots" / first.name).read_bytes()


@pytest.mark.parametrize("number", [5, 9], ids=["before the average begins", "within it"])
def test_an_average_is_resumed_exactly(averaging, tmp_path, monkeypatch, number):
    undisturbed = train(averaging, tmp_path / "undisturbed")
    with monkeypatch.context() as patch:
        on_report(patch, number, lambda _: signal.raise_signal(signal.SIGTERM))
        with pytest.raises(Interrupted):
            train(averaging, tmp_path)
    assert same_result(train(averaging, tmp_path), undisturbed)
