"""Commands: what reaches the training, what the exit status says, what is imported, what is shown."""

import json
import os
import signal
import subprocess
import sys
import types
from pathlib import Path

import pytest

from srlrace import cli, completion, console, hydra_bridge, training
from srlrace.catalogue import GROUPS, choices
from srlrace.config import run_id, to_dict
from srlrace.hydra_bridge import compose
from srlrace.learn.interrupt import Interrupted
from srlrace.overrides import check_arguments
from srlrace.runs import RunError, RunFolder
from srlrace.text import clean

HEAVY = ("torch", "numpy", "pandas", "numba", "scipy", "matplotlib", "gymnasium", "stable_baselines3", "joblib")


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["srlrace", *arguments])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    return leaving.value.code or 0


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SRLRACE_RUNS", raising=False)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(console.out, "width", 200)  # made before, where another test imported it
    return tmp_path


@pytest.fixture
def trained(place, monkeypatch):
    """A training that only notes what it was asked, and leaves a finished run."""
    calls = []

    def train_run(config, root, argv):
        calls.append((config, root, argv, list(sys.argv), Path.cwd()))
        store(root, config)
        return 0

    monkeypatch.setattr(training, "train_run", train_run)
    return calls


def store(root, config, *files) -> RunFolder:
    folder = root / run_id(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(to_dict(config)))
    for file in files or ("policy.safetensors",):
        (folder / file).touch()
    return RunFolder(folder)


def test_one_run(trained, place, monkeypatch):
    before = dict(os.environ), list(sys.argv)
    assert run(monkeypatch, "train", "env=split_s", "--runs", "elsewhere", "seed=3") == 0
    [(config, root, argv, _, cwd)] = trained
    assert config == compose(["env=split_s", "seed=3"])
    assert root == place / "elsewhere"
    assert argv == ["srlrace", "train", "env=split_s", "--runs", "elsewhere", "seed=3"]
    assert cwd == place
    assert [path.name for path in place.iterdir()] == ["elsewhere"]
    assert [path.name for path in root.iterdir()] == [run_id(config)]
    assert dict(os.environ) == before[0]


def test_typer_hands_through_the_same(trained, place):
    with pytest.raises(SystemExit) as leaving:
        cli.app(["train", "-m", "seed=0,1", "--runs", "elsewhere", "level=1"])
    assert leaving.value.code == 0
    assert [(config.seed, root) for config, root, *_ in trained] == [(0, place / "elsewhere"), (1, place / "elsewhere")]


@pytest.mark.parametrize(
    ("words", "seeds", "levels"),
    [
        (["-m", "seed=0,1", "level=1,2"], [0, 0, 1, 1], ["1", "2", "1", "2"]),
        (["level=1", "seed=range(3)", "--multirun"], [0, 1, 2], ["1", "1", "1"]),
        (["-m", "env=forest,split_s"], [0, 0], ["2", "split_s"]),
        (["-m", "seed=choice(4,2)"], [4, 2], ["2", "2"]),
    ],
)
def test_several_runs(trained, place, monkeypatch, words, seeds, levels):
    assert run(monkeypatch, "train", *words) == 0
    assert [config.seed for config, *_ in trained] == seeds
    assert [config.level.name for config, *_ in trained] == levels
    assert sorted(path.name for path in (place / "runs").iterdir()) == sorted({run_id(c) for c, *_ in trained})
    assert [path.name for path in place.iterdir()] == ["runs"]


def test_a_name_may_hold_quotes_and_blanks_in_its_folder(trained, place, monkeypatch):
    odd = place / "it's my = runs, here"
    assert run(monkeypatch, "train", "-m", "seed=1,2", "--runs", str(odd)) == 0
    assert {root for _, root, *_ in trained} == {odd}


def test_a_failed_run_of_several_does_not_stop_the_others(place, monkeypatch):
    done = []

    def train_run(config, root, argv):
        done.append(config.seed)
        if config.seed == 1:
            return 1
        store(root, config)
        return 0

    monkeypatch.setattr(training, "train_run", train_run)
    assert run(monkeypatch, "train", "-m", "seed=0,1,2") == 1
    assert done == [0, 1, 2]


def test_a_signal_stops_all_runs(place, monkeypatch):
    done = []

    def train_run(config, root, argv):
        done.append(config.seed)
        return 143

    monkeypatch.setattr(training, "train_run", train_run)
    assert run(monkeypatch, "train", "-m", "seed=0,1,2") == 143
    assert done == [0]


