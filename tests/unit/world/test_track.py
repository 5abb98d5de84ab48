"""Order of waypoints, and tracks read from a user's file."""

from dataclasses import replace
from pathlib import Path

import pytest

from srlrace.config import TrackConfig
from srlrace.world.track import MAX_TRACK_BYTES, load_track, target_sequence


def test_course_and_laps(forest: TrackConfig, split_s: TrackConfig) -> None:
    assert target_sequence(forest) == tuple(range(9))
    assert target_sequence(split_s) == (0, 1, 2, 3, 4, 5, 6, 0)
    assert target_sequence(replace(split_s, laps=2)) == (*range(7), *range(7), 0)


def test_track_file_gets_defaults(tmp_path: Path) -> None:
    file = tmp_path / "garden.yaml"
    file.write_text("defaults: [override /level: none]\nwaypoints: [[0, 0, 1]]\n")
    assert load_track(file) == {"name": "garden", "laps": 0, "horizon": 20.0, "waypoints": [[0, 0, 1]]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n- 2\n", "mapping"),
        ("a: [1", "not valid YAML"),
        ("\x00", "not valid YAML"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
        ("[" * 5000, "not valid YAML"),
        ("a: 1\n" * (MAX_TRACK_BYTES // 5 + 1), "larger than"),
        ("", "mapping"),
    ],
)
def test_bad_track_file_is_explained(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_track(file)


def test_missing_track_file_is_explained(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot read"):
        load_track(tmp_path / "none.yaml")
    with pytest.raises(ValueError, match="cannot read"):
        load_track(tmp_path)
