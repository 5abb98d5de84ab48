"""The reference as a recording: read by the project's own reader, and shown by the replay beside a flight."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from courses import course_flight, record_course
from typer.testing import CliRunner

from srlrace.bound.problem import problem_of
from srlrace.bound.record import write_recording
from srlrace.bound.store import load
from srlrace.cli import app
from srlrace.recording import read_flight, read_metadata, recorded_episodes
from srlrace.replay.reference import Ghost


@pytest.fixture(params=["forest", "split_s"])
def recorded(request, config, tmp_path):
    settings = config(f"env={request.param}")
    problem = problem_of(settings)
    reference = load(problem)
    path = tmp_path / "reference.mcap"
    write_recording(path, settings, problem, reference)
    return settings, problem, reference, path


def test_it_reads_back_as_it_was_solved(recorded):
    settings, problem, reference, path = recorded
    assert list(recorded_episodes(path)) == [0]
    flight, nodes = read_flight(path, 0), reference.trajectory
    assert flight.finish_time == pytest.approx(reference.time)
    assert (np.diff(flight.time) > 0).all()
    at = np.searchsorted(flight.time, nodes.times - 1e-6)
    assert flight.time[at] == pytest.approx(nodes.times, abs=1e-5)
    assert flight.position_w[at] == pytest.approx(nodes.state[:, :3], abs=1e-4)
    assert flight.velocity_w[at] == pytest.approx(nodes.state[:, 3:6], abs=1e-3)
    order = flight.target[np.append(0, np.flatnonzero(np.diff(flight.target)) + 1)]
    passed = np.array(settings.env.waypoints)[order]
    assert passed == pytest.approx(np.array(problem.waypoints))
    assert flight.clearance.min() >= problem.keep_out - 1e-4
    assert len(flight.scene) == len(problem.obstacles)
    assert read_metadata(path)["kind"] == ("lap" if problem.lap else "race")


def test_a_replay_shows_it_beside_a_flight(recorded, tmp_path):
    settings, _, reference, path = recorded
    flown = course_flight(settings, 0, 7.0)
    flight, page = record_course(tmp_path / "flight.mcap", settings, [flown]), tmp_path / "page.html"
    words = ["replay", str(flight), "--reference-file", str(path), "--out", str(page)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    [text] = re.findall(r'<script[^>]*id="data"[^>]*>(.*?)</script>', page.read_text(), re.DOTALL)
    [ghost] = [flight for flight in json.loads(text)["flights"] if flight["ghost"]]
    assert ghost["official"] == pytest.approx(reference.time, abs=1e-4)
    assert Ghost(path).flight(settings, flown).time[0] == Ghost().flight(settings, flown).time[0]
