"""Smooth flights through the Forest's gates, recorded without a simulator."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from srlrace.config import Config, to_dict
from srlrace.recording import Flight, RecordingWriter, SceneObstacle

PERIOD = 0.02  # s
TREES = tuple(SceneObstacle("cylinder", (4.0 * i - 22.0, 6.0, 4.0), radius=0.3, height=8.0) for i in range(12))
SCENE = (
    *TREES,
    SceneObstacle("sphere", (-3.0, -2.0, 1.5), radius=0.6),
    SceneObstacle("box", (6.0, 2.0, 1.0), edge=1.2),
)
TERMS = ("progress", "time")


def course_flight(config: Config, episode: int, seconds: float, outcome: str = "finished") -> Flight:
    """A spline through the gates in ``seconds``; one that does not finish ends half-way."""
    gates = np.array(config.env.waypoints)
    knots = np.linspace(0.0, seconds, len(gates) + 1)
    path = CubicSpline(knots, np.vstack([config.env.start, gates]))
    end = seconds if outcome == "finished" else seconds / 2
    time = np.arange(0.0, end + PERIOD, PERIOD)
    rng = np.random.default_rng(episode)
    turn = 0.3 * np.sin(time + episode)
    return Flight(
        episode=episode,
        seed=1,
        map_seed=0,
        outcome=outcome,
        finish_time=seconds if outcome == "finished" else None,
        time=time,
        position_w=path(time),
        velocity_w=path(time, 1),
        quaternion_wb=np.column_stack([np.cos(turn), np.sin(turn), 0 * turn, 0 * turn]),
        body_rate_b=np.column_stack([5 * np.sin(3 * time), -4 * np.cos(2 * time), np.sin(time)]),
        rotor_thrust=rng.uniform(0.5, 8.0, size=(len(time), 4)),
        action=rng.uniform(-2.0, 2.0, size=(len(time), 4)),
        reward_terms=np.zeros((len(time), len(TERMS))),
        clearance=1.5 + np.cos(time),
        target=np.minimum(np.searchsorted(knots[1:], time, side="right"), len(gates) - 1),
        waypoints=gates,
        scene=SCENE,
    )


def record_course(
    path: Path, config: Config, flights: Sequence[Flight], run: str = "forest-srl-s0", table: str | None = None
) -> Path:
    """A recording of these flights as an evaluation writes it; ``table`` replaces its table of episodes."""
    rows = [f"{f.episode},{f.map_seed},{f.outcome},{f.finish_time or ''},{f.target[-1]}" for f in flights]
    text = table or "\n".join(["episode,map,outcome,time_s,gates_passed", *rows, ""])
    metadata = {"run": run, "suite": "train_map"}
    with RecordingWriter(
        path, metadata=metadata, reward_terms=TERMS, horizon=20.0, config_json=json.dumps(to_dict(config)).encode()
    ) as writer:
        for flight in flights:
            writer.write(flight)
        writer.finish(text.encode())
    return path
