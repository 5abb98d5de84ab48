"""Drones share registers, never results."""

import re
from collections.abc import Callable

import numba
import numpy as np
import pytest
from numba.core.errors import TypingError
from numpy.typing import NDArray

from srlrace.sim.airframe import Airframe
from srlrace.sim.compile import FASTMATH
from srlrace.sim.dynamics import advance
from srlrace.sim.vector import REGISTER_BYTES

Array = NDArray[np.float64]
Fly = Callable[..., Array]
Draw = Callable[[int, int], Array]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 7, 8, 15, 16, 17, 100])
def test_result_does_not_depend_on_the_number_of_drones(
    fly: Fly, random_states: Draw, random_commands: Draw, n: int, dtype: type
) -> None:
    start, command = random_states(1000, 1), random_commands(1000, 2)
    together = fly(start, command, steps=10, dtype=dtype)
    for first in (0, 3, 1000 - n):
        part = slice(first, first + n)
        alone = fly(start[:, part], command[:, part], steps=10, dtype=dtype)
        np.testing.assert_array_equal(alone, together[:, part])


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("row", range(21))
def test_non_finite_drone_is_seen_and_stays_alone(
    fly: Fly, random_states: Draw, random_commands: Draw, row: int, poison: float
) -> None:
    start, command, sick = random_states(40, 3), random_commands(40, 4), 21
    healthy = fly(start, command, steps=2, dtype=np.float32)
    (start if row < 17 else command)[row if row < 17 else row - 17, sick] = poison
    flown = fly(start, command, steps=2, dtype=np.float32)
    others = np.arange(40) != sick
    np.testing.assert_array_equal(flown[:, others], healthy[:, others])
    if row < 17 or np.isnan(poison):  # an infinite command is only a saturated one
        assert not np.isfinite(flown[:, sick]).all()


def test_attitude_of_zeros_is_seen_as_non_finite(fly: Fly, random_states: Draw, random_commands: Draw) -> None:
    start = random_states(3, 5)
    start[6:10, 1] = 0
    finite = np.isfinite(fly(start, random_commands(3, 6)))
    np.testing.assert_array_equal(finite.all(axis=0), [True, False, True])


def test_kernel_writes_only_the_state(random_states: Draw, random_commands: Draw, airframe: Airframe) -> None:
    state, command, plant = random_states(5, 7), random_commands(5, 8), np.full((4, 5), 0.5)
    packed = airframe.pack(np.float64)
    copies = command.copy(), plant.copy(), packed.copy()
    padded = np.full((19, 5), 7.0)
    padded[1:18] = state
    advance(padded[1:18], command, plant, packed, 0.02, 8)
    for array, copy in zip((command, plant, packed), copies, strict=True):
        np.testing.assert_array_equal(array, copy)
    np.testing.assert_array_equal(padded[[0, 18]], 7.0)


@pytest.mark.parametrize("wrong", ["columns", "rows", "constants"])
def test_arrays_of_other_shapes_are_refused(airframe: Airframe, wrong: str) -> None:
    state, command = np.zeros((17, 5)), np.zeros((3 if wrong == "rows" else 4, 4 if wrong == "columns" else 5))
    constants = airframe.pack(np.float64)[: 7 if wrong == "constants" else None]
    with pytest.raises(ValueError, match="advance needs"):
        advance(state, command, np.zeros((4, 5)), constants, 0.02, 8)


@pytest.mark.parametrize("state", [np.zeros((17, 10))[:, ::2], np.zeros((17, 5), np.float32), np.zeros((17, 5), int)])
def test_arrays_of_other_types_are_refused(airframe: Airframe, state: Array) -> None:
    with pytest.raises(TypingError):
        advance(state, np.zeros((4, 5)), np.zeros((4, 5)), airframe.pack(np.float64), 0.02, 8)


@pytest.mark.skipif(REGISTER_BYTES < 32, reason="host without wide registers")
def test_machine_code_is_packed() -> None:
    matrix, constants = numba.float32[:, ::1], numba.float32[::1]
    options = {"error_model": "numpy", "fastmath": set(FASTMATH)}
    fresh = numba.njit((matrix, matrix, matrix, constants, numba.float64, numba.int64), **options)(advance.py_func)
    (assembly,) = fresh.inspect_asm().values()
    packed = len(re.findall(r"\bv(?:mul|add|sub|fn?m(?:add|sub)\w*)ps\b.*%[yz]mm", assembly))
    single = len(re.findall(r"\bv(?:mul|add|sub|fn?m(?:add|sub)\w*)ss\b", assembly))
    assert packed > 300
    assert single < packed / 20
