"""How long a sweep takes, and what its jobs ask for."""

import json
import sys
from dataclasses import replace

import pytest

from srlrace.config import ConfigError, run_id, to_dict
from srlrace.runs import RunFolder
from srlrace.sweep.command import check_launcher, sweep
from srlrace.sweep.crew import Forecast
from srlrace.sweep.pace import START_UP, STEPS_PER_S, Pace, read_pace, roughly, together
from srlrace.sweep.plan import Job, Plan, experiments, plan_jobs
from srlrace.sweep.resources import Resources, read_extra, read_minutes


def job(root, config, **suites):
    return Job(config, RunFolder(root / run_id(config)), ("seed=0",), suites)


def finish(root, config, steps, wall):
    folder = root / run_id(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    (folder / "run.json").write_text(json.dumps({"steps": steps, "train_wall_s": wall}))


def test_the_runs_most_alike_say_how_long_it_takes(tmp_path, config):
    forest, split, wide = (config("algo.total_steps=1000000", word) for word in ("env=forest", "env=split_s", "seed=9"))
    wide = replace(wide, algo=replace(wide.algo, policy_layers=(256, 256)))
    assert read_pace(tmp_path).training(job(tmp_path, forest)) == pytest.approx(1e6 / STEPS_PER_S + START_UP)
    finish(tmp_path, replace(forest, seed=1), 2_000_000, 20.0)
    finish(tmp_path, replace(forest, seed=2), 2_000_000, 40.0)
    finish(tmp_path, replace(forest, seed=3), 2_000_000, 25.0)
    finish(tmp_path, replace(split, seed=1), 2_000_000, 200.0)
    (tmp_path / "nonsense").mkdir()
    (tmp_path / "nonsense" / "config.json").write_text("[]")
    (tmp_path / "nonsense" / "run.json").write_text('{"steps": 1, "train_wall_s": 1}')
    pace = read_pace(tmp_path)
    assert pace.source == "from 4 finished runs"
    assert pace.training(job(tmp_path, forest)) == pytest.approx(1e6 / 80_000 + START_UP)
    assert pace.training(job(tmp_path, split)) == pytest.approx(1e6 / 10_000 + START_UP)
    rates = sorted([100_000, 50_000, 80_000, 10_000])
    assert pace.training(job(tmp_path, wide)) == pytest.approx(1e6 / ((rates[1] + rates[2]) / 2) + START_UP)


def test_published_runs_say_how_long_it_takes_where_no_own_run_is_alike(tmp_path, config):
    forest, split = (config("algo.total_steps=1000000", word) for word in ("env=forest", "env=split_s"))
    finish(tmp_path / "reference", replace(forest, seed=1), 2_000_000, 20.0)
    finish(tmp_path / "reference", replace(split, seed=1), 2_000_000, 200.0)
    pace = read_pace(tmp_path)
    assert pace.source == "from 2 published runs, of another machine"
    assert pace.training(job(tmp_path, split)) == pytest.approx(1e6 / 10_000 + START_UP)
    finish(tmp_path, replace(forest, seed=2), 2_000_000, 40.0)
    pace = read_pace(tmp_path)
    assert pace.source == "from 1 finished run and 2 published runs, of another machine"
    assert pace.training(job(tmp_path, forest)) == pytest.approx(1e6 / 50_000 + START_UP)
    assert pace.training(job(tmp_path, split)) == pytest.approx(1e6 / 10_000 + START_UP)


def test_what_is_done_takes_no_more_time(tmp_path, config):
    begun = job(tmp_path, config("algo.total_steps=1000000"), train_map=1000)
    pace = Pace({"": 1e4}, 1)
    whole = pace.left(begun)
    begun.folder.path.mkdir()
    (begun.folder.path / "progress.csv").write_text("steps\n750000\n")
    assert whole - pace.left(begun) == pytest.approx(0.75 * (100 + START_UP))


def test_side_by_side():
    assert together([10.0, 10.0, 10.0, 10.0], 2) == 20
    assert together([10.0, 1.0], 8) == 10
    assert together([], 2) == 0
    assert [roughly(s) for s in (20, 90, 3600, 9000)] == ["less than a minute", "2 min", "1 h 00 min", "2 h 30 min"]


def test_the_time_left_follows_what_really_happens(tmp_path, config, monkeypatch):
    jobs = [job(tmp_path, replace(config("algo.total_steps=1000000"), seed=seed)) for seed in range(4)]
    now = [0.0]
    monkeypatch.setattr("srlrace.sweep.crew.time.monotonic", lambda: now[0])
    forecast = Forecast(jobs, 2, Pace({"": 1e6 / 95}, 1))  # 100 s each
    assert forecast.remaining() == pytest.approx(200)
    now[0] = 300.0  # far slower than expected
    forecast.complete(jobs[0])
    assert forecast.remaining() == pytest.approx(900)
    assert "1 of 4 runs; 15 min to go" in forecast.remark()


@pytest.mark.parametrize(
    ("text", "minutes"),
    [(None, None), ("90", 90), ("1:30", 2), ("2:00:00", 120), ("1-0", 1440), ("2-12:30", 3630), ("0:01", 1)],
)
def test_times_as_slurm_writes_them(text, minutes):
    assert read_minutes(text) == minutes


@pytest.mark.parametrize("text", ["", "0", "soon", "1h", "-5", "1:99", "1:2:3:4"])
def test_times_that_are_none(text):
    with pytest.raises(ConfigError, match="--time: got"):
        read_minutes(text)


def test_other_options_of_sbatch():
    assert read_extra(["account=lab", "exclusive"]) == {"account": "lab", "exclusive": ""}
    for word in ("--account=lab", "account=a b", "wrap=$(id)", "comment=x\n#SBATCH"):
        with pytest.raises(ConfigError, match="--slurm: got"):
            read_extra([word])


def test_resources_have_sensible_defaults(tmp_path, config):
    steps = "algo.total_steps=25_000_000"
    small, large = config(steps), config(steps, "algo.n_envs=10000", "algo.threads=4")
    pace = Pace({"": 1000.0}, 1)  # seven hours a run
    filled = Resources().fill([job(tmp_path, small)], Pace({}, 0))
    assert (filled.cores, filled.memory_gb, filled.minutes) == (1, 2, 30)
    filled = Resources().fill([job(tmp_path, small), job(tmp_path, large)], pace)
    assert filled.cores == 4
    assert filled.memory_gb > 2
    assert 20 * 60 < filled.minutes < 22 * 60
    assert Resources(2, 8.0, 15, "short").fill([job(tmp_path, small)], pace) == Resources(2, 8.0, 15, "short")


def test_threads_follow_cores_and_name_another_run(tmp_path):
    [plain], [threaded] = (plan_jobs(experiments(["smoke"]), Plan(tmp_path, cores=cores)) for cores in (None, 2))
    assert (plain.config.algo.threads, threaded.config.algo.threads) == (1, 2)
    assert plain.folder.id != threaded.folder.id
    [one] = plan_jobs(experiments(["smoke"]), Plan(tmp_path, cores=1))
    assert one.folder.id == plain.folder.id


@pytest.mark.parametrize(("launcher", "package"), [("slurm", "submitit"), ("ray", "ray")])
def test_a_plain_install_says_what_is_missing(tmp_path, monkeypatch, launcher, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ConfigError, match=rf"pip install 'srlrace\[{launcher}\]'"):
        sweep(["smoke"], Plan(tmp_path), launcher, None, Resources(), dry_run=False)
    assert sweep(["smoke"], Plan(tmp_path), launcher, None, Resources(), dry_run=True) == 0


def test_launchers_have_names():
    assert check_launcher("ray") == "ray"
    with pytest.raises(ConfigError, match=r"--launcher: got 'slrum'; takes one of .*did you mean slurm"):
        check_launcher("slrum")
