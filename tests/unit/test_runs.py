"""Run folders: state follows from files and a lock that dies with its holder; hostile folders do no harm."""

import gzip
import hashlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import pytest

from srlrace.config import to_dict
from srlrace.files import FileError, atomic_write, read_json, read_limited, read_packed, write_sealed
from srlrace.hydra_bridge import compose
from srlrace.runs import RunError, RunFolder, State, find, latest_finished, list_runs, provenance, runs_root
from srlrace.tables import brief, runs_table, runs_text

CONFIG = json.dumps(to_dict(compose([])))


def make(root, name, *files) -> RunFolder:
    folder = root / name
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(CONFIG)
    for file in files:
        (folder / file).write_bytes(b"x")
    return RunFolder(folder)


def test_state_follows_from_the_files(tmp_path):
    assert RunFolder(tmp_path / "none").state is State.NEW
    assert make(tmp_path, "a").state is State.INTERRUPTED
    assert make(tmp_path, "b", "error.txt").state is State.FAILED
    assert make(tmp_path, "c", "error.txt", "policy.safetensors").state is State.FINISHED
    run = make(tmp_path, "d")
    with run.lock():
        assert run.state is State.TRAINING
    assert run.state is State.INTERRUPTED


HOLD = """
import sys, time
from pathlib import Path
from srlrace.runs import RunFolder
with RunFolder(Path(sys.argv[1])).lock():
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_killed_holder_frees_the_run_at_once(tmp_path):
    run = make(tmp_path, "a")
    with subprocess.Popen([sys.executable, "-c", HOLD, str(run.path)], stdout=subprocess.PIPE) as child:
        assert child.stdout.readline() == b"held\n"
        assert run.state is State.TRAINING
        with pytest.raises(RunError, match=rf"a is held by process {child.pid} on .* since \d{{4}}-"), run.lock():
            pass
        child.send_signal(signal.SIGKILL)
        child.wait()
    assert run.state is State.INTERRUPTED
    with run.lock():
        assert run.holder().startswith(f"process {os.getpid()} ")


def _compete(path, barrier, wins):
    barrier.wait()
    try:
        with RunFolder(path).lock():
            wins.put("won")
            time.sleep(1.5)
    except RunError as error:
        wins.put(str(error))


def test_of_eight_started_at_one_instant_one_trains(tmp_path):
    context = multiprocessing.get_context("fork")
    barrier, results = context.Barrier(8), context.Queue()
    children = [context.Process(target=_compete, args=(tmp_path / "runs" / "a", barrier, results)) for _ in range(8)]
    for child in children:
        child.start()
    words = [results.get(timeout=30) for _ in children]
    for child in children:
        child.join()
    assert words.count("won") == 1
    assert all("is held by" in word for word in words if word != "won")


def test_listing_does_not_keep_a_training_from_starting(tmp_path):
    run = make(tmp_path, "a")
    (run.path / "lock").touch()
    stop = multiprocessing.get_context("fork").Event()

    def look():
        while not stop.is_set():
            run.holder()

    child = multiprocessing.get_context("fork").Process(target=look)
    child.start()
    try:
        for _ in range(50):
            with run.lock():
                pass
    finally:
        stop.set()
        child.join()


def test_locking_a_read_only_place_says_so(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot write there"), RunFolder(tmp_path / "file" / "a").lock():
        pass


def test_find(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs"
    for name in ("forest-srl-s0-11111111", "forest-srl-s1-22222222", "split_s-srl-s0-33333333"):
        make(root, name)
    assert find(root, "split").id == "split_s-srl-s0-33333333"
    assert find(root, "forest-srl-s1-22222222").id == "forest-srl-s1-22222222"
    assert find(root, "runs/forest-srl-s0-11111111").id == "forest-srl-s0-11111111"
    with pytest.raises(RunError, match="ambiguous: forest-srl-s0-11111111, forest-srl-s1-22222222"):
        find(root, "forest")
    with pytest.raises(RunError, match="closest: forest-srl-s1-22222222"):
        find(root, "forest-slr-s1-2222222")
    for query in ("", "../runs", "nothing", "\x1b[2J"):
        with pytest.raises(RunError, match="no run"):
            find(root, query)
    monkeypatch.chdir(root / "split_s-srl-s0-33333333")
    assert find(root, ".").id == "split_s-srl-s0-33333333"


def test_latest_finished(tmp_path):
    with pytest.raises(RunError, match="no finished run"):
        latest_finished(tmp_path)
    old, new = make(tmp_path, "b", "policy.safetensors"), make(tmp_path, "a", "policy.safetensors")
    make(tmp_path, "c")
    os.utime(old.path / "policy.safetensors", (1, 1))
    assert latest_finished(tmp_path).id == new.id


def test_hostile_folders_are_passed_over_or_read_as_empty(tmp_path):
    root = tmp_path / "runs"
    secret = tmp_path / "secret"
    secret.mkdir()
    (secret / "run.json").write_text('{"secret": 1}')
    (secret / "config.json").write_text(CONFIG)
    (secret / "summary.json").write_text('{"secret": 1}')
    run = make(root, "a")
    (run.path / "run.json").symlink_to(secret / "run.json")
    (run.path / "eval").mkdir()
    (run.path / "eval" / "train_map").symlink_to(secret)
    (run.path / "progress.csv").symlink_to("/dev/zero")
    os.mkfifo(run.path / "lock")
    (root / "link").symlink_to(secret)
    (root / "bad\x1bname").mkdir()
    (root / "bad\x1bname" / "config.json").write_text(CONFIG)
    (root / "half").mkdir()
    make(root, "broken")
    (root / "broken" / "config.json").write_text('{"seed": ')
    assert [found.id for found in list_runs(root)] == ["a", "broken"]
    assert run.info == {} == run.evaluations
    assert run.progress == {}
    assert run.state is State.INTERRUPTED
    assert RunFolder(root / "broken").config is None
    with pytest.raises(RunError, match="not followed"):
        run.file("eval", "train_map", "summary.json")
    assert list_runs(tmp_path / "nowhere") == []


def test_progress_is_the_last_complete_row(tmp_path):
    run = make(tmp_path, "a")
    rows = "".join(f"{i},{i / 10},\n" for i in range(20_000))
    (run.path / "progress.csv").write_text(f"steps,success_ratio,time_s\n{rows}20000,0.")
    assert run.progress == {"steps": 19_999.0, "success_ratio": 1999.9}
    (run.path / "progress.csv").write_text("steps,success_ratio\n")
    assert run.progress == {}


def test_runs_root(monkeypatch):
    monkeypatch.delenv("SRLRACE_RUNS", raising=False)
    assert str(runs_root()) == "runs"
    monkeypatch.setenv("SRLRACE_RUNS", "/elsewhere")
    assert str(runs_root()) == "/elsewhere"
    assert str(runs_root("/given")) == "/given"


def test_atomic_write_leaves_the_old_file_or_the_new(tmp_path, monkeypatch):
    path = tmp_path / "file"
    atomic_write(path, "old")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OSError, match="No space"):
        atomic_write(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_reading_is_limited_to_plain_small_files(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_limited(path, 5) == b"12345"
    os.mkfifo(tmp_path / "pipe")
    for bad, limit in ((path, 4), (tmp_path, 5), (tmp_path / "pipe", 5), (tmp_path / "none", 5)):
        with pytest.raises(FileError, match="cannot read"):
            read_limited(bad, limit)
    path.write_text('{"a": [1, 2]}')
    assert read_json(path) == {"a": [1, 2]}


def test_provenance_is_plain_json():
    record = json.loads(json.dumps(provenance(["srlrace", "train"])))
    assert record["argv"] == ["srlrace", "train"]
    assert provenance(["srlrace", "train", "--runs", "/home/me/runs", "seed=1"])["argv"] == [
        "srlrace",
        "train",
        "seed=1",
    ]
    assert provenance(["srlrace", "train", "seed=1", "--runs=/home/me"])["argv"] == ["srlrace", "train", "seed=1"]
    assert {"srlrace", "python", "torch", "numpy"} <= record["versions"].keys()
    assert record["cores"] >= 1


def test_a_long_list_says_what_a_short_one_does(tmp_path):
    runs = [make(tmp_path, "a"), make(tmp_path, "bb", "policy.safetensors")]
    runs[1].file("progress.csv").write_text("steps,success_ratio,crash_ratio\n12500000,0.5,0.25\n")
    table = runs_table(runs)
    cells = [[cell.plain for cell in column._cells] for column in table.columns]
    lines = runs_text(runs).splitlines()
    assert [line.split("  ")[0].strip() for line in lines] == cells[0]
    for line, row in zip(lines, zip(*cells, strict=True), strict=True):
        assert [word.strip() for word in line.split("  ") if word.strip()] == list(row)


def evaluated(root, table=b"episode\n0\n", summary_of=None):
    """A run with an evaluation, its summary sealed over ``summary_of`` and written last."""
    run = make(root, "a", "policy.safetensors")
    (run.path / "eval" / "train_map").mkdir(parents=True)
    run.file("eval", "train_map", "episodes.csv").write_bytes(table)
    digest = hashlib.sha256(table if summary_of is None else summary_of).hexdigest()
    write_sealed(run.file("eval", "train_map", "summary.json"), {"episodes": 1, "episodes_sha256": digest})
    return run


def test_a_list_reads_no_table_that_is_older_than_its_summary(tmp_path, monkeypatch):
    run = evaluated(tmp_path)
    assert run.results == run.evaluations != {}
    monkeypatch.setattr(RunFolder, "episodes", None)
    assert list(run.results) == ["train_map"]


def test_a_list_leaves_out_the_summary_of_another_table(tmp_path):
    """An evaluation that was repeated and killed before its summary: the new table is younger than the old summary."""
    run = evaluated(tmp_path, summary_of=b"another")
    assert run.evaluations == {}
    table, summary = (run.file("eval", "train_map", name) for name in ("episodes.csv", "summary.json"))
    os.utime(table, ns=(0, summary.stat().st_mtime_ns + 1))
    assert run.results == {}
    table.unlink()
    assert run.results == {}


def test_a_packed_table_is_read_where_there_is_no_other(tmp_path):
    run = evaluated(tmp_path)
    plain, packed = (run.file("eval", "train_map", name) for name in ("episodes.csv", "episodes.csv.gz"))
    whole = gzip.compress(plain.read_bytes())
    packed.write_bytes(gzip.compress(b"an older evaluation's\n"))
    assert run.table("train_map") == plain
    plain.unlink()
    with pytest.raises(RunError, match="damaged"):
        run.episodes("train_map")
    packed.write_bytes(whole)
    os.utime(packed, ns=(0, 0))
    assert run.episodes("train_map") == b"episode\n0\n"
    assert list(run.evaluations) == list(run.results) == ["train_map"]


@pytest.mark.parametrize(
    ("packed", "reason"),
    [
        (b"no gzip", "not a whole gzip file"),
        (gzip.compress(b"a" * 1000)[:-9], "not a whole gzip file"),
        (b"\x1f\x8b\x08\x00" + bytes(6) + b"\xff\xff", "not a whole gzip file"),
        (gzip.compress(bytes(1001)), "larger than 1000 bytes when unpacked"),
    ],
)
def test_a_packed_table_cannot_be_anything(tmp_path, packed, reason):
    path = tmp_path / "episodes.csv.gz"
    path.write_bytes(packed)
    with pytest.raises(FileError, match=reason):
        read_packed(path, 1000)


def test_no_time_is_shown_where_no_flight_finished():
    assert brief("level3", {"episodes": 1000, "outcomes": {}, "time_mean_s": None}) == "level3 0/1000"
    assert brief("level3", {"episodes": 9, "outcomes": {"finished": 8}, "time_mean_s": 5}) == "level3 8/9 in 5.00 s"
