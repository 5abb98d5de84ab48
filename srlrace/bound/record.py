"""The reference as a recording: one episode of an MCAP file, read like any flight."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from srlrace.bound.clearance import core_distance
from srlrace.bound.problem import Problem, passing_order
from srlrace.bound.trajectory import NODES, Array, Reference, between_nodes
from srlrace.config import Config, to_dict
from srlrace.provenance import versions
from srlrace.recording import Flight, RecordingWriter, SceneObstacle
from srlrace.task.reward import TERMS
from srlrace.world.obstacles import Obstacle

PARTS = 4  # states recorded in an interval: one every 6 to 8 ms


def write_recording(path: Path, config: Config, problem: Problem, reference: Reference) -> None:
    """Write the reference as one MCAP with one episode; a lap's time begins at its first waypoint."""
    metadata = {"run": "reference", "suite": "bound", "problem": problem.key, "t_ref_s": f"{reference.time:.6f}"}
    text = json.dumps(to_dict(config), indent=1).encode()
    with RecordingWriter(
        path,
        metadata={**metadata, "kind": "lap" if problem.lap else "race", **versions()},
        reward_terms=TERMS,
        horizon=max(config.env.horizon, reference.time),
        config_json=text,
        passing_radius=problem.passing_radius,
    ) as writer:
        writer.write(flight(config, problem, reference))
        writer.finish(f"episode,outcome,time_s\n0,finished,{reference.time:.6f}\n".encode())


def flight(config: Config, problem: Problem, reference: Reference) -> Flight:
    """The reference as a flight; the action is the collective and the body rates that it has."""
    nodes = reference.trajectory
    parts = between_nodes(problem, nodes, PARTS)
    states = np.vstack([parts[:, :-1].reshape(-1, 13), nodes.state[-1:]])
    offsets = np.arange(PARTS)[None, :] / PARTS * nodes.steps[:, None]
    time = np.append((nodes.times[:-1, None] + offsets).ravel(), nodes.times[-1])
    thrust = np.vstack([np.repeat(nodes.thrust, PARTS, axis=0), nodes.thrust[-1:]])
    collective = thrust.sum(axis=1, keepdims=True) / problem.quad.mass
    quaternion = states[:, 6:10] / np.linalg.norm(states[:, 6:10], axis=1, keepdims=True)
    ends = nodes.times[NODES::NODES]
    segment = np.minimum(np.searchsorted(ends, time), len(ends) - 1)
    return Flight(
        episode=0,
        seed=0,
        map_seed=config.level.map_seed,
        outcome="finished",
        finish_time=reference.time,
        time=time,
        position_w=states[:, :3],
        velocity_w=states[:, 3:6],
        quaternion_wb=quaternion,
        body_rate_b=states[:, 10:13],
        rotor_thrust=thrust,
        action=np.hstack([collective, states[:, 10:13]]),
        reward_terms=np.zeros((len(time), len(TERMS))),
        clearance=_clearance(problem, states[:, :3]),
        target=np.array(passing_order(config.env, problem.lap))[segment],
        waypoints=np.array(config.env.waypoints),
        scene=tuple(_scene(obstacle) for obstacle in problem.obstacles),
    )


def _clearance(problem: Problem, position: Array) -> Array:
    """Distance from the drone's centre to the nearest obstacle's surface, m; 1000 without obstacles."""
    gaps = [core_distance(obstacle, position) - obstacle.sphere_radius for obstacle in problem.obstacles]
    return np.min(gaps, axis=0) if gaps else np.full(len(position), 1000.0)


def _scene(obstacle: Obstacle) -> SceneObstacle:
    x, _, z = obstacle.size
    if obstacle.kind == "box":
        return SceneObstacle("box", obstacle.center, edge=x)
    return SceneObstacle(obstacle.kind, obstacle.center, radius=x / 2, height=z if obstacle.kind == "cylinder" else 0.0)
