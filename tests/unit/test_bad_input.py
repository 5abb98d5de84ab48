"""What bad input gets: one line that names the setting, status 2, no traceback, nothing written, nothing heavy."""

import contextlib
import sys

import pytest

from srlrace import cli
from srlrace.hydra_bridge import compose, compose_all
from srlrace.overrides import check_arguments
from srlrace.parse import ConfigError

BAD = [  # what is typed after `srlrace train`, and what the one line must say
    ("+env.wind=3", "env.wind: no such setting; did you mean env."),
    ("++env.wind=3", "env.wind: no such setting"),
    ("+seed=3", "write seed=3"),
    ("+foo/bar=3", "no such setting"),
    ("~seed", "cannot be removed"),
    ("~env", "cannot be removed"),
    ("algo.learning_rate=nan", "algo.learning_rate: got nan; takes a number > 0 and <= 1"),
    ("algo.learning_rate=inf", "algo.learning_rate: got inf"),
    ("seed=20240401", "seed: got 20240401, which draws the starts of evaluations; takes another"),
    ("seed=777001", "seed: got 777001, which draws the starts of evaluations"),
    ("algo.learning_rate=-1", "algo.learning_rate: got -1; takes a number > 0"),
    ("algo.learning_rate=abc", "algo.learning_rate: got 'abc'; takes a number > 0"),
    ("algo.learning_rate=", "algo.learning_rate: got ''"),
    ("algo.learning_rate=null", "algo.learning_rate: got 'null'"),
    ("algo.learning_rate_decay=cosine", "algo.learning_rate_decay: got 'cosine'; takes one of linear, geometric"),
    ("algo.learning_rate_decay=geometric algo.learning_rate_final=0", "algo.learning_rate_final: got 0"),
    ("algo.gamma=1.5", "algo.gamma: got 1.5; takes a number > 0 and <= 1"),
    ("algo.n_envs=-3", "algo.n_envs: got -3; takes a whole number >= 1"),
    ("algo.n_envs=2.5", "algo.n_envs: got 2.5; takes a whole number"),
    ("algo.n_envs=100000000", "GiB"),
    ("algo.n_envs=1e400", "algo.n_envs: got inf"),
    ("algo.total_steps=0", "algo.total_steps: got 0"),
    ("algo.batch_size=7", "takes a divisor of the rollout"),
    ("algo.policy_layers=[64,x]", "algo.policy_layers[1]: got 'x'"),
    ("algo.policy_layers=[64", "algo.policy_layers: got '[64'"),
    ("algo.policy_layers=64", "algo.policy_layers: got '64'; takes a list"),
    ("env.start=[0,0,nan]", "env.start[2]: got nan"),
    ("env.start=[0,0,100]", "env.start: z is 100, outside the world"),
    ("seed=true", "seed: got 'true'; takes a whole number"),
    ("seed=-1", "seed: got -1"),
    ("seed=1 seed=2", "seed: given twice"),
    ("env=forest env=split_s", "env: given twice"),
    ("name=../../x", "name: got '../../x'; takes a name"),
    ("name=/etc/passwd", "name: got '/etc/passwd'"),
    ("hydra.run.dir=../..", "hydra.run.dir: not for you to set"),
    ("hydra.sweep.dir=/tmp", "hydra.sweep.dir: not for you to set"),
    ("hydra.searchpath=[file:///tmp]", "hydra.searchpath: not for you to set"),
    ("hydra/job_logging=stdout", "not for you to set"),
    ("+hydra.callbacks.x._target_=os.system", "not for you to set"),
    ("hydra.launcher._target_=os.system", "not for you to set"),
    ("hydra/launcher=jobllib", "joblib"),
    ("hydra/launcher=1", "hydra/launcher"),
    ("hydra/launcher=true", "hydra/launcher"),
    ("hydra/launcher=", "hydra/launcher"),
    ("hydra/launcher=@'\\", "hydra/launcher"),
    ("hydra.launcher.n_jobz=3", "n_jobz"),
    ("name=${oc.env:HOME}", "nothing is interpolated"),
    ("env.name=${env.start}", "nothing is interpolated"),
    ("${seed}=3", "nothing is interpolated"),
    ("_target_=os.system", "no such setting"),
    ("algo._target_=os.system", "algo._target_: no such setting"),
    ("reward={progress:1}", "reward: got '{progress:1}'; takes one of no_safety"),
    ("sim=fast", "sim: takes one setting at a time: sim.control_period=...; it has control_period, substeps"),
    ("algo.learning_rate=0,0003", "decimal comma? write 0.0003"),
    ("algo.learning_rate=0,0003 -m", "decimal comma? write 0.0003"),
    ("algo.learning_rate=1e-4,3e-4", "add -m"),
    ("reward=srl,paper", "add -m"),
    ("seed=range(3)", "seed: got 'range(3)'; takes a whole number"),
    ("-m seed=1,x", "seed: got 'x'"),
    ("-m seed=range(0,100000)", "more than 10000 runs"),
    ("-m algo.n_envs=100,100000000", "GiB"),
    ("--seed=3", "write seed=3"),
    ("--seed 3", "write seed=3"),
    ("--env=forest", "write env=forest"),
    ("--multi", "no such option; did you mean --multirun?"),
    ("--cfg", "--cfg: got ''; takes one of job, hydra, all"),
    ("--cfg jobs", "did you mean job?"),
    ("--config-dir /nowhere", "not a folder"),
    ("--config-path /tmp", "no such option"),
    ("--config-name x", "no such option"),
    ("--experimental-rerun x.pickle", "no such option"),
    (
        "env=Forest",
        "env: got 'Forest'; takes one of forest, split_s, split_s_cpc, or the path of a track.yaml; did",
    ),
    ("env=forst", "did you mean forest?"),
    ("level=4", "level: got '4'; takes one of 1, 2, 3, endless, mixed, none, split_s"),
    ("reward=srl_tund", "did you mean srl_tuned?"),
    ("observation=ray", "did you mean rays?"),
    ("baseline=sogn", "did you mean song?"),
    ("quad=kingfischer", "did you mean kingfisher?"),
    ("randomization=ful", "did you mean full?"),
    ("curriculum=defaults", "did you mean default?"),
    (
        "curriculum.hard_starts=0.9",
        "curriculum.hard_starts: with curriculum.retry_starts and curriculum.escape_starts it makes 1.1",
    ),
    (
        "curriculum.escape_starts=0.1",
        "curriculum.escape_starts: takes 0 while curriculum.teaching is 0, which is how much",
    ),
    ("curriculum.waypoint_margin=0.3", "curriculum.waypoint_margin: got 0.3; takes less than env.passing_radius, 0.3"),
    ("algo=pppo", "did you mean ppo?"),
    ("env=../../etc/passwd", "no such file"),
    ("reward=../env/forest", "reward: got '../env/forest'; takes one of"),
    ("env@x=forest", "no such setting"),
    ("forest", "did you mean env=forest?"),
    ("learning_rate=1", "did you mean algo.learning_rate?"),
    ("algo.learning_rat=1e-4", "did you mean algo.learning_rate?"),
    ("=3", "no such setting"),
    ("se\x1b[2Jed=3", "no such setting"),
]


