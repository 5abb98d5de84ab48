"""The time-optimal reference of a track, flown beside the policies as a ghost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from srlrace.config import Config
from srlrace.console import say
from srlrace.recording import Flight, read_flight, recorded_episodes
from srlrace.runs import RunError

PLACE = 1.5  # m that a gate of the reference may lie from the track's: episodes displace gates by up to 1 m
AT_GATE = 0.5  # m from the first gate: a reference that begins there is a flying lap


@dataclass(frozen=True)
class Ghost:
    """A request for the reference: a recording of it, or, without one, the stored solution of the run's track."""

    file: Path | None = None

    def flight(self, config: Config, first: Flight) -> Flight:
        """The reference's flight; a flying lap begins when ``first`` passes the first gate.

        Raises `RunError` when there is none for this track, CorruptRecording for a bad file.
        """
        flight = _recorded(self.file, config) if self.file else solved(config)
        lap = config.env.laps > 0 and np.linalg.norm(flight.position_w[0] - flight.waypoints[0]) < AT_GATE
        return _delayed(flight, _first_pass(first)) if lap else flight


def _recorded(path: Path, config: Config) -> Flight:
    episodes = recorded_episodes(path)
    if not episodes:
        raise RunError(f"{path} holds no flight")
    flight = read_flight(path, episodes[0])
    gates = np.array(config.env.waypoints)
    if flight.waypoints.shape != gates.shape or (np.linalg.norm(flight.waypoints - gates, axis=1) > PLACE).any():
        raise RunError(f"{path} is a reference for another track than {config.env.name}")
    return flight


def solved(config: Config) -> Flight:
    """The stored solution of a track, with its obstacles if that is solved, else without; raises `RunError`."""
    from srlrace.bound.problem import problem_of
    from srlrace.bound.store import load

    for obstacles in (True, False):
        found = load(problem_of(config, obstacles=obstacles))
        if found is not None:
            best = found.trajectory
            say(f"reference: {best.duration:.2f} s, {'past' if obstacles else 'without'} the obstacles")
            return solution_flight(config, best.times, best.state, np.vstack([best.thrust, best.thrust[-1:]]))
    name = config.env.name
    raise RunError(f"no time-optimal reference of {name} at hand; solve it with: srlrace bound env={name}")


def solution_flight(config: Config, times: np.ndarray, state: np.ndarray, thrust: np.ndarray) -> Flight:
    """The nodes of a solution, (T,) s, (T, 13) and (T, 4) N, as a flight.

    Segments have equally many nodes and end at a waypoint each; a lap has one segment less than the waypoints it
    passes, since it begins at the first.
    """
    from srlrace.world.track import target_sequence

    track = config.env
    order = np.array(target_sequence(track))
    lap = track.laps > 0 and np.linalg.norm(state[0, :3] - np.array(track.waypoints[0])) < AT_GATE
    flown = order[1:] if lap else order
    segment = np.minimum(np.arange(len(times)) // ((len(times) - 1) // len(flown)), len(flown) - 1)
    target = flown[segment]
    target[0] = order[0]
    collective = thrust.sum(axis=1, keepdims=True) / config.quad.mass
    return Flight(
        episode=0,
        seed=0,
        map_seed=0,
        outcome="finished",
        finish_time=float(times[-1]),
        time=times,
        position_w=state[:, 0:3],
        velocity_w=state[:, 3:6],
        quaternion_wb=state[:, 6:10],
        body_rate_b=state[:, 10:13],
        rotor_thrust=thrust,
        action=np.hstack([collective, state[:, 10:13]]),
        reward_terms=np.empty((len(times), 0)),
        clearance=np.full(len(times), np.nan),
        target=target,
        waypoints=np.array(track.waypoints, np.float64),
    )


def _first_pass(flight: Flight) -> float:
    """When a flight passed its first gate, s; 0 if it never did."""
    changes = np.flatnonzero(np.diff(flight.target))
    return float(flight.time[changes[0] + 1]) if len(changes) else 0.0


def _delayed(flight: Flight, delay: float) -> Flight:
    end = None if flight.finish_time is None else flight.finish_time + delay
    return replace(flight, time=flight.time + delay, finish_time=end)
