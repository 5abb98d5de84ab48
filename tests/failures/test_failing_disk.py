"""Every single operation on files fails once, with every error: one line, nothing broken, repeating completes it."""

from __future__ import annotations

import errno
import os
import resource
import shutil
import subprocess
import sys
from contextlib import suppress

import pytest
from faults import ERRORS, Faults
from invariants import check_root, leftovers, results
from kinds import words
from soak import SOAKED

from srlrace import cli

SHORT = words("short")


@pytest.fixture
def command(monkeypatch, capfd):
    """A command in this process: its exit status and what it said on stderr."""

    def run(*words_) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["srlrace", *map(str, words_)])
        try:
            cli.main()
            status = 0
        except SystemExit as leaving:
            status = leaving.code or 0
        return status, capfd.readouterr().err

    return run


@pytest.fixture(autouse=True)
def save_often(monkeypatch):
    monkeypatch.setattr("srlrace.learn.train.SAVE_EVERY", 0.0)


def phases(root, out):
    """What is done to a run, one after the other: name, words, and the folder whose operations fail."""
    runs = ("--runs", root)
    return {
        "train": (("train", *SHORT, *runs), root),
        "eval": (("eval", "--episodes", "5", *runs), root),
        "report": (("report", *runs, "--format", "csv", "--out", out), out),
    }


def say_why(errors: str, code: int, root) -> None:
    """One line that names a path and the reason; progress lines may stand beside it."""
    lines = [line for line in errors.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, errors
    assert "Traceback" not in errors
    assert os.strerror(code) in lines[0], errors
    assert str(root) in lines[0], errors


@pytest.fixture(scope="module")
def complete(tmp_path_factory):
    """The same commands on a disk that does not fail."""
    place = tmp_path_factory.mktemp("complete")
    with pytest.MonkeyPatch.context() as patch:
        for words_, _ in phases(place / "runs", place / "out").values():
            patch.setattr(sys, "argv", ["srlrace", *map(str, words_)])
            with suppress(SystemExit):
                cli.main()
    [folder] = (place / "runs").iterdir()
    assert (folder / "eval" / "train_map" / "summary.json").exists()
    return place


@pytest.mark.parametrize("phase", ["train", "eval", "report"])
def test_the_nth_operation_fails(command, complete, tmp_path, phase, chance, much, say):
    """For n = 1, 2, 3, ... until the command ends without reaching it."""
    reference, before = tmp_path / "reference", complete
    for folder in ("runs", "out"):
        shutil.copytree(before / folder, reference / folder)
    [expected] = [results(folder) for folder in (reference / "runs").iterdir()]
    failing, reached, kinds = 1, True, set()  # a few of them in the default tests, other ones every time
    stride = much(10, 1)
    while reached:
        for code in ERRORS if SOAKED else ERRORS[failing % 3 : failing % 3 + 1]:
            place = tmp_path / f"{failing}-{code}"
            prepare(place, reference, phase)
            words_, watched = phases(place / "runs", place / "out")[phase]
            watched.mkdir(exist_ok=True, parents=True)
            with Faults(watched, failing, code) as faults:
                status, errors = command(*words_)
            reached = faults.reached
            check_root(place / "runs")
            assert contents(place / "out").items() <= contents(reference / "out").items()
            if reached:
                kinds.add(faults.log[failing - 1].split()[0])
                assert status != 0, (faults.log[failing - 1], errors)
                say_why(errors, code, watched)
            assert command(*words_)[0] == 0
            [found] = [results(folder) for folder in (place / "runs").iterdir()]
            assert found == (expected if phase != "train" else {k: v for k, v in expected.items() if "/" not in k})
            assert leftovers(place / "runs") == []
            if phase == "report":
                assert contents(place / "out") == contents(reference / "out")
            shutil.rmtree(place)
        failing += chance.randrange(1, 2 * stride)
    say(f"{phase}: {failing - 2} operations, each failed with {3 if SOAKED else 1} errors: {', '.join(sorted(kinds))}")
    assert len(kinds) > 1


def prepare(place, reference, phase) -> None:
    """The state before a phase."""
    place.mkdir()
    if phase != "train":
        shutil.copytree(reference / "runs", place / "runs")
    if phase == "eval":
        for folder in (place / "runs").glob("*/eval"):
            shutil.rmtree(folder)


def contents(folder) -> dict[str, bytes]:
    """What a report wrote: tables and figures, each whole or not there."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files if not path.name.startswith(".")}


def test_a_full_disk(zygote, complete, tmp_path, chance, much, say):
    """A small file system in memory where that can be mounted, else a limit to the size of files."""
    [expected] = [results(folder) for folder in (complete / "runs").iterdir()]
    failed = 0
    for index in range(much(2, 10)):
        size = 16 * 1024 * (index + 1) if index else 4096
        place = tmp_path / f"disk{index}"
        place.mkdir()
        mounted = mount(place, size)
        if not mounted:
            pytest.skip("no file system can be mounted here")
        try:
            out = tmp_path / f"out{index}"
            runs = ("--runs", place / "runs")
            calls = (["train", *SHORT, *runs], ["eval", "--episodes", "5", *runs])
            options = {"set": {"srlrace.learn.train:SAVE_EVERY": 0.0}}
            statuses = [zygote.run(call, out=out, **options).status for call in calls]
            check_root(place / "runs")
            said = [line for line in out.read_text().splitlines() if line.startswith("error: ")]
            if statuses != [0, 0]:
                failed += 1
                assert "Traceback" not in out.read_text()
                assert "No space left on device" in said[0]
                assert str(place) in said[0]
            subprocess.run(["mount", "-o", "remount,size=64m", place], check=True)
            assert [zygote.run(call, out=out, **options).status for call in calls] == [0, 0], out.read_text()
            [folder] = [path for path in (place / "runs").iterdir() if not path.name.startswith(".")]
            assert results(folder) == expected
        finally:
            subprocess.run(["umount", place], check=True)
    say(f"{failed} of {index + 1} disks were too small; all ended the same once there was room")
    assert failed


def mount(place, size) -> bool:
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    return os.geteuid() == 0 and subprocess.run(command, capture_output=True, check=False).returncode == 0


def test_files_that_may_not_grow(zygote, complete, tmp_path, much, say):
    """A limit to the size of files, as quotas and shells set it: the write that crosses it fails."""
    [expected] = [results(folder) for folder in (complete / "runs").iterdir()]
    failed = 0
    for index in range(much(3, 10)):
        place = tmp_path / str(index)
        place.mkdir()
        runs, out = ("--runs", place / "runs"), place / "out"
        calls = (["train", *SHORT, *runs], ["eval", "--episodes", "5", *runs])
        limit = 1500 * 2**index
        process = zygote.start(calls[0], calls[1], out=out, file_limit=limit)
        status = zygote.wait(process).status
        if (place / "runs").exists():
            check_root(place / "runs")
        if status:
            failed += 1
            assert "Traceback" not in out.read_text()
            assert os.strerror(errno.EFBIG) in out.read_text()
        assert [zygote.run(call, out=out).status for call in calls] == [0, 0], out.read_text()
        [folder] = [path for path in (place / "runs").iterdir() if not path.name.startswith(".")]
        assert results(folder) == expected
    say(f"{failed} of {index + 1} limits were too small; all ended the same without them")
    assert failed
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
