"""Where compiled kernels are kept, and when they are compiled anew."""

import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from srlrace.sim import compile as subject
from srlrace.sim.airframe import Airframe
from srlrace.sim.dynamics import advance

SECOND_PROCESS = """
import numpy as np
from srlrace.sim.dynamics import advance
state, command, plant = (np.zeros((k, 3), np.float32) for k in (17, 4, 4))
advance(state, command, plant, np.ones(16, np.float32), 0.02, 2)
print(sum(advance.stats.cache_hits.values()), sum(advance.stats.cache_misses.values()))
"""


def sources(root: Path, text: str) -> Path:
    (root / "sim").mkdir(exist_ok=True)
    (root / "sim" / "a.py").write_text(text)
    return root


def test_digest_follows_the_sources(tmp_path: Path) -> None:
    first = subject.source_digest(sources(tmp_path, "x = 1"), ("sim",))
    assert subject.source_digest(sources(tmp_path, "x = 1"), ("sim",)) == first
    assert subject.source_digest(sources(tmp_path, "x = 2"), ("sim",)) != first


def test_folder_others_can_write_to_is_not_used(tmp_path: Path) -> None:
    folder = tmp_path / "open"
    assert subject.private_folder(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    assert not subject.private_folder(folder)


def test_unusable_folder_falls_back_to_a_temporary_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("not a folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    folder = Path(subject.cache_folder.__wrapped__("sim"))
    assert folder.is_dir()
    assert tmp_path not in folder.parents


def test_second_process_compiles_nothing(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", SECOND_PROCESS]
    root = Path(subject.__file__).parents[2]
    counts = [
        subprocess.run(command, env=environment, cwd=root, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert counts == [["0", "1"], ["1", "0"]]


def test_advance_works_inside_another_kernel(airframe: Airframe) -> None:
    @numba.njit
    def two_periods(state, command, plant, constants):  # type: ignore[no-untyped-def]
        for _ in range(2):
            advance(state, command, plant, constants, 0.02, 8)

    state, command, plant = np.ones((17, 5)), np.ones((4, 5)), np.ones((4, 5))
    expected = state.copy()
    two_periods(state, command, plant, airframe.pack(np.float64))
    for _ in range(2):
        advance(expected, command, plant, airframe.pack(np.float64), 0.02, 8)
    np.testing.assert_array_equal(state, expected)


def test_kernels_of_sources_long_gone_are_removed(tmp_path: Path) -> None:
    folders = [tmp_path / f"kernels-task-{number:016x}" for number in range(subject.KEPT + 3)]
    others = [tmp_path / name for name in ("kernels-sim-0123456789abcdef", "kernels-task-mine", "elsewhere")]
    for age, folder in enumerate([*others, *folders]):
        folder.mkdir()
        (folder / "kernel.nbi").touch()
        os.utime(folder, (age, age))
    (tmp_path / "kernels-task-fedcba9876543210").symlink_to(others[2])
    subject.keep_newest(folders[0])  # in use again: now the newest
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {path.name for path in (*others, folders[0], *folders[4:])} | {"kernels-task-fedcba9876543210"}
    assert (others[2] / "kernel.nbi").exists()
