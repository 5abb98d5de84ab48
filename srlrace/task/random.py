"""Counter-based random numbers, one independent stream per drone.

A drone's stream depends on its key alone, never on its neighbours or on the size of the batch, and
its whole state is two integers: that makes resets reproducible and checkpoints trivial. The
generator is SplitMix64 (Steele, Lea, Flood 2014), whose output function passes BigCrush.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from srlrace.sim.compile import inline

GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # SplitMix64's increment: 2^64 / golden ratio
MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
MIX_2 = np.uint64(0x94D049BB133111EB)
UNIT = 2.0**-53  # 53 random bits fill a double in [0, 1)


@inline
def mix(z):
    """SplitMix64's output function: a bijection of 64-bit integers that scatters every bit."""
    z = (z ^ (z >> np.uint64(30))) * MIX_1
    z = (z ^ (z >> np.uint64(27))) * MIX_2
    return z ^ (z >> np.uint64(31))


@inline
def uniform(streams, i):
    """Draw from U[0, 1) for drone ``i``; ``streams`` is (2, n) uint64: key, position."""
    streams[1, i] += GOLDEN
    return np.float64(mix(streams[0, i] ^ mix(streams[1, i])) >> np.uint64(11)) * UNIT


@inline
def symmetric(streams, i, half_width):
    """Draw from U[-half_width, half_width)."""
    return (2.0 * uniform(streams, i) - 1.0) * half_width


def make_streams(seed: int, members: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the streams of ``members`` (drones in training, episodes in evaluation), shape (2, n)."""
    streams = np.zeros((2, len(members)), np.uint64)
    for i, member in enumerate(members):
        streams[0, i] = np.random.SeedSequence([seed, int(member)]).generate_state(1, np.uint64)[0]
    return streams
