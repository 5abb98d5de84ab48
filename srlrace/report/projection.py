"""Parallel projection of a scene in space onto paper, seen from above and from one side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

AZIMUTH = np.radians(-65.0)  # direction from which one looks, about z from x
ELEVATION = np.radians(34.0)

_sin, _cos = np.sin(AZIMUTH), np.cos(AZIMUTH)
_RIGHT = np.array([-_sin, _cos, 0.0])
_UP = np.array([-_cos * np.sin(ELEVATION), -_sin * np.sin(ELEVATION), np.cos(ELEVATION)])
_NEAR = np.array([_cos * np.cos(ELEVATION), _sin * np.cos(ELEVATION), np.sin(ELEVATION)])


def project(points: Array) -> Array:
    """Return the places (..., 2) on paper of points (..., 3), both in m."""
    return np.stack([points @ _RIGHT, points @ _UP], axis=-1)


def nearness(points: Array) -> Array:
    """Return how near points (..., 3) [m] are to the eye, in m from a plane through the origin."""
    return np.asarray(points @ _NEAR)


def outline(points: Array) -> Array:
    """Return the corners (k, 2) on paper of the convex hull of points (n, 3)."""
    from scipy.spatial import ConvexHull

    flat = project(points)
    return np.asarray(flat[ConvexHull(flat).vertices])
