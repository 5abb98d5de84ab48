"""Evaluation: frozen initial conditions, the same bytes again, tables that agree with the recording."""

import dataclasses
import itertools
import json

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import binomtest

from srlrace.config import run_id, to_dict
from srlrace.evaluation import evaluate_run, flights, suites
from srlrace.evaluation.suites import make_suite
from srlrace.files import FileError
from srlrace.learn.policy import build_policy, save_policy
from srlrace.recording import read_episodes, read_flight, read_metadata, read_states
from srlrace.runs import RunError, RunFolder
from srlrace.schema import EVALUATION_SEED, VALIDATION_SEED
from srlrace.task.certificate import certify
from srlrace.task.reward import TERMS

COLUMNS = (
    "episode,seed,map,outcome,time_s,lap_time_s,last_gate_time_s,gates_passed,min_clearance_m,mean_speed_mps,"
    "peak_speed_mps,path_length_m,peak_body_rate_radps"
)
OUTCOMES = {"finished", "crashed", "out_of_bounds", "timeout", "diverged"}
N = 40


def make_run(root, config) -> RunFolder:
    """A run with an untrained policy."""
    folder = root / run_id(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    torch.manual_seed(config.seed)
    save_policy(build_policy(config), folder / "policy.safetensors")
    return RunFolder(folder)


@pytest.fixture
def piloted(monkeypatch, pilot):
    """Flown by the pilot instead of the policy, so that some flights finish."""
    monkeypatch.setattr(flights, "act", lambda policy, observation: pilot(observation))


def table(run, suite="train_map") -> pd.DataFrame:
    return pd.read_csv(run.path / "eval" / suite / "episodes.csv")


def recording(run, suite="train_map"):
    return run.path / "eval" / suite / "trajectories.mcap"


@pytest.fixture(scope="module")
def flown_forest(config, tmp_path_factory, pilot):
    """A Forest of few trees: of forty flights of the pilot, some finish and some crash."""
    settings = config("level=1", "level.tree_radius=0.1", "level.clear_radius=1.5")
    run = make_run(tmp_path_factory.mktemp("forest"), settings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(flights, "act", lambda policy, observation: pilot(observation))
        summary = evaluate_run(run, N)
    return run, summary


def test_nothing_is_written_through_a_link_out_of_the_folder(tmp_path, config):
    run = make_run(tmp_path / "runs", config("level=none", "env.horizon=0.1"))
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (run.path / "eval").symlink_to(elsewhere)
    with pytest.raises(RunError, match="link"):
        evaluate_run(run, 3)
    assert list(elsewhere.iterdir()) == []


def test_episodes_table(flown_forest):
    run, _ = flown_forest
    assert (run.path / "eval/train_map/episodes.csv").read_text().splitlines()[0] == COLUMNS
    rows = table(run)
    assert rows["episode"].tolist() == list(range(N))
    assert set(rows["seed"]) == {EVALUATION_SEED}
    assert set(rows["map"]) == {0}
    assert set(rows["outcome"]) <= OUTCOMES
    finished = rows["outcome"] == "finished"
    assert 3 <= finished.sum() < N - 2
    assert (rows["time_s"].notna() == finished).all()
    assert rows["lap_time_s"].isna().all()
    assert (rows["gates_passed"][finished] == 9).all()
    assert (rows["gates_passed"][~finished] < 9).all()
    np.testing.assert_allclose(rows["last_gate_time_s"][finished], rows["time_s"][finished], atol=2e-6)
    crashed = rows["outcome"] == "crashed"
    assert (rows["min_clearance_m"][crashed] < 0.1).all()
    assert (rows["min_clearance_m"][~crashed] >= 0.1 - 1e-6).all()
    assert (rows["path_length_m"][finished] > 65).all()  # the course is 66 m long
    assert (rows["peak_speed_mps"] >= rows["mean_speed_mps"]).all()
    speed = rows["path_length_m"][finished] / rows["time_s"][finished]
    np.testing.assert_allclose(rows["mean_speed_mps"][finished], speed, rtol=1e-5)


def test_validation_has_other_starts_on_the_same_map(tmp_path, config):
    settings = config("env=split_s", "env.horizon=0.1", "seed=1")
    run = make_run(tmp_path, settings)
    summaries = [evaluate_run(run, 5, suite, "none") for suite in ("train_map", "validation")]
    assert [summary["evaluation_seed"] for summary in summaries] == [EVALUATION_SEED, VALIDATION_SEED]
    assert set(pd.read_csv(run.path / "eval/validation/episodes.csv")["seed"]) == {VALIDATION_SEED}
    suites = [make_suite(settings, suite) for suite in ("train_map", "validation")]
    assert suites[0].map_seeds == suites[1].map_seeds
    starts = []
    for suite in suites:
        race = suite.race(np.arange(5))
        race.reset()
        starts.append(np.vstack([race.fleet.state[:10], race.fleet.waypoints.reshape(-1, 5)]))
    np.testing.assert_array_equal(suites[0].field.obstacles(0), suites[1].field.obstacles(0))
    differ = (starts[0] != starts[1]).any(axis=1)
    assert differ[:10].all()
    assert differ[10:].sum() >= 3  # some waypoint


def test_summary_against_pandas(flown_forest):
    run, summary = flown_forest
    assert json.loads((run.path / "eval/train_map/summary.json").read_text()) == summary
    assert run.evaluations["train_map"] == summary
    rows = table(run)
    counts = rows["outcome"].value_counts()
    assert summary["outcomes"] == {name: counts.get(name, 0) for name in summary["outcomes"]}
    assert set(summary["outcomes"]) == OUTCOMES
    crashes = rows["outcome"].isin(["crashed", "out_of_bounds", "diverged"])
    finished = rows[rows["outcome"] == "finished"]
    interval = binomtest(int(crashes.sum()), N).proportion_ci(method="wilson")
    assert summary["crash_interval"] == pytest.approx([interval.low, interval.high])
    expected = {
        "crash_ratio": crashes.mean(),
        "time_mean_s": finished["time_s"].mean(),
        "time_std_s": finished["time_s"].std(ddof=0),
        "penalised_time_s": rows["time_s"].fillna(20.0).mean(),
        "mean_speed_mps": finished["mean_speed_mps"].mean(),
        "peak_speed_mps": rows["peak_speed_mps"].max(),
        "min_clearance_m": finished["min_clearance_m"].min(),
    }
    assert {name: summary[name] for name in expected} == pytest.approx(expected, abs=2e-6)
    assert (summary["format"], summary["run"], summary["suite"]) == (1, run.id, "train_map")
    assert (summary["episodes"], summary["evaluation_seed"], summary["timed"]) == (N, EVALUATION_SEED, "time_s")
    assert summary["horizon_s"] == 20.0
    assert {"srlrace", "torch", "numpy"} <= summary["versions"].keys()


def test_the_recording_agrees_with_the_table(flown_forest):
    run, _ = flown_forest
    rows, states = table(run), read_states(recording(run))
    pd.testing.assert_frame_equal(read_episodes(recording(run)), rows)
    assert read_metadata(recording(run))["run"] == run.id
    flights = dict(tuple(states.groupby("episode")))
    assert list(flights) == list(range(N))
    for i, row in rows.iterrows():
        flight = flights[i]
        position = flight[["position_x", "position_y", "position_z"]].to_numpy()
        velocity = flight[["velocity_x", "velocity_y", "velocity_z"]].to_numpy()
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        assert steps.sum() == pytest.approx(row["path_length_m"], rel=1e-4)
        np.testing.assert_allclose(np.diff(flight["time"]), 0.02, atol=1e-6)
        last = flight["time"].iloc[-1]
        if row["outcome"] == "finished":
            assert last - 0.02 <= row["time_s"] <= last + 1e-6
            assert read_flight(recording(run), i).finish_time == pytest.approx(row["time_s"], abs=1e-6)
        else:
            assert steps.sum() / last == pytest.approx(row["mean_speed_mps"], rel=1e-4)
        assert np.linalg.norm(velocity[1:], axis=1).max() == pytest.approx(row["peak_speed_mps"], rel=1e-5)
        centre = flight["clearance"].iloc[1:].min()
        assert centre - 0.15 == pytest.approx(row["min_clearance_m"], abs=1e-5)


def test_recorded_rewards_are_those_of_the_flight(flown_forest):
    """Progress telescopes to the distances covered towards each waypoint; time and collision are known."""
    run, _ = flown_forest
    rows, states = table(run), read_states(recording(run))
    reward = run.config.reward
    for i, flight in states.groupby("episode"):
        terms = flight[[f"reward_{term}" for term in TERMS]].sum()
        crashed = rows["outcome"][i] in ("crashed", "out_of_bounds")
        assert terms["reward_collision"] == pytest.approx(reward.collision * crashed)
        assert terms["reward_time"] == pytest.approx(reward.time * 0.02 * (len(flight) - 1), rel=1e-5)
        position = flight[["position_x", "position_y", "position_z"]].to_numpy()
        goals = read_flight(recording(run), i).waypoints[flight["target"].to_numpy()[:-1]]
        gain = np.linalg.norm(goals - position[:-1], axis=1) - np.linalg.norm(goals - position[1:], axis=1)
        assert terms["reward_progress"] == pytest.approx(reward.progress * gain.sum(), abs=1e-3)


def test_the_first_recorded_state_is_the_reset(flown_forest):
    run, _ = flown_forest
    first = read_states(recording(run)).groupby("episode").first()
    assert (first["time"] == 0).all()
    start = np.array(run.config.env.start)
    assert (np.abs(first[["position_x", "position_y", "position_z"]] - start) <= 1 + 1e-5).all(axis=None)
    assert (first[[f"reward_{term}" for term in TERMS]] == 0).all(axis=None)
    field = make_suite(run.config, "train_map").field
    gaps = field.gaps(first[["position_x", "position_y", "position_z"]].to_numpy())
    np.testing.assert_allclose(first["clearance"], gaps, atol=1e-5)


def test_the_same_bytes_again(config, tmp_path):
    """The policy itself flies, in two folders of the same run."""
    settings = config("level=2", "algo.policy_layers=[16]", "algo.value_layers=[16]")
    runs = [make_run(tmp_path / name, settings) for name in "ab"]
    for run in runs:
        evaluate_run(run, 30)
    for name in ("episodes.csv", "trajectories.mcap", "summary.json"):
        first, second = ((run.path / "eval/train_map" / name).read_bytes() for run in runs)
        assert first == second, name
    assert set(table(runs[0])["outcome"]) <= {"crashed", "out_of_bounds", "timeout"}


@pytest.mark.usefixtures("piloted")
@pytest.mark.parametrize("track", ["forest", "split_s"])
def test_every_method_meets_the_same_conditions(config, tmp_path, track):
    """Whatever the reward, the observation, the randomization and the seed of the training."""
    methods = (
        ("reward=srl",),
        ("baseline=song", "seed=3"),
        ("reward=no_safety", "randomization=full", "randomization.maps=2", "curriculum=none"),
    )
    states = ["position_x", "position_y", "position_z", "velocity_x", "velocity_y", "velocity_z"]
    states += ["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"]
    starts, waypoints = [], []
    for method in methods:
        run = make_run(tmp_path, config(f"env={track}", "env.horizon=0.2", *method))
        evaluate_run(run, 8)
        starts.append(read_states(recording(run)).groupby("episode").first()[states].to_numpy())
        waypoints.append([read_flight(recording(run), i).waypoints for i in range(8)])
    for other in (1, 2):
        np.testing.assert_array_equal(starts[0], starts[other])
        np.testing.assert_array_equal(waypoints[0], waypoints[other])
    assert len(np.unique(starts[0][:, 0])) == 8
    displaced = np.ptp(waypoints[0], axis=0).max() > 0
    assert displaced == (track == "split_s")


@pytest.mark.usefixtures("piloted")
def test_more_episodes_begin_with_the_same(config, tmp_path):
    few = make_run(tmp_path / "few", config("level=1"))
    many = make_run(tmp_path / "many", config("level=1"))
    evaluate_run(few, 5)
    evaluate_run(many, 12)
    pd.testing.assert_frame_equal(table(few), table(many)[:5])


@pytest.mark.usefixtures("piloted")
def test_lap_times(config, tmp_path):
    run = make_run(tmp_path, config("env=split_s", "level=none"))
    summary = evaluate_run(run, 12)
    rows = table(run)
    assert summary["timed"] == "lap_time_s"
    finished = rows[rows["outcome"] == "finished"]
    assert len(finished) > 8
    assert summary["time_mean_s"] == pytest.approx(finished["lap_time_s"].mean(), abs=1e-6)
    assert (finished["gates_passed"] == 8).all()
    states = read_states(recording(run))
    for i, row in finished.iterrows():
        flight = states[states["episode"] == i]
        gate = read_flight(recording(run), i).waypoints
        position = flight[["position_x", "position_y", "position_z"]].to_numpy()
        fine = np.concatenate([np.linspace(a, b, 50, endpoint=False) for a, b in itertools.pairwise(position)])
        time = np.arange(len(fine)) * 0.02 / 50
        first = time[np.argmax(np.linalg.norm(fine - gate[0], axis=1) <= 0.3)]
        assert row["time_s"] - row["lap_time_s"] == pytest.approx(first, abs=1e-3)
        assert row["last_gate_time_s"] < row["time_s"]
        at_last = fine[np.searchsorted(time, row["last_gate_time_s"])]
        assert np.linalg.norm(at_last - gate[6]) == pytest.approx(0.3, abs=0.02)
    assert rows["lap_time_s"][rows["outcome"] != "finished"].isna().all()


@pytest.mark.usefixtures("piloted")
def test_unseen_levels(config, tmp_path, monkeypatch):
    monkeypatch.setattr(suites, "UNSEEN_MAPS", 3)
    settings = config("level=mixed", "level.maps=2")
    run = make_run(tmp_path, settings)
    summary = evaluate_run(run, 30, "level1", "2")
    rows = table(run, "level1")
    assert summary["maps"] == 3
    assert summary["suite"] == "level1"
    seeds = sorted(set(rows["map"]))
    assert len(seeds) == 3
    assert min(seeds) >= 1_000_000
    assert rows["map"].value_counts().min() > 3
    suite = make_suite(settings, "level1")
    assert suite.map_seeds == tuple(seeds)
    assert suite.config.level.name == "1"
    assert None not in certify(suite.config, suite.field.map_obstacles)
    assert sorted(set(read_states(recording(run, "level1"))["episode"])) == [0, 1]


@pytest.mark.usefixtures("piloted")
def test_a_disturbed_suite_flies_the_same_episodes_in_another_world(config, tmp_path, monkeypatch):
    monkeypatch.setattr(suites, "UNSEEN_MAPS", 3)
    run = make_run(tmp_path, config("level=mixed", "level.maps=2", "env.horizon=1"))
    calm = evaluate_run(run, 12, "level1")
    blown = evaluate_run(run, 12, "level1-wind5")
    assert "disturbance" not in calm
    assert blown["disturbance"] == {"name": "wind5", "wind": 5.0}
    assert run.evaluations.keys() == {"level1", "level1-wind5"}
    starts = [read_states(recording(run, suite)).groupby("episode").first() for suite in ("level1", "level1-wind5")]
    pd.testing.assert_frame_equal(*starts)
    assert (table(run, "level1")["map"] == table(run, "level1-wind5")["map"]).all()
    assert (table(run, "level1")["path_length_m"] - table(run, "level1-wind5")["path_length_m"]).abs().min() > 1e-4


def test_a_delay_that_the_run_cannot_have_is_refused(config, tmp_path):
    run = make_run(tmp_path, config("level=none", "sim.control_period=0.015"))
    with pytest.raises(RunError, match="20 ms is no multiple of the control period, 15 ms"):
        evaluate_run(run, 3, "train_map-delay20")


def test_unseen_maps_of_the_runs_own_level(config, monkeypatch):
    monkeypatch.setattr(suites, "UNSEEN_MAPS", 6)
    settings = config("level=mixed", "level.maps=3", "level.map_seed=5")
    suite = make_suite(settings, "unseen")
    assert suite.config.level == settings.level
    assert min(suite.map_seeds) >= 1_000_005
    trees = sorted(len(suite.field.obstacles(m)) for m in range(6))
    assert trees[1] < 100 < trees[2] < 150 < trees[4]  # two of each density
    assert None not in certify(suite.config, suite.field.map_obstacles)


def test_the_training_maps_of_a_run_with_fresh_ones_are_its_last(config):
    settings = config("level=endless", "level.maps=4", "level.fresh_steps=1000", "algo.total_steps=50001",
                      "algo.n_envs=10", "algo.n_steps=100", "algo.batch_size=100")  # fmt: skip
    suite = make_suite(settings, "train_map")
    assert suite.map_seeds == (50, 51, 52, 53)  # the last rollout begins after 50 000 steps
    assert suite.field.maps == 4


def test_the_train_map_suite_flies_the_maps_of_the_training(config):
    mixed = make_suite(config("level=mixed", "level.maps=3", "level.map_seed=5"), "train_map")
    assert mixed.map_seeds == (5, 6, 7)
    assert mixed.field.maps == 3
    full = make_suite(config("randomization=full", "level=1"), "train_map")
    assert full.config.randomization == config("randomization=init").randomization


@pytest.mark.usefixtures("piloted")
def test_what_is_recorded(config, tmp_path):
    run = make_run(tmp_path, config("level=none", "env.horizon=0.1"))
    for record, episodes in (("all", 6), ("2", 2), ("100", 6), ("none", 0), ("0", 0)):
        evaluate_run(run, 6, record=record)
        assert recording(run).exists() == (episodes > 0)
        if episodes:
            assert read_states(recording(run))["episode"].nunique() == episodes
            assert len(read_episodes(recording(run))) == 6
    left = {path.name for path in recording(run).parent.iterdir()}
    assert left == {"episodes.csv", "summary.json"}


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"suite": "level9"}, "suite: got 'level9', takes one of train_map, validation, unseen, level1"),
        ({"suite": "level1-storm"}, "did you mean level1"),
        ({"suite": "unseen"}, "suite unseen: level none draws no maps"),
        ({"record": "some"}, "record: got 'some', takes all, none or a number"),
        ({"record": "-1"}, "record: got '-1'"),
        ({"episodes": 0}, "episodes: got 0, takes a whole number of at least 1"),
    ],
)
def test_bad_requests_are_one_line(config, tmp_path, request_, words):
    run = make_run(tmp_path, config("level=none"))
    with pytest.raises(RunError) as refusal:
        evaluate_run(run, **{"episodes": 3, **request_})
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert not (run.path / "eval").exists()


def test_a_policy_that_does_not_fit_is_refused(config, tmp_path):
    run = make_run(tmp_path, config("level=none"))
    other = dataclasses.replace(config("level=none"), observation=config("observation=rays").observation)
    save_policy(build_policy(other), run.path / "policy.safetensors")
    with pytest.raises(FileError, match=r"has shape \(64, 56\), the config asks \(64, 34\)"):
        evaluate_run(run, 3)
    (run.path / "policy.safetensors").unlink()
    with pytest.raises(FileError, match="cannot read"):
        evaluate_run(run, 3)


@pytest.mark.usefixtures("piloted")
def test_nothing_finished_has_no_time(config, tmp_path):
    summary = evaluate_run(make_run(tmp_path, config("level=none", "env.horizon=0.1")), 5)
    assert summary["outcomes"]["timeout"] == 5
    assert (summary["time_mean_s"], summary["time_std_s"], summary["min_clearance_m"]) == (None, None, None)
    assert summary["penalised_time_s"] == pytest.approx(0.1)
    assert summary["crash_ratio"] == 0
    assert summary["mean_speed_mps"] is None