def test_showing_the_settings_writes_nothing(place, monkeypatch, capsys):
    assert run(monkeypatch, "train", "--cfg", "job", "reward=paper") == 0
    assert "name: paper" in capsys.readouterr().out
    # --info leaves Hydra's debug log open, so it gets a process of its own
    command = [sys.executable, "-m", "srlrace", "train", "--info", "defaults", "reward=paper"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "reward/paper" in done.stdout
    assert list(place.iterdir()) == []


def error_of(kind):
    return {
        "sigint": Interrupted(signal.SIGINT, "x"),
        "sigterm": Interrupted(signal.SIGTERM, "x"),
        "sighup": Interrupted(signal.SIGHUP, "x"),
        "held": RunError("it is held by process 1"),
        "full": OSError(28, "No space left on device", "file"),
        "bug": ZeroDivisionError("a bug"),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "status", "words"),
    [
        ("sigint", 130, "stopped by SIGINT; resume with: srlrace resume forest-srl-s0-"),
        ("sigterm", 143, "stopped by SIGTERM; resume with"),
        ("sighup", 129, "stopped by SIGHUP; resume with"),
        ("held", 2, "error: it is held by process 1"),
        ("full", 1, "No space left on device: file"),
        ("bug", 1, "ZeroDivisionError: a bug"),
    ],
)
def test_how_a_training_ends(place, monkeypatch, capfd, kind, status, words):
    def train(config, root, argv):
        raise error_of(kind)

    fake = types.SimpleNamespace(train=train, Diverged=type("Diverged", (RunError,), {}))
    monkeypatch.setitem(sys.modules, "srlrace.learn.train", fake)
    assert run(monkeypatch, "train") == status
    err = capfd.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_resume(place, monkeypatch, capfd):
    calls = []
    monkeypatch.setattr(training, "train_run", lambda config, root, argv: calls.append((config, root)) or 0)
    found = store(place / "runs", compose([]), "lock")
    assert run(monkeypatch, "resume", "forest-srl") == 0
    assert calls == [(compose([]), place / "runs")]
    found.path.rename(place / "renamed")
    assert run(monkeypatch, "resume", "renamed") == 2
    assert "rename the folder" in capfd.readouterr().err


def test_list_and_show(place, monkeypatch, capsys):
    config = compose(["reward=no_safety", "algo.total_steps=20_000_000", "algo.gamma=0.99"])
    found = store(place / "runs", config)
    store(place / "runs", compose([]), "lock")
    (found.path / "run.json").write_text(json.dumps({"argv": ["srlrace", "[red]\x1b[2J"]}))
    (found.path / "progress.csv").write_text("steps,success_ratio,crash_ratio\n10000000,0.5,0.25\n")
    suite = found.path / "eval" / "train_map"
    suite.mkdir(parents=True)
    summary = {"suite": "train_map", "episodes": 1000, "outcomes": {"finished": 987}, "time_mean_s": 7.125}
    (suite / "summary.json").write_text(json.dumps(summary))
    assert run(monkeypatch, "runs") == 0
    text = capsys.readouterr().out
    for words in (found.id, "finished", "20 M, 100 %", "train_map 987/1000 in 7.12 s", "interrupted"):
        assert words in text
    (suite / "summary.json").unlink()
    assert run(monkeypatch, "runs") == 0
    text = capsys.readouterr().out
    assert "10 M, 50 %" in text
    assert "training: 50 %, crash 25 %" in text
    assert run(monkeypatch, "runs", "--filter", "reward=no_safety", "--filter", "algo.gamma=0.99") == 0
    assert capsys.readouterr().out.count("forest-") == 1
    assert run(monkeypatch, "runs", "--filter", "state=failed") == 0
    assert capsys.readouterr().out == ""
    assert run(monkeypatch, "show", found.id[:12]) == 0
    text = capsys.readouterr().out
    assert "[red]\ufffd[2J" in text
    assert "reward.safety" in text


