"""Random settings, track files, run folders and recordings: the documented errors, and nothing else."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager

import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rich.console import Console
from soak import SOAKED

from srlrace.catalogue import GROUPS, SETTINGS, choices
from srlrace.config import Config, parse_config, to_dict
from srlrace.hydra_bridge import compose
from srlrace.overrides import check_arguments
from srlrace.own_track import track_overrides
from srlrace.parse import ConfigError
from srlrace.recording import CorruptRecording, read_episodes, read_flight, read_metadata, read_states, recover
from srlrace.report.collect import collect
from srlrace.runs import RunError, list_runs
from srlrace.tables import run_page, runs_table

NAMES = st.sampled_from([*SETTINGS, *GROUPS, "hydra.run.dir", "hydra/launcher", "_target_", "+x", "~seed", "--cfg", ""])
WORDS = st.one_of(
    st.sampled_from(["1", "-1", "1e400", "nan", "true", "[1,2]", "{a:1}", "${seed}", "1,2", "''", "!!x", "../x", "@"]),
    st.sampled_from([name for group in GROUPS for name in choices(group)]),
    st.text(max_size=12),
)
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


def examples(small: int, full: int):
    """So many examples, which may be slow on a busy machine."""
    return settings(max_examples=full if SOAKED else small, deadline=None,
                    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])  # fmt: skip


@contextmanager
def in_one_line() -> Iterator[None]:
    """Whatever is refused is refused in one line."""
    said = ""
    try:
        yield
    except (ConfigError, RunError) as error:
        said = str(error)
    assert "\n" not in said


@given(st.lists(st.tuples(NAMES, WORDS), max_size=3))
@examples(100, 5000)
def test_overrides_are_checked_or_refused(pairs):
    with in_one_line():
        check_arguments([f"{name}={word}" for name, word in pairs])


@given(st.lists(st.tuples(NAMES, WORDS), max_size=3))
@examples(10, 1000)
def test_overrides_compose_or_are_refused(pairs):
    with in_one_line():
        composed = compose([f"{name}={word}" for name, word in pairs])
        assert parse_config(json.loads(json.dumps(to_dict(composed)))) == composed


TRACK = {
    "waypoints": [[0, 0, 1], [5, 5, 2]],
    "start": [-5, 0, 1],
    "obstacles": [],
    "laps": 1,
    "bounds": [[-9] * 3, [9] * 3],
}


@given(st.dictionaries(st.sampled_from([*TRACK, "x"]), PLAIN, max_size=3), st.binary(max_size=30), st.booleans())
@examples(100, 5000)
def test_track_files_are_read_or_refused(tmp_path, changes, junk, binary):
    path = tmp_path / "track.yaml"
    path.write_bytes(junk if binary else yaml.safe_dump(TRACK | changes).encode())
    with in_one_line():
        list(track_overrides(str(path)))


@given(PLAIN, PLAIN, st.binary(max_size=60), st.dictionaries(st.sampled_from(list(to_dict(compose([])))), PLAIN))
@examples(12, 2000)
def test_run_folders_are_shown_or_passed_over(tmp_path, info, summary, junk, changes):
    folder = tmp_path / "runs" / "a-b-s0-00000000"
    (folder / "eval" / "train_map").mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(to_dict(compose([])) | changes))
    (folder / "run.json").write_text(json.dumps(info))
    (folder / "eval" / "train_map" / "summary.json").write_text(json.dumps(summary))
    for name in ("progress.csv", "eval/train_map/episodes.csv", "policy.safetensors", "lock"):
        (folder / name).write_bytes(junk)
    console = Console(file=io.StringIO(), width=200)
    console.print(runs_table(list_runs(tmp_path / "runs")))
    _, problems = collect(tmp_path / "runs")
    assert not any("\n" in problem for problem in problems)
    with in_one_line():
        for part in run_page(list_runs(tmp_path / "runs")[0]):
            console.print(part)


@given(PLAIN)
@examples(100, 5000)
def test_settings_are_parsed_or_refused(data):
    with in_one_line():
        assert isinstance(parse_config(data), Config)


def test_mutants_of_a_recording(zygote, tmp_path, chance, much, say):
    """Cut, flipped, moved, repeated: what can be read is what was written, or `CorruptRecording`."""
    from kinds import words

    runs = ("--runs", tmp_path / "runs")
    calls = (["train", *words("short"), *runs], ["eval", "--episodes", "3", *runs])
    assert zygote.run(*calls, out=tmp_path / "out").status == 0
    [path] = tmp_path.glob("runs/*/eval/*/trajectories.mcap")
    data, mutant, part = path.read_bytes(), tmp_path / "m.mcap", tmp_path / "m2.mcap.part"
    readers = (read_states, read_episodes, read_metadata, lambda file: read_flight(file, 1))
    truth, refused, count = [str(read(path)) for read in readers], 0, much(150, 2000)
    for _ in range(count):
        content = mutated(data, chance)
        mutant.write_bytes(content)
        part.write_bytes(content)
        for read, expected in zip(readers, truth, strict=True):
            try:
                assert str(read(mutant)) == expected
            except CorruptRecording:
                refused += 1
        try:
            read_states(recover(part))
            (tmp_path / "m2.mcap").unlink()
        except CorruptRecording:
            assert not (tmp_path / "m2.mcap").exists()
    say(f"{count} mutants of a recording, {refused} of {4 * count} readings refused, the others true")


def mutated(data: bytes, chance) -> bytes:
    copy = bytearray(data)
    for _ in range(chance.choice((1, 1, 1, 3))):
        place, length = chance.randrange(len(copy)), chance.choice((1, 8, 64, 4096))
        match chance.randrange(6):
            case 0:
                copy[place] ^= 1 << chance.randrange(8)
            case 1:
                copy[place : place + length] = os.urandom(length)
            case 2:
                del copy[place : place + length]
            case 3:
                copy[place:place] = copy[place : place + length]
            case 4:
                copy[place : place + 8] = chance.choice((b"\xff" * 8, bytes(8), b"\x00\x00\x00\x80" * 2))
            case _:
                del copy[place:]
        copy = copy or bytearray(b"\0")
    return bytes(copy)
