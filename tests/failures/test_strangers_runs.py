"""A corpus of hostile runs through every command: nothing is executed, told, written elsewhere, or blown up."""

from __future__ import annotations

import os
import shutil

import pytest
from hostile import SECRET, SUITE, VARIABLE, attacks
from kinds import words

ATTACKS = dict(attacks())
SHARE = 7  # one attack of so many is tried in the default tests, other ones every time
MORE_MEMORY = 500 * 2**20  # bytes over what a genuine run takes
MORE_TIME = 5.0  # s of CPU, likewise
SKIPPED = ("genuine",)


def commands(run, place) -> list[list]:
    """All that may be done with a stranger's run, looking first and resuming last."""
    out, runs = place / "out", ["--runs", run.parent]
    return [
        ["runs", *runs],
        ["show", run],
        ["report", *runs, "--format", "md", "--out", out],
        ["report", *runs, "--format", "tex"],
        ["report", *runs, "--format", "html", "--out", out],
        ["replay", run, "--out", out / "replay.html"],
        ["export", run, "--to", "sb3", "--out", out / "policy.zip"],
        ["export", run, "--to", "onnx", "--out", out / "policy.onnx"],
        ["recover", run / SUITE / "trajectories.mcap.part"],
        ["eval", run, "--episodes", "3", "--record", "all"],
        ["resume", run],
    ]


@pytest.fixture(scope="module")
def stranger(zygote, tmp_path_factory):
    """A genuine run, finished and evaluated, with checkpoints."""
    place = tmp_path_factory.mktemp("stranger")
    runs = ("--runs", place / "runs")
    calls = (["train", *words("short"), *runs], ["eval", "--episodes", "3", *runs])
    assert zygote.run(*calls, out=place / "out", set={"srlrace.learn.train:SAVE_EVERY": 0.0}).status == 0
    [folder] = (place / "runs").iterdir()
    part = folder / SUITE / "trajectories.mcap.part"
    part.write_bytes((folder / SUITE / "trajectories.mcap").read_bytes()[:-100])
    return folder


def meet(zygote, stranger, place, name):
    """Do everything with the folder that an attack made; returns how that ended and what was said."""
    run, outside = place / "runs" / stranger.name, place / "outside"
    shutil.copytree(stranger, run)
    outside.mkdir()
    (place / "out").mkdir()
    for victim in ("victim", "victim.json", "victim.safetensors", "trajectories.mcap", "episodes.csv", "summary.json"):
        (outside / victim).write_text("precious")
    ATTACKS[name](run, outside)
    before = {path.name: path.read_bytes() for path in outside.iterdir()}
    ended = zygote.run(*commands(run, place), out=place / "said", cwd=run, env={VARIABLE: SECRET}, guarded=True)
    assert {path.name: path.read_bytes() for path in outside.iterdir()} == before
    assert sorted(path.name for path in place.iterdir()) == ["out", "outside", "runs", "said"]
    assert not list(place.rglob("canary*"))
    said = (place / "said").read_text(errors="replace")
    for path in [place / "said", *(place / "out").rglob("*.*")]:
        assert SECRET.encode() not in path.read_bytes(), path
    return ended, said


@pytest.fixture(scope="module")
def genuine(zygote, stranger, tmp_path_factory):
    """What the same commands take for a run without malice."""
    return meet(zygote, stranger, tmp_path_factory.mktemp("genuine"), "genuine")


def test_a_genuine_run_passes_them_all(genuine):
    _, said = genuine
    assert "Traceback" not in said


@pytest.mark.parametrize("part", range(SHARE))
def test_hostile_runs_do_no_harm(zygote, stranger, genuine, tmp_path, chance, much, say, part):
    names = [name for name in ATTACKS if name not in SKIPPED][part::SHARE]
    chosen = chance.sample(names, much(1, len(names)))
    peak = seconds = 0.0
    for index, name in enumerate(chosen):
        place = tmp_path / str(index)
        place.mkdir()
        ended, said = meet(zygote, stranger, place, name)
        assert ended.status in (0, 1, 2), (name, said)
        assert "Traceback" not in said, (name, said)
        assert "\x1b" not in said, name
        assert "\x9b" not in said, name
        for page in (place / "out").glob("*.html"):
            assert "<script>alert(1)" not in page.read_text(), (name, page.name)
        more = ended.peak - genuine[0].peak
        assert more < MORE_MEMORY, (name, more)
        assert ended.seconds - genuine[0].seconds < MORE_TIME, (name, ended.seconds)
        peak, seconds = max(peak, more / 2**20), max(seconds, ended.seconds - genuine[0].seconds)
        for path in (place / "runs").rglob("*"):
            if path.is_fifo() or (path.is_file() and path.stat().st_size > 2**30):
                os.unlink(path)  # noqa: PTH108
        shutil.rmtree(place)
    say(f"{len(chosen)} hostile runs: at most {peak:+.0f} MiB and {seconds:+.2f} s beside a genuine one")
