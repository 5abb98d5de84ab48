"""A snapshot from a stranger cannot make the kernels read outside of their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from srlrace.hydra_bridge import compose
from srlrace.task.race import Race, RaceMode


@pytest.fixture(scope="module")
def race() -> Race:
    race = Race(compose(["level=none"]), RaceMode.training(0, 16))
    race.reset()
    for _ in range(30):
        race.step(np.zeros((16, 4), np.float32))
    return race


def test_its_own_snapshot_is_taken(race: Race) -> None:
    race.restore(race.snapshot())


@pytest.mark.parametrize("value", [-1, 9, 2**31 - 1])
@pytest.mark.parametrize("name", ["fleet.target", "fleet.map", "fleet.first_target"])
def test_an_index_out_of_range_is_refused(race: Race, name: str, value: int) -> None:
    snapshot = race.snapshot()
    snapshot[name][3] = value
    before = race.snapshot()
    with pytest.raises(ValueError, match=name):
        race.restore(snapshot)
    for key, array in race.snapshot().items():
        np.testing.assert_array_equal(array, before[key])


@pytest.mark.parametrize(("column", "value"), [(-1, 1.0), (-1, -1.0), (-1, np.nan), (-2, 1e9), (-2, np.inf)])
def test_a_remembered_passing_out_of_range_is_refused(race: Race, column: int, value: float) -> None:
    snapshot = race.snapshot()
    snapshot["memory.count"][2] = 1
    snapshot["memory.record"][2, 0, column] = value
    with pytest.raises(ValueError, match=r"memory\.record"):
        race.restore(snapshot)


@pytest.mark.parametrize("name", ["hard", "trail"])
@pytest.mark.parametrize(("column", "value"), [(-1, 9.0), (-1, -1.0), (-1, np.nan), (-2, 1.0), (-3, 1e9)])
def test_where_a_crash_began_out_of_range_is_refused(name: str, column: int, value: float) -> None:
    race = Race(compose(["level=none", "curriculum.hard_starts=0.4"]), RaceMode.training(0, 16))
    race.reset()
    snapshot = race.snapshot()
    race.restore(snapshot)
    snapshot["memory.hards"][0] = 1
    snapshot[f"memory.{name}"][..., column] = value
    with pytest.raises(ValueError, match=r"memory\.hard"):
        race.restore(snapshot)


def test_a_negative_count_is_refused(race: Race) -> None:
    snapshot = race.snapshot()
    snapshot["memory.count"][0] = -3
    with pytest.raises(ValueError, match=r"memory\.count"):
        race.restore(snapshot)