@pytest.mark.parametrize(
    "arguments",
    [
        ["--help"],
        ["train", "--help"],
        ["runs"],
        ["show", "x"],
        ["train", "env=forst"],
        ["train", "algo.n_envs=100000000"],
    ],
    ids=" ".join,
)
def test_nothing_heavy_is_imported(arguments, place):
    code = (
        "import sys; from srlrace import cli; sys.argv[1:] = sys.argv[2:]\n"
        "try: cli.main()\n"
        "except SystemExit: pass\n"
        f"print('HEAVY', [m for m in {HEAVY} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, "-", *arguments], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "HEAVY []"


def test_every_choice_composes():
    for group in GROUPS:
        for name in choices(group):
            compose([f"{group}={name}"])


def test_level_follows_the_track_unless_chosen():
    levels = {env: compose([f"env={env}"]).level.name for env in choices("env")}
    assert levels == {"forest": "2", "split_s": "split_s", "split_s_cpc": "none"}
    assert compose(["env=split_s", "level=none"]).level.name == "none"


def test_baseline_brings_its_reward_and_observation_unless_chosen():
    song = compose(["baseline=song"])
    assert (song.reward.name, song.observation.name) == ("progress", "song")
    assert compose(["observation=blind", "baseline=song"]).observation.name == "blind"


def test_ablations_differ_from_srl_in_one_weight():
    srl = to_dict(compose([]).reward)
    for name, weight in (("no_safety", "safety"), ("no_terminal", "time")):
        other = to_dict(compose([f"reward={name}"]).reward)
        assert {key for key in srl if srl[key] != other[key]} == {"name", weight}


def test_hydra_reads_back_exactly_what_was_checked():
    words = check_arguments(["name=null", "seed=1_0", "algo.learning_rate=1E-4", "level=1"]).overrides
    assert words == ("++name='null'", "++seed=10", "++algo.learning_rate=0.0001", "level='1'")
    assert compose(["name=null"]).name == "null"


def test_completion():
    assert completion.complete_override("rew") == ["reward=", *(f"reward.{w}=" for w in to_dict(compose([]).reward))]
    assert completion.complete_override("env=for") == ["env=forest"]
    assert completion.complete_override("algo.activation=r") == ["algo.activation=relu"]
    assert completion.complete_override("nonsense=") == []
    assert completion.complete_experiment("pap") == ["paper"]
    assert completion.complete_suite("level1-wind")[-1] == "level1-wind5"
    assert "level1" in completion.complete_suite("level1")
    assert completion.quietly(lambda _: 1 / 0)("x") == []


@pytest.mark.parametrize(
    ("words", "cursor", "answer"),
    [
        ("srlrace train env = for", "4", "forest"),
        ("srlrace train env =", "3", "forest\nsplit_s\nsplit_s_cpc"),
        ("srlrace train seed = 1 observation = bl", "7", "blind"),
        ("srlrace train obs", "2", "observation=\nobservation.name="),
        ("srlrace swe", "1", "sweep"),
    ],
)
def test_completion_as_bash_asks(words, cursor, answer, place):
    environment = {**os.environ, "_SRLRACE_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": cursor}
    command = [sys.executable, "-m", "srlrace"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.strip().startswith(answer)


def test_what_files_say_cannot_steer_the_terminal():
    assert clean("a\x1b[2Jb\u202ec\nd") == "a\ufffd[2Jb\ufffdc\ufffdd"


def test_jobs_of_a_multirun_are_counted():
    jobs = hydra_bridge.expand(check_arguments(["-m", "seed=0,1,2", "reward=srl,paper", "name=x"]))
    assert len(jobs) == 6
    assert all("++name='x'" in job for job in jobs)


@pytest.mark.parametrize("wrapped", [False, True])
def test_ctrl_c_is_one_also_within_compiled_code(place, monkeypatch, capsys, wrapped):
    """CPython makes an error of its own of what a handler raises there."""

    def interrupted(_):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as stop:
            if wrapped:
                raise SystemError("<a dispatcher> returned a result with an exception set") from stop
            raise

    monkeypatch.setattr("srlrace.bench.run", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run in the background
    try:
        assert run(monkeypatch, "bench") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err == "stopped; the same command starts anew, and leaves nothing half done\n"


@pytest.mark.parametrize(("status", "tidied"), [(130, False), (143, False), (2, True), (0, True)])
def test_a_process_that_was_stopped_leaves_without_tidying_up(status, tidied):
    """What it was stopped in may be half made, and crash it then."""
    code = (
        "import atexit, sys; from srlrace import __main__, cli; atexit.register(print, 'tidied')\n"
        f"cli.main = lambda: (print('said'), sys.exit({status})); __main__.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == status, done.stderr
    assert done.stdout.split() == ["said", "tidied"][: 1 + tidied]


def test_ctrl_c_while_it_leaves_changes_nothing():
    code = (
        "import signal, sys; from srlrace import __main__, cli\n"
        "class Stubborn:\n    def flush(self): signal.raise_signal(signal.SIGINT)\n"
        "def stop(): sys.stdout = Stubborn(); sys.exit(130)\n"
        "cli.main = stop; __main__.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "")
