"""Published runs say what the runs themselves say, in less room."""

from itertools import pairwise

import pytest

from srlrace.report.collect import collect
from srlrace.report.publish import publish, thinned
from srlrace.runs import RunFolder


def test_a_published_run_has_the_episodes_of_the_run(lab, tmp_path):
    times = [9.5, None, *[10.0 + i / 7 for i in range(200)]]
    path = lab.write_run(tmp_path / "runs", lab.compose(("env=forest",)), {"train_map": times, "level2": times})
    (path / "progress.csv").write_text("steps\n" + "".join(f"{step}\n" for step in range(9)))
    for stray in ("lock", "eval/level2/trajectories.mcap"):
        (path / stray).write_bytes(b"stays behind")
    run, target = RunFolder(path), tmp_path / "published" / path.name
    publish(run, target)
    [ours], problems = collect(tmp_path / "runs")
    [published], no_problems = collect(tmp_path / "published")
    assert problems == no_problems == ()
    assert ours.evaluations.keys() == published.evaluations.keys() == {"train_map", "level2"}
    for suite in ours.evaluations:
        assert RunFolder(target).episodes(suite) == run.episodes(suite)
        assert published.evaluations[suite].time_s == pytest.approx(ours.evaluations[suite].time_s, nan_ok=True)
    files = {file.relative_to(target).as_posix() for file in target.rglob("*") if file.is_file()}
    tables = {f"eval/{suite}/{name}" for suite in ours.evaluations for name in ("summary.json", "episodes.csv.gz")}
    assert files == {"config.json", "run.json", "progress.csv", "policy.safetensors"} | tables
    before = (target / "eval" / "level2" / "episodes.csv.gz").read_bytes()
    publish(run, target)
    assert (target / "eval" / "level2" / "episodes.csv.gz").read_bytes() == before


@pytest.mark.parametrize(("rows", "kept"), [(1, 1), (100, 100), (101, 51), (1000, 100)])
def test_a_learning_curve_is_thinned_once_and_ends_where_it_ended(rows, kept):
    progress = [b"%d,0.5\n" % step for step in range(1, rows + 1)]
    header, *left = (once := thinned(b"".join([b"steps,success_ratio\n", *progress]))).splitlines(keepends=True)
    assert (header, left[-1], len(left)) == (b"steps,success_ratio\n", progress[-1], kept)
    steps = [int(row.split(b",")[0]) for row in left]
    assert len({b - a for a, b in pairwise(steps)}) <= 1
    assert thinned(once) == once
