"""What a quadrotor must do, whoever simulates it."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from srlrace.config import QuadConfig
from srlrace.sim.airframe import Airframe

Array = NDArray[np.float64]
MOTORS_OFF = np.array([-1e6, 0, 0, 0])  # so far below zero that no torque command lifts a rotor off its lower limit
NO_DRAG = np.zeros(3)
Fly = Callable[..., Array]
AtRest = Callable[[float], Array]
Draw = Callable[[int, int], Array]


def to_world(state: Array) -> Rotation:
    return Rotation.from_quat(state[6:10].T, scalar_first=True)


def test_free_fall_accelerates_down(fly: Fly, at_rest: AtRest) -> None:
    state = fly(at_rest(0.0), MOTORS_OFF, steps=50, drag=NO_DRAG)
    np.testing.assert_allclose(state[:3, 0], [0, 0, -0.5 * 9.81], atol=1e-9)
    np.testing.assert_allclose(state[3:6, 0], [0, 0, -9.81], atol=1e-9)


def test_hover_holds(fly: Fly, at_rest: AtRest, airframe: Airframe) -> None:
    start = at_rest(airframe.hover_thrust)
    np.testing.assert_allclose(fly(start, np.array([9.81, 0, 0, 0]), steps=100), start, atol=1e-9)


def test_falling_speed_tends_to_the_terminal_velocity(fly: Fly, at_rest: AtRest, quad: QuadConfig) -> None:
    terminal = 9.81 / quad.drag[2]
    for steps in (50, 250, 2000):
        state = fly(at_rest(0.0), MOTORS_OFF, steps=steps)
        fallen = terminal * -np.expm1(-quad.drag[2] * steps * 0.02)
        np.testing.assert_allclose(state[3:6, 0], [0, 0, -fallen], atol=1e-8)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_drag_acts_along_the_body_axes(fly: Fly, at_rest: AtRest, quad: QuadConfig, axis: int) -> None:
    turn = Rotation.from_euler("zyx", [0.7, -0.4, 1.1])
    state = at_rest(0.0)
    state[6:10, 0] = turn.as_quat(scalar_first=True)
    direction = turn.as_matrix()[:, axis]
    state[3:6, 0] = 8 * direction
    flown = fly(state, MOTORS_OFF, steps=5)
    along = (flown[3:6, 0]) @ direction
    rate, pull = quad.drag[axis], -9.81 * direction[2]
    assert along == pytest.approx(pull / rate + (8 - pull / rate) * np.exp(-0.1 * rate), rel=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_attitude_stays_a_unit_quaternion(fly: Fly, random_states: Draw, random_commands: Draw, dtype: type) -> None:
    state = fly(random_states(40, 1), random_commands(40, 2), steps=100, dtype=dtype)
    np.testing.assert_allclose(np.linalg.norm(state[6:10], axis=0), 1, atol=4 * np.finfo(dtype).eps)


def test_turning_the_world_about_the_vertical_turns_the_flight(
    fly: Fly, random_states: Draw, random_commands: Draw
) -> None:
    turn = Rotation.from_euler("z", 1.234)
    start, command = random_states(20, 3), random_commands(20, 4)
    turned = start.copy()
    turned[:3], turned[3:6] = turn.apply(start[:3].T).T, turn.apply(start[3:6].T).T
    turned[6:10] = (turn * to_world(start)).as_quat(scalar_first=True).T
    straight, other = fly(start, command, steps=50), fly(turned, command, steps=50)
    np.testing.assert_allclose(other[:3], turn.apply(straight[:3].T).T, atol=1e-9)
    np.testing.assert_allclose(other[3:6], turn.apply(straight[3:6].T).T, atol=1e-9)
    np.testing.assert_allclose(other[10:], straight[10:], atol=1e-9)


def test_unpowered_tumbling_conserves_energy_and_angular_momentum(
    fly: Fly, random_states: Draw, quad: QuadConfig
) -> None:
    inertia = np.array(quad.inertia)[:, None]

    def conserved(state: Array) -> Array:
        momentum = to_world(state).apply((inertia * state[10:13]).T).T
        spin = np.sum(inertia * state[10:13] ** 2, axis=0) / 2
        return np.vstack([momentum, spin, np.sum(state[3:6] ** 2, axis=0) / 2 + 9.81 * state[2]])

    start = random_states(20, 5)
    start[13:] = 0
    end = fly(start, MOTORS_OFF, steps=50, drag=NO_DRAG)
    assert np.abs(end[10:13] - start[10:13]).max() > 1  # unequal moments of inertia: the body rates do change
    np.testing.assert_allclose(conserved(end), conserved(start), rtol=1e-7, atol=1e-8)


def test_rotor_thrust_follows_a_step_with_first_order_lag(fly: Fly, at_rest: AtRest, quad: QuadConfig) -> None:
    target = 0.6 * quad.thrust_max
    command = np.array([4 * target / quad.mass, 0, 0, 0])
    for steps in (1, 3, 10):
        thrust = fly(at_rest(0.0), command, steps=steps)[13:, 0]
        np.testing.assert_allclose(thrust, target * -np.expm1(-steps * 0.02 / 0.033), rtol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_body_rates_go_where_they_are_sent(fly: Fly, at_rest: AtRest, airframe: Airframe, axis: int, sign: int) -> None:
    command = np.array([9.81, 0, 0, 0])
    command[1 + axis] = sign
    early = fly(at_rest(airframe.hover_thrust), command)[10:13, 0]
    assert early[axis] * sign > 0
    np.testing.assert_allclose(np.delete(early, axis), 0, atol=1e-12)
    late = fly(at_rest(airframe.hover_thrust), command, steps=100)[10:13, 0]
    assert late[axis] == pytest.approx(sign, abs=1e-2)


@pytest.mark.parametrize(("rotor", "signs"), [(0, (1, -1, 1)), (1, (-1, -1, -1)), (2, (-1, 1, 1)), (3, (1, 1, -1))])
def test_each_rotor_pushes_as_equation_2_says(fly: Fly, at_rest: AtRest, rotor: int, signs: tuple[int, ...]) -> None:
    state = at_rest(0.0)
    state[13 + rotor] = 1.0
    np.testing.assert_array_equal(np.sign(fly(state, MOTORS_OFF)[10:13, 0]), signs)


def test_rotor_thrusts_stay_within_their_range(
    fly: Fly, random_states: Draw, random_commands: Draw, quad: QuadConfig
) -> None:
    state = random_states(200, 6)
    for seed in range(20):
        state = fly(state, 5 * random_commands(200, seed))
        assert state[13:].min() >= 0
        assert state[13:].max() <= quad.thrust_max


@pytest.mark.parametrize(("collective", "share"), [(1e3, 1.0), (-5.0, 0.0)])
def test_impossible_collective_saturates(
    fly: Fly, at_rest: AtRest, quad: QuadConfig, collective: float, share: float
) -> None:
    thrust = fly(at_rest(3.0), np.array([collective, 0, 0, 0]), steps=50)[13:, 0]
    np.testing.assert_allclose(thrust, share * quad.thrust_max, atol=1e-6)


@pytest.mark.parametrize("gain", [0.8, 1.2])
def test_thrust_gain_scales_what_the_rotors_deliver(fly: Fly, at_rest: AtRest, quad: QuadConfig, gain: float) -> None:
    half = np.array([2 * quad.thrust_max / quad.mass, 0, 0, 0])
    np.testing.assert_allclose(fly(at_rest(0.0), half, steps=50, gain=gain)[13:, 0], gain * quad.thrust_max / 2)
    np.testing.assert_allclose(fly(at_rest(0.0), 9 * half, steps=50, gain=gain)[13:, 0], gain * quad.thrust_max)


def test_drag_model_force_is_drag_over_mass(fly: Fly, random_states: Draw, quad: QuadConfig) -> None:
    start, command = random_states(10, 7), np.array([12.0, 1, -2, 0.5])
    force = Airframe(dataclasses.replace(quad, drag_model="force"))
    expected = fly(start, command, steps=20, drag=np.array(quad.drag) / quad.mass)
    np.testing.assert_allclose(fly(start, command, steps=20, body=force), expected, atol=1e-12)
    assert np.abs(fly(start, command, steps=20) - expected).max() > 1e-3
