"""The tests that every solution must pass before its time is believed."""

from __future__ import annotations

import numpy as np

from srlrace.bound.clearance import smallest_gap
from srlrace.bound.problem import Problem
from srlrace.bound.trajectory import NODES, Trajectory, between_nodes

PARTS = 10  # steps of the finer integration within an interval
DEFECT = 1e-4  # m, largest difference of one interval from that integration
UNIT = 1e-3  # largest difference of a quaternion's norm from 1
SLACK = 1e-3  # share by which a time may fall below the point mass's: both are solved to a tolerance
EXCESS = 1e-6  # relative, by which IPOPT may exceed a limit (it relaxes them by 1e-8)


class Rejected(ValueError):
    """A solution that fails a test; the message says which, and by how much."""


def accept(problem: Problem, trajectory: Trajectory, point_mass_time: float) -> None:
    """Raise `Rejected` unless a trajectory flies the problem by the model, and no faster than a point mass."""
    fine = between_nodes(problem, trajectory, PARTS)
    _check_motion(problem, trajectory, fine[:, -1])
    _check_limits(problem, trajectory)
    _check_ends(problem, trajectory)
    path = np.vstack([fine[:, :-1].reshape(-1, 13), fine[-1:, -1]])[:, :3]
    low, high = np.array(problem.bounds_low), np.array(problem.bounds_high)
    outside = max(float((low - path).max()), float((path - high).max()))
    _require(outside <= EXCESS, f"it leaves the world by {outside:.3g} m")
    gap = smallest_gap(problem, path)
    _require(gap >= problem.keep_out, f"it comes within {gap:.4f} m of an obstacle, d_safe is {problem.keep_out:g} m")
    floor = point_mass_time * (1 - SLACK)
    _require(trajectory.duration >= floor, f"{trajectory.duration:.3f} s beat the point mass's {point_mass_time:.3f} s")


def _check_motion(problem: Problem, trajectory: Trajectory, arrived: np.ndarray) -> None:
    _require(bool(np.isfinite(trajectory.state).all()), "it is not finite")
    defect = float(np.linalg.norm(arrived[:, :3] - trajectory.state[1:, :3], axis=1).max())
    _require(defect < DEFECT, f"an interval is {defect:.2g} m off a finer integration, {DEFECT:g} m allowed")
    unit = float(np.abs(np.linalg.norm(trajectory.state[:, 6:10], axis=1) - 1).max())
    _require(unit < UNIT, f"a quaternion's norm is off by {unit:.2g}, {UNIT:g} allowed")


def _check_limits(problem: Problem, trajectory: Trajectory) -> None:
    thrust, most = trajectory.thrust, problem.quad.thrust_max * (1 + EXCESS)
    _require(thrust.min() >= -EXCESS and thrust.max() <= most, "a rotor leaves its range")
    rates = np.abs(trajectory.state[:, 10:13]) - np.array(problem.quad.body_rate_max) * (1 + EXCESS)
    _require(rates.max() <= 0, "a body rate exceeds its limit")


def _check_ends(problem: Problem, trajectory: Trajectory) -> None:
    state = trajectory.state
    misses = np.linalg.norm(state[NODES::NODES, :3] - np.array(problem.waypoints), axis=1)
    _require(misses.max() <= problem.passing_radius, f"it misses a waypoint by {misses.max():.4f} m")
    if problem.start is None:
        ends = state[[0, -1]]
        ends[1, 6:10] *= np.sign(ends[0, 6:10] @ ends[1, 6:10])
        apart = float(np.abs(ends[0] - ends[1]).max())
        _require(apart < DEFECT, f"the lap does not close, by {apart:.2g}")
    else:
        rest = np.array([*problem.start, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])
        _require(bool(np.abs(state[0] - rest).max() < EXCESS), "it does not begin at rest at the start")
    if problem.stop:
        _require(float(np.abs(state[-1, 3:6]).max()) < DEFECT, "it does not end at rest")


def _require(holds: bool, otherwise: str) -> None:
    if not holds:
        raise Rejected(otherwise)
