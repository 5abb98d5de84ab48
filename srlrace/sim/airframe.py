"""The airframe: constants of the kernel derived from a `QuadConfig`."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import DTypeLike, NDArray

if TYPE_CHECKING:
    from srlrace.config import QuadConfig

GRAVITY = 9.81  # m/s^2, standard value rounded as the quadrotor literature does

# Layout of the packed constants.
ACCELERATION = 0  # collective acceleration per newton of total thrust [1/kg]
ANGULAR = 1  # 1:4, angular acceleration about x, y, z per newton of thrust difference [rad/s^2/N]
GYRO = 4  # 4:7, (J_z - J_y)/J_x and cyclic: the part of omega x J omega [-]
GAIN = 7  # 7:10, rate controller [1/s]
ROTOR_COLLECTIVE = 10  # rotor thrust per collective acceleration, m/4 [kg]
ROTOR_ANGULAR = 11  # 11:14, rotor thrust per angular acceleration about x, y, z [N s^2/rad]
THRUST_MAX = 14  # largest thrust of one rotor [N]
ROTOR_RATE = 15  # inverse of the rotor time constant [1/s]
SIZE = 16

# Rows: total thrust, roll, pitch, yaw; columns: rotors 1 to 4 (paper Eq. 2).
ROTOR_SIGNS = ((1, 1, 1, 1), (1, -1, -1, 1), (-1, -1, 1, 1), (1, -1, 1, -1))


@dataclass(frozen=True)
class Airframe:
    """A quadrotor's constants in the form the kernel uses."""

    quad: QuadConfig

    @property
    def hover_thrust(self) -> float:
        """Thrust of one rotor in hover [N]."""
        return self.quad.mass * GRAVITY / 4

    @property
    def max_collective(self) -> float:
        """Largest collective acceleration [m/s^2], all four rotors at their limit."""
        return 4 * self.quad.thrust_max / self.quad.mass

    def mixer(self) -> NDArray[np.float64]:
        """Matrix (4, 4) from rotor thrusts [N] to total thrust [N] and torques [N m] (paper Eq. 2)."""
        lever = self.quad.arm_length / sqrt(2)
        arms: NDArray[np.float64] = np.array([1.0, lever, lever, self.quad.torque_constant])
        return arms[:, None] * np.array(ROTOR_SIGNS, dtype=np.float64)

    def inverse_mixer(self) -> NDArray[np.float64]:
        """Matrix (4, 4) from total thrust [N] and torques [N m] to rotor thrusts [N]."""
        return np.asarray(np.linalg.inv(self.mixer()), dtype=np.float64)

    def drag_acceleration(self) -> NDArray[np.float64]:
        """Linear drag along the body axes (3,), mass-normalised [1/s]."""
        drag = np.array(self.quad.drag, dtype=np.float64)
        return drag / self.quad.mass if self.quad.drag_model == "force" else drag

    def pack(self, dtype: DTypeLike = np.float32) -> NDArray[np.floating]:
        """Constants of the kernel (16,) in the layout listed at the top of this module."""
        quad = self.quad
        j_x, j_y, j_z = quad.inertia
        lever = quad.arm_length / sqrt(2)
        packed = np.empty(SIZE, dtype=np.float64)
        packed[ACCELERATION] = 1 / quad.mass
        packed[ANGULAR : ANGULAR + 3] = lever / j_x, lever / j_y, quad.torque_constant / j_z
        packed[GYRO : GYRO + 3] = (j_z - j_y) / j_x, (j_x - j_z) / j_y, (j_y - j_x) / j_z
        packed[GAIN : GAIN + 3] = quad.rate_gains
        packed[ROTOR_COLLECTIVE] = quad.mass / 4
        packed[ROTOR_ANGULAR : ROTOR_ANGULAR + 3] = 1 / (4 * packed[ANGULAR : ANGULAR + 3])
        packed[THRUST_MAX] = quad.thrust_max
        packed[ROTOR_RATE] = 1 / quad.rotor_time_constant
        return packed.astype(dtype)
