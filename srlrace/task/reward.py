"""The reward: one small function per term, weighted and summed, each logged by name.

A term returns its unweighted value; the weights are `RewardConfig`'s fields of the same names, so a
term whose weight is zero costs nothing. To add a term: write its function, name it in `TERMS`, add a
line to `reward_terms`, and give it a weight in `RewardConfig` and the presets.

Terms of the paper (Eq. 5-7) and where they went:

=================  =======================================  ==========================
term               value                                    the paper's name
=================  =======================================  ==========================
progress           metres gained towards the target         lambda 1, Eq. 5
body_rate          norm of the body rates, rad/s            -lambda 2, Eq. 5
safety             sum of exp(-distance) of the nearest N   lambda 3, Eq. 6
collision          1 on a crash or on leaving the world     r_c, Eq. 7
completion         1 on completion                          Song et al.'s finish bonus
completion_time    total time T on completion, s            lambda 4 T, Eq. 7
time               duration of the step, s                  lambda 4, spread over time
=================  =======================================  ==========================
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from srlrace.config import RewardConfig
from srlrace.sim.compile import inline

TERMS = ("progress", "body_rate", "safety", "collision", "completion", "completion_time", "time")


def weights(reward: RewardConfig) -> NDArray[np.float64]:
    """Return the weight of each of `TERMS`, shape (terms,)."""
    return np.array([getattr(reward, term) for term in TERMS], np.float64)


@inline
def progress(x0, y0, z0, x1, y1, z1, gx, gy, gz):
    """Metres by which the step from (x0, y0, z0) to (x1, y1, z1) came closer to the target g."""
    before = math.sqrt((gx - x0) ** 2 + (gy - y0) ** 2 + (gz - z0) ** 2)
    return before - math.sqrt((gx - x1) ** 2 + (gy - y1) ** 2 + (gz - z1) ** 2)


@inline
def body_rate(state, i):
    """Norm of the body rates, rad/s."""
    return math.sqrt(state[10, i] ** 2 + state[11, i] ** 2 + state[12, i] ** 2)


EXP_STEP = 0.125  # m, spacing of the table
EXP_TABLE = np.exp(-EXP_STEP * np.arange(129))  # to 16 m, beyond which exp(-d) < 1.2e-7 counts as that


@inline
def exp_minus(d):
    """Return exp(-d) for d >= 0, to 3e-7: a table entry times a Taylor polynomial of the remainder.

    The relative error of the polynomial is below 0.125^5 / 120. The library's exp would take a fifth of
    the whole step.
    """
    k = min(int(d * (1.0 / EXP_STEP)), 128)
    r = min(d - k * EXP_STEP, EXP_STEP)
    return EXP_TABLE[k] * (1.0 - r * (1.0 - r * (0.5 - r * (1.0 / 6.0 - r * (1.0 / 24.0)))))


@inline
def safety(distance, count):
    """Sum of exp(-d / 1 m) over the ``count`` obstacles in range."""
    total = 0.0
    for k in range(count):
        total += exp_minus(distance[k])
    return total


@inline
def reward_terms(weight, gain, rate, distance, count, collided, completed, total_time, dt, out, i):
    """Write the weighted terms of drone ``i`` to ``out[:, i]`` and return their sum."""
    out[0, i] = weight[0] * gain
    out[1, i] = weight[1] * rate
    out[2, i] = weight[2] * safety(distance, count) if weight[2] != 0.0 else 0.0
    out[3, i] = weight[3] if collided else 0.0
    out[4, i] = weight[4] if completed else 0.0
    out[5, i] = weight[5] * total_time if completed else 0.0
    out[6, i] = weight[6] * dt
    total = 0.0
    for k in range(out.shape[0]):
        total += out[k, i]
    return total
