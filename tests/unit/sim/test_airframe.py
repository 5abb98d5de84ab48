"""The airframe's constants, from geometry and from the presets."""

import dataclasses

import numpy as np
import pytest

from srlrace.config import QuadConfig
from srlrace.sim.airframe import SIZE, Airframe


def test_mixer_is_the_cross_product_of_rotor_positions_and_thrusts(any_quad: QuadConfig) -> None:
    half = any_quad.arm_length / np.sqrt(2)
    # x forward, y left: rotor 1 front left, then 2 front right, 3 back right, 4 back left.
    positions = np.array([[half, half, 0], [half, -half, 0], [-half, -half, 0], [-half, half, 0]])
    mixer = Airframe(any_quad).mixer()
    np.testing.assert_allclose(mixer[0], 1)
    np.testing.assert_allclose(mixer[1:3].T, np.cross(positions, [0, 0, 1])[:, :2], atol=1e-15)
    # Neighbouring rotors turn in opposite directions, so hover needs no yaw torque.
    np.testing.assert_allclose(mixer[3], any_quad.torque_constant * np.array([1, -1, 1, -1]))


def test_inverse_mixer_undoes_the_mixer(any_quad: QuadConfig) -> None:
    airframe = Airframe(any_quad)
    np.testing.assert_allclose(airframe.inverse_mixer() @ airframe.mixer(), np.eye(4), atol=1e-12)


def test_hover_thrust_carries_the_weight(any_quad: QuadConfig) -> None:
    assert Airframe(any_quad).hover_thrust * 4 == pytest.approx(any_quad.mass * 9.81)


@pytest.mark.parametrize("any_quad", ["kingfisher"], indirect=True)
def test_thrust_to_weight_of_the_paper_quadrotor(any_quad: QuadConfig) -> None:
    assert Airframe(any_quad).max_collective / 9.81 == pytest.approx(4.61, abs=0.005)
    assert any_quad.thrust_max == pytest.approx(1.562522e-6 * 2333**2, rel=1e-4)


@pytest.mark.parametrize("any_quad", ["kingfisher_twr33"], indirect=True)
def test_thrust_to_weight_of_the_weaker_preset(any_quad: QuadConfig) -> None:
    assert Airframe(any_quad).max_collective / 9.81 == pytest.approx(3.3)


def test_drag_as_a_force_is_divided_by_the_mass(quad: QuadConfig) -> None:
    force = dataclasses.replace(quad, drag_model="force")
    np.testing.assert_allclose(Airframe(quad).drag_acceleration(), [0.26, 0.28, 0.42])
    np.testing.assert_allclose(Airframe(force).drag_acceleration(), np.array([0.26, 0.28, 0.42]) / 0.752)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_packed_constants_have_the_asked_type(any_quad: QuadConfig, dtype: type) -> None:
    packed = Airframe(any_quad).pack(dtype)
    assert packed.dtype == dtype
    assert packed.shape == (SIZE,)
    assert np.isfinite(packed).all()
