"""What Rerun makes of flights: read back by its own reader, in Rust."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from courses import SCENE, course_flight, record_course

from srlrace.replay.command import replay
from srlrace.replay.select import Wish

RERUN = Path(sys.executable).with_name("rerun")
LIMIT = 120  # s


@pytest.fixture(scope="module")
def chunks(config: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """The chunks of an exported file, by entity."""
    pytest.importorskip("rerun", reason="needs the rerun-sdk package")
    from rerun.chunk import RrdReader

    folder, forest = tmp_path_factory.mktemp("rerun"), config("env=forest")
    recording = record_course(folder / "a.mcap", forest, [course_flight(forest, i, 6.0 + i) for i in range(2)])
    exported = replay(folder, [str(recording)], Wish(overlay=2), out=folder / "flights.rrd")
    done = subprocess.run([RERUN, "rrd", "verify", exported], capture_output=True, timeout=LIMIT, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, list[Any]] = {}
    for chunk in RrdReader(exported).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def column(batches: list[Any], name: str) -> np.ndarray:
    """All values of a component, flat."""
    [values] = [batch.column(key) for batch in batches for key in batch.schema.names if key.endswith(name)]
    while "list" in str(values.type):
        values = values.flatten()
    return np.asarray(values)


@pytest.mark.parametrize("episode", [0, 1])
def test_the_drone_moves(chunks: dict[str, list[Any]], config: Any, episode: int) -> None:
    flight = course_flight(config("env=forest"), episode, 6.0 + episode)
    drone = chunks[f"/world/episode_{episode}/drone"]
    moved = column(drone, "translation").reshape(-1, 3)
    np.testing.assert_allclose(moved, flight.position_w, atol=1e-5)
    turned = column(drone, "quaternion").reshape(-1, 4)
    np.testing.assert_allclose(turned, flight.quaternion_wb[:, [1, 2, 3, 0]], atol=1e-6)
    speed = column(chunks[f"/speed/episode_{episode}"], "scalars")
    np.testing.assert_allclose(speed, np.linalg.norm(flight.velocity_w, axis=1))


def test_in_its_world(chunks: dict[str, list[Any]], config: Any) -> None:
    for kind, plural in (("sphere", "spheres"), ("cylinder", "cylinders"), ("box", "boxes")):
        places = column(chunks[f"/world/obstacles/{plural}"], "centers").reshape(-1, 3)
        np.testing.assert_allclose(places, [o.center for o in SCENE if o.kind == kind], atol=1e-5)
    gates = column(chunks["/world/gates"], "centers").reshape(-1, 3)
    np.testing.assert_allclose(gates, config("env=forest").env.waypoints, atol=1e-5)