@pytest.mark.parametrize(("typed", "words"), BAD, ids=[typed.replace("\x1b", "ESC") for typed, _ in BAD])
def test_one_line_status_2_nothing_written(typed, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SRLRACE_RUNS", raising=False)
    monkeypatch.setattr(sys, "argv", ["srlrace", "train", *typed.split()])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    out, err = capfd.readouterr()
    assert leaving.value.code == 2
    assert out == ""
    assert err.startswith("error: ")
    assert words in err
    assert err.count("\n") == 1
    assert "\x1b" not in err
    assert list(tmp_path.iterdir()) == []


GOOD = {
    "algo.total_steps=1e6": ("algo", "total_steps", 1_000_000),
    "algo.learning_rate=.001": ("algo", "learning_rate", 0.001),
    "algo.gamma=1": ("algo", "gamma", 1.0),
    "algo.policy_layers=[128, 128]": ("algo", "policy_layers", (128, 128)),
    "level=1": ("level", "name", "1"),
    "level='1'": ("level", "name", "1"),
    "level.name=7": ("level", "name", "7"),
    "randomization.every_waypoint=True": ("randomization", "every_waypoint", True),
    "env.start=[-20,0,1]": ("env", "start", (-20.0, 0.0, 1.0)),
}


@pytest.mark.parametrize("typed", GOOD)
def test_what_people_write_is_understood(typed):
    group, name, value = GOOD[typed]
    found = getattr(getattr(compose([typed]), group), name)
    assert found == value
    assert type(found) is type(value)


def own(tmp_path, text) -> str:
    path = tmp_path / "my_track.yaml"
    path.write_text(text)
    return f"env={path}"


def test_a_track_of_ones_own(tmp_path):
    text = """
        waypoints: [[0, 0, 1], [5, 5, 2]]
        start: [-5, 0, 1]
        obstacles: [{kind: box, center: [2, 2, 1], edge: 0.5}]
        laps: 2
    """
    config = compose([own(tmp_path, text), "env.horizon=30"])
    assert config.env.name == "my_track"
    assert config.env.waypoints == ((0.0, 0.0, 1.0), (5.0, 5.0, 2.0))
    assert config.env.bounds_low == (-11.0, -6.0, 0.0)
    assert config.env.bounds_high == (11.0, 11.0, 8.0)
    assert (config.env.laps, config.env.horizon) == (2, 30.0)
    assert config.env.obstacles[0].edge == 0.5
    assert config.env.displaced_waypoints == 0
    assert config.level.name == "none"
    assert compose([own(tmp_path, text), "level=1"]).level.name == "1"
    requests = compose_all(check_arguments(["-m", own(tmp_path, text), "env.horizon=30", "seed=0,1"]))
    assert [one.env for one in requests] == [config.env, config.env]
    bounded = compose([own(tmp_path, text + "    bounds: [[-9, -9, 0], [9, 9, 9]]\n")])
    assert bounded.env.bounds_high == (9.0, 9.0, 9.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "mapping"),
        ("waypoints: [[0, 0, 1]]", "env.start: missing"),
        ("waypoints: [[0, 0]]\nstart: [0, 0, 1]", "env.waypoints[0]: got 2 elements"),
        ("waypoints: [[0, 0, 1]]\nstart: [0, 0, 1]\nwind: 3", "env.wind: no such setting"),
        ("waypoints: [[0, 0, 1]]\nstart: [0, 0, 1]\nname: ${oc.env:HOME}", "env.name: got"),
        ("waypoints: [[0, 0, 1]]\nstart: ${oc.env:HOME}", "env.start: got"),
        ("waypoints: [[0, 0, .nan]]\nstart: [0, 0, 1]", "env.waypoints[0][2]: got nan"),
        ("waypoints: [[0, 0, 1]]\nstart: [0, 0, 1]\nbounds: 3", "env.bounds: got 3"),
        ("waypoints: [[0, 0, 1]]\nstart: [0, 0, 1]\nbounds: [[0, 0, 0], [1, 1, 0.5]]", "outside the world"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
        ("a: [", "not valid YAML"),
    ],
)
def test_a_bad_track_of_ones_own(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        compose([own(tmp_path, text)])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def write(folder, name, text):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_presets_of_ones_own(tmp_path):
    write(tmp_path, "reward/mine.yaml", "defaults: [srl]\nname: mine\nsafety: -0.1\n")
    config = compose(["--config-dir", str(tmp_path), "reward=mine"])
    assert (config.reward.name, config.reward.safety, config.reward.progress) == ("mine", -0.1, 1.0)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("defaults: [srl]\nname: ${oc.env:HOME}\n", "reward.name: got '${oc.env:HOME}'"),
        ("defaults: [srl]\n_target_: os.system\n", "reward._target_: no such setting"),
        ("defaults: [srl]\nwind: 3\n", "reward.wind: no such setting"),
        ("# @package hydra.callbacks\nx: {_target_: os.system}\n", "Hydra's own settings"),
        ("# @package hydra.launcher\n_target_: os.system\n", "Hydra's own settings"),
        ("# @package hydra.job.env_set\nLD_PRELOAD: x.so\n", "Hydra's own settings"),
        ("defaults: [nothing]\n", "nothing"),
        ("a: [\n", ""),
    ],
)
def test_bad_presets_of_ones_own(tmp_path, text, words):
    write(tmp_path, "reward/mine.yaml", text)
    with pytest.raises(ConfigError) as caught:
        compose(["--config-dir", str(tmp_path), "reward=mine"])
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["eval", "nothing"], "no run 'nothing'"),
        (["eval"], "no finished run"),
        (["eval", "--suite", "level4"], "did you mean level"),
        (["eval", "--record", "some"], "--record: got 'some'"),
        (["show", "../../etc"], "no run"),
        (["resume", "x"], "no run 'x'"),
        (["sweep", "minimum"], "did you mean minimum_time?"),
        (["sweep", "../train"], "experiment: got '../train'"),
        (["runs", "--filter", "envv=forest"], "did you mean env?"),
        (["recover", "flight.mcap"], "flight.mcap"),
    ],
)
def test_other_commands(arguments, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["srlrace", *arguments])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    err = capfd.readouterr().err
    assert leaving.value.code == 2
    assert words in err
    assert err.count("\n") == 1
    with contextlib.suppress(FileNotFoundError):
        assert list((tmp_path / "runs").iterdir()) == []
