"""Equations of motion and one RK4 step of the quadrotor, for one drone or for a vector of drones.

The dynamics form a cascade: rotor thrust drives the body rates, the body rates turn the attitude, attitude and
thrust accelerate, velocity moves. No stage of a quantity depends on a later quantity in that chain, so the
four Runge-Kutta stages can be evaluated quantity by quantity instead of stage by stage. The numbers are those
of classic RK4 on the joint 17-dimensional state; far fewer of them are alive at a time.

Two members of the chain have linear stages in closed form: the rotor lag (stage value = target + factor times
deviation, the factors depend on the step only) and the position (its stages are the velocity's).

Every function takes plain values or `srlrace.sim.vector` values, and tuples of them.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

from srlrace.sim.airframe import (
    ACCELERATION,
    ANGULAR,
    GAIN,
    GRAVITY,
    GYRO,
    ROTOR_ANGULAR,
    ROTOR_COLLECTIVE,
    ROTOR_RATE,
    THRUST_MAX,
)
from srlrace.sim.compile import inline


@inline
def mix(f: Any, a: Any) -> Any:
    """Collective acceleration [m/s^2] and angular accelerations [rad/s^2] that rotor thrusts `f` [N] cause (Eq. 2)."""
    left, right = f[0] + f[3], f[1] + f[2]
    front, back = f[0] + f[1], f[2] + f[3]
    return (
        (left + right) * a[ACCELERATION],
        (left - right) * a[ANGULAR],
        (back - front) * a[ANGULAR + 1],
        ((f[0] - f[1]) + (f[2] - f[3])) * a[ANGULAR + 2],
    )


@inline
def clamp(value: Any, highest: Any) -> Any:
    """`value` limited to [0, highest]; a vector's NaN stays NaN, for min and max give their second operand then."""
    return min(highest, max(0.0, value))


@inline
def rotor_targets(w: Any, command: Any, gain: Any, a: Any) -> Any:
    """Rotor thrusts [N] that the rate controller asks for: clamped to the rotor's range, then times `gain`.

    tau = J K (w_desired - w) + w x J w; thrust and torque to rotors through the inverse of Eq. 2.
    """
    roll = (a[GAIN] * (command[1] - w[0]) + a[GYRO] * w[1] * w[2]) * a[ROTOR_ANGULAR]
    pitch = (a[GAIN + 1] * (command[2] - w[1]) + a[GYRO + 1] * w[2] * w[0]) * a[ROTOR_ANGULAR + 1]
    yaw = (a[GAIN + 2] * (command[3] - w[2]) + a[GYRO + 2] * w[0] * w[1]) * a[ROTOR_ANGULAR + 2]
    up = command[0] * a[ROTOR_COLLECTIVE]
    return (
        gain * clamp(up + yaw + (roll - pitch), a[THRUST_MAX]),
        gain * clamp(up - yaw - (roll + pitch), a[THRUST_MAX]),
        gain * clamp(up + yaw - (roll - pitch), a[THRUST_MAX]),
        gain * clamp(up - yaw + (roll + pitch), a[THRUST_MAX]),
    )


@inline
def lag_factors(h: Any, rate: Any) -> Any:
    """What is left of a rotor's deviation from its target: at RK4 stages 2, 3, 4 and after a step of `h` [s]."""
    z = h * rate
    second = 1.0 - z / 2.0
    third = 1.0 - z / 2.0 * second
    fourth = 1.0 - z * third
    return second, third, fourth, 1.0 - z / 6.0 * (1.0 + 2.0 * second + 2.0 * third + fourth)


@inline
def along3(x: Any, h: Any, k: Any) -> Any:
    """x + h k for triples."""
    return x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2]


@inline
def along4(x: Any, h: Any, k: Any) -> Any:
    """x + h k for quadruples."""
    return x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3]


