"""The acceptance tests: the shipped references pass them, and anything bent does not. No solver takes part."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from srlrace.bound.accept import Rejected, accept
from srlrace.bound.problem import problem_of
from srlrace.bound.store import SHIPPED, UNSEEN, load, save, unseen_times
from srlrace.bound.trajectory import NODES
from srlrace.config import to_dict
from srlrace.evaluation.suites import UNSEEN_MAPS
from srlrace.hydra_bridge import compose
from srlrace.task.certificate import unseen_maps
from srlrace.world.obstacles import sphere


@pytest.fixture
def solved():
    problem = problem_of(compose(["env=forest", "level=none"]))
    reference = load(problem)
    assert reference is not None
    return problem, reference


def bent(trajectory, **parts):
    """A copy with rows replaced: state=(row, column, value)."""
    copies = {"state": trajectory.state.copy(), "thrust": trajectory.thrust.copy(), "step": trajectory.step.copy()}
    for name, (place, value) in parts.items():
        copies[name][place] = value
    return dataclasses.replace(trajectory, **copies)


def test_the_shipped_one_passes(solved):
    problem, reference = solved
    accept(problem, reference.trajectory, reference.point_mass_time)
    assert reference.point_mass_time < reference.time <= reference.times.min() + 1e-9


@pytest.mark.parametrize(
    ("part", "place", "value", "reason"),
    [
        ("state", (30, 0), 0.0, "off a finer integration"),
        ("state", (5, 4), np.nan, "not finite"),
        ("thrust", (7, 1), 9.0, r"finer integration|rotor leaves its range"),
        ("step", 3, 0.04, "off a finer integration"),
    ],
)
def test_another_motion_is_refused(solved, part, place, value, reason):
    problem, reference = solved
    with pytest.raises(Rejected, match=reason):
        accept(problem, bent(reference.trajectory, **{part: (place, value)}), 0.0)


def test_a_long_quaternion_is_refused(solved):
    """Twice the quaternion is the same attitude: only the test of its norm sees it."""
    problem, reference = solved
    state = reference.trajectory.state.copy()
    state[:, 6:10] *= 1.002
    with pytest.raises(Rejected, match="norm is off by"):
        accept(problem, dataclasses.replace(reference.trajectory, state=state), 0.0)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"passing_radius": 0.2}, "misses a waypoint"),
        ({"bounds_high": (26.0, 14.0, 3.0)}, "leaves the world"),
        ({"start": (-25.0, 0.0, 1.2)}, "at rest at the start"),
        ({"stop": True}, "does not end at rest"),
        ({"obstacles": (sphere((-15.0, -5.0, 1.12), 0.5),), "keep_out": 0.25}, "of an obstacle"),
    ],
)
def test_another_task_refuses_it(solved, changes, reason):
    problem, reference = solved
    with pytest.raises(Rejected, match=reason):
        accept(dataclasses.replace(problem, **changes), reference.trajectory, 0.0)


@pytest.mark.parametrize(("name", "value"), [("body_rate_max", (5.0, 6.0, 2.0)), ("thrust_max", 8.0)])
def test_a_weaker_quadrotor_refuses_it(solved, name, value):
    problem, reference = solved
    weaker = dataclasses.replace(problem, quad=dataclasses.replace(problem.quad, **{name: value}))
    with pytest.raises(Rejected, match=r"exceeds its limit|leaves its range"):
        accept(weaker, reference.trajectory, 0.0)


def test_faster_than_a_point_mass_is_refused(solved):
    problem, reference = solved
    with pytest.raises(Rejected, match="beat the point mass"):
        accept(problem, reference.trajectory, reference.time * 1.01)


def test_a_lap_that_does_not_close_is_refused():
    problem = problem_of(compose(["env=split_s", "level=none"]))
    reference = load(problem)
    state = reference.trajectory.state.copy()
    state[:, 6:10] *= -1  # the same attitudes
    accept(problem, dataclasses.replace(reference.trajectory, state=state), 0.0)
    state[-1, 3] += 2e-4
    with pytest.raises(Rejected, match="does not close"):
        accept(problem, dataclasses.replace(reference.trajectory, state=state), 0.0)


def test_obstacles_only_cost_time():
    """Whatever ships with obstacles is bracketed below by the same track without."""
    for words, most in ((["env=forest", "level=1"], 1.05), (["env=forest", "level=2"], 1.05),
                        (["env=forest", "level=3"], 1.19), (["env=split_s"], 1.05)):  # fmt: skip
        config = compose(words)
        cluttered, free = load(problem_of(config)), load(problem_of(config, obstacles=False))
        assert free.time < cluttered.time < most * free.time


def test_a_damaged_store_is_no_reference(solved, tmp_path, monkeypatch):
    problem, reference = solved
    monkeypatch.setattr("srlrace.bound.store.SHIPPED", tmp_path / "nothing")
    assert load(problem) is None
    path = save(problem, reference)
    assert load(problem).time == reference.time
    content = path.read_bytes()
    for damaged in (content[:5000], b"", b"no archive"):
        path.write_bytes(damaged)
        assert load(problem) is None
    faster = dataclasses.replace(reference.trajectory, step=reference.trajectory.step * 0.9)
    save(problem, dataclasses.replace(reference, trajectory=faster))
    assert load(problem) is None


def test_every_shipped_file_is_a_whole_reference():
    files = [*SHIPPED.glob("*.npz"), *UNSEEN.glob("*.npz")]
    assert files
    for path in files:
        with np.load(path, allow_pickle=False) as data:
            assert data["state"].shape == (NODES * len(data["step"]) + 1, 13)
            assert data["times"].min() == pytest.approx(NODES * data["step"].sum(), abs=1e-6)


@pytest.mark.parametrize("level", ["1", "2", "3"])
def test_the_times_of_unseen_maps_are_those_of_their_solutions(level):
    """The table that reports read holds what the shipped solutions, accepted again on the maps drawn anew, come to."""
    config = compose(["env=forest", f"level={level}"])
    free = problem_of(config, obstacles=False)
    times = unseen_times(free, config.level)
    assert set(times) == set(unseen_maps(config, UNSEEN_MAPS))
    assert None not in times.values()
    for seed, time in times.items():
        problem = problem_of(dataclasses.replace(config, level=dataclasses.replace(config.level, map_seed=seed)))
        assert load(problem).time == pytest.approx(time, abs=1e-6)
        assert time > load(free).time * 0.9999  # a wood may stand out of the way; both are solved to a tolerance


def test_a_report_shows_gaps_without_the_solver(tmp_path):
    """Casadi is made impossible to import; runs of the paper's tables get their gap, and the open Forest its time."""
    write_run(tmp_path / "forest", compose(["env=forest"]), 6.0)
    write_run(tmp_path / "split_s", compose(["env=split_s", "baseline=song"]), 7.0)
    program = """
import sys
sys.modules["casadi"] = None
from pathlib import Path
from srlrace.report.command import read_report
for table in read_report(Path(sys.argv[1]))[1].tables:
    for cell in table.cells:
        if cell.numbers:
            print(cell.environment, cell.numbers.time_s.value, cell.t_ref_s, cell.gap_pct, sep="|")
from srlrace.hydra_bridge import compose
from srlrace.report.reference import compare
for words, suite in (("level=none", "train_map"), ("level=mixed", "train_map"), ("level=mixed", "level2")):
    found = compare(compose(["env=forest", words]), suite, ())
    print(found.t_ref_s, *found.notes, sep="|")
"""
    done = subprocess.run([sys.executable, "-c", program, tmp_path], capture_output=True, text=True, check=True)
    *cells, free, many, unseen = done.stdout.splitlines()
    assert {cell.split("|")[0] for cell in cells} == {"Forest", "Split-S with obstacles"}
    for cell in cells:
        time, reference, gap = map(float, cell.split("|")[1:])
        assert gap == pytest.approx(100 * (time / reference - 1))
        assert 4.5 < reference < 5.2
    free_s = free.rstrip("|")
    assert 4.5 < float(free_s) < 4.6
    assert many == f"{free_s}|T_ref and the gap to it are of the track without obstacles"
    assert float(free_s) < float(unseen.split("|")[0]) < 1.05 * float(free_s)


def write_run(folder, config, seconds):
    """A finished run whose only flight took so long."""
    target = folder / "eval" / "train_map"
    target.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    (folder / "run.json").write_text(json.dumps({"format": 1, "state": "finished"}))
    (folder / "policy.safetensors").write_bytes(b"")
    header = "episode,seed,map,outcome,time_s,lap_time_s,gates_passed,min_clearance_m"
    (target / "episodes.csv").write_text(f"{header}\n0,7,0,finished,{seconds + 1},{seconds},9,0.5\n")
    (target / "summary.json").write_text(json.dumps({"format": 1, "suite": "train_map", "evaluation_seed": 7}))