@inline
def weighted(k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """Sum of the four RK4 slopes with weights 1, 2, 2, 1."""
    return (k1 + k4) + 2.0 * (k2 + k3)


@inline
def weighted3(k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """Sum of the four RK4 slopes with weights 1, 2, 2, 1, for triples."""
    return (
        weighted(k1[0], k2[0], k3[0], k4[0]),
        weighted(k1[1], k2[1], k3[1], k4[1]),
        weighted(k1[2], k2[2], k3[2], k4[2]),
    )


@inline
def weighted4(k1: Any, k2: Any, k3: Any, k4: Any) -> Any:
    """Sum of the four RK4 slopes with weights 1, 2, 2, 1, for quadruples."""
    x, y, z = weighted3(k1, k2, k3, k4)
    return x, y, z, weighted(k1[3], k2[3], k3[3], k4[3])


@inline
def rate_slope(w: Any, drive: Any, a: Any) -> Any:
    """Derivative of the body rates [rad/s^2]: `drive[1:4]` minus J^-1 (w x J w)."""
    return (
        drive[1] - a[GYRO] * w[1] * w[2],
        drive[2] - a[GYRO + 1] * w[2] * w[0],
        drive[3] - a[GYRO + 2] * w[0] * w[1],
    )


@inline
def attitude_slope(q: Any, w: Any) -> Any:
    """Twice the derivative of the attitude [1/s]: q times the pure quaternion of the body rates."""
    return (
        -(q[1] * w[0]) - q[2] * w[1] - q[3] * w[2],
        q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
        q[0] * w[1] + q[3] * w[0] - q[1] * w[2],
        q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
    )


@inline
def acceleration(v: Any, q: Any, collective: Any, drag: Any) -> Any:
    """Derivative of the velocity [m/s^2]: thrust, linear drag in the body frame, gravity."""
    xx, yy, zz = q[1] * q[1], q[2] * q[2], q[3] * q[3]
    xy, xz, yz = q[1] * q[2], q[1] * q[3], q[2] * q[3]
    wx, wy, wz = q[0] * q[1], q[0] * q[2], q[0] * q[3]
    r00, r01, r02 = 1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)
    r10, r11, r12 = 2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)
    r20, r21, r22 = 2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)
    b_x = -drag[0] * (r00 * v[0] + r10 * v[1] + r20 * v[2])
    b_y = -drag[1] * (r01 * v[0] + r11 * v[1] + r21 * v[2])
    b_z = collective - drag[2] * (r02 * v[0] + r12 * v[1] + r22 * v[2])
    return (
        r00 * b_x + r01 * b_y + r02 * b_z,
        r10 * b_x + r11 * b_y + r12 * b_z,
        r20 * b_x + r21 * b_y + r22 * b_z - GRAVITY,
    )


@inline
def rates_step(w: Any, d1: Any, d2: Any, d3: Any, d4: Any, h: Any, a: Any) -> Any:
    """RK4 step of the body rates under stage drives `d1` to `d4`: stages 2, 3, 4 and the new value."""
    k1 = rate_slope(w, d1, a)
    w2 = along3(w, h / 2.0, k1)
    k2 = rate_slope(w2, d2, a)
    w3 = along3(w, h / 2.0, k2)
    k3 = rate_slope(w3, d3, a)
    w4 = along3(w, h, k3)
    k4 = rate_slope(w4, d4, a)
    return w2, w3, w4, along3(w, h / 6.0, weighted3(k1, k2, k3, k4))


@inline
def attitude_step(q: Any, w1: Any, w2: Any, w3: Any, w4: Any, h: Any) -> Any:
    """RK4 step of the attitude under stage rates `w1` to `w4`: stages 2, 3, 4 and the new unit quaternion."""
    k1 = attitude_slope(q, w1)
    q2 = along4(q, h / 4.0, k1)
    k2 = attitude_slope(q2, w2)
    q3 = along4(q, h / 4.0, k2)
    k3 = attitude_slope(q3, w3)
    q4 = along4(q, h / 2.0, k3)
    k4 = attitude_slope(q4, w4)
    w, x, y, z = along4(q, h / 12.0, weighted4(k1, k2, k3, k4))
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return q2, q3, q4, (w * scale, x * scale, y * scale, z * scale)


@inline
def translation_step(p: Any, v: Any, q1: Any, q2: Any, q3: Any, q4: Any, c: Any, drag: Any, h: Any) -> Any:
    """RK4 step of position and velocity under stage attitudes `q1` to `q4` and collectives `c` [m/s^2]."""
    k1 = acceleration(v, q1, c[0], drag)
    k2 = acceleration(along3(v, h / 2.0, k1), q2, c[1], drag)
    k3 = acceleration(along3(v, h / 2.0, k2), q3, c[2], drag)
    k4 = acceleration(along3(v, h, k3), q4, c[3], drag)
    early = k1[0] + k2[0] + k3[0], k1[1] + k2[1] + k3[1], k1[2] + k2[2] + k3[2]
    return along3(p, h, along3(v, h / 6.0, early)), along3(v, h / 6.0, weighted3(k1, k2, k3, k4))


@inline
def integrate(p: Any, v: Any, q: Any, w: Any, f: Any, target: Any, drag: Any, a: Any, h: Any) -> Any:
    """One RK4 step of `h` [s] under held rotor targets [N]: new position, velocity, attitude, body rates, thrusts."""
    deviation = along4(f, -1.0, target)
    second, third, fourth, end = lag_factors(h, a[ROTOR_RATE])
    steady, excess = mix(target, a), mix(deviation, a)
    d1 = mix(f, a)
    d2, d3, d4 = along4(steady, second, excess), along4(steady, third, excess), along4(steady, fourth, excess)
    w2, w3, w4, w_new = rates_step(w, d1, d2, d3, d4, h, a)
    q2, q3, q4, q_new = attitude_step(q, w, w2, w3, w4, h)
    p_new, v_new = translation_step(p, v, q, q2, q3, q4, (d1[0], d2[0], d3[0], d4[0]), drag, h)
    return p_new, v_new, q_new, w_new, along4(target, end, deviation)
