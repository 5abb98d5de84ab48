"""Flights to draw: from a run's recording, or flown again from its policy where no recording was kept."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from srlrace.recording.archive import CorruptRecording
from srlrace.recording.flight import Flight, SceneObstacle
from srlrace.recording.reader import read_episodes, read_flight
from srlrace.report.collect import Run
from srlrace.runs import RunError, RunFolder
from srlrace.schema import Config

Array = NDArray[np.float64]

FLIGHTS = 20  # trajectories in one figure: more hide each other
FLOWN_AGAIN = 5  # of them where they have to be flown first
FLOWN_MAPS = 100  # of a run that is flown again: packing and certifying more, or fresh ones, takes minutes
SAME_TIME = 0.02  # s, a control period: batches of another size round differently, and no more than that may follow

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One flight: position and speed over time."""

    position: Array  # (t, 3) m, world
    speed: Array  # (t,) m/s
    crashed: bool


@dataclass(frozen=True, eq=False)
class Course:
    """Flights on one map, with what stands there."""

    flights: tuple[Trajectory, ...]
    waypoints: Array  # (w, 3) m, world; every place at which a waypoint stood in some flight
    obstacles: tuple[SceneObstacle, ...]
    config: Config
    origin: str = "recorded"  # in words

    @cached_property
    def top_speed(self) -> float:
        """The largest speed of all flights [m/s]."""
        return max(float(flight.speed.max()) for flight in self.flights)


def find_course(run: Run, suite: str, fly: bool = False) -> Course | None:
    """Return flights of an evaluation, or None, with a warning where something is damaged.

    With ``fly``, what was not recorded on the training maps is flown again, if they are few: this takes torch and
    seconds.
    """
    try:
        recording = RunFolder(run.path).file("eval", suite, "trajectories.mcap")
        if recording.is_file():
            return read_course(recording, run.config)
        quick = run.config.level.maps <= FLOWN_MAPS and not run.config.level.fresh_steps
        return fly_course(run) if fly and suite == "train_map" and quick else None
    except (CorruptRecording, RunError, OSError, ValueError) as error:
        logger.warning("no trajectories of %s, %s: %s", run.id, suite, error)
        return None


def read_course(recording: Path, config: Config, flights: int = FLIGHTS) -> Course:
    """Read the first flights of a recording that share its first map.

    Raises CorruptRecording for a damaged file, OSError for an unreadable one.
    """
    episodes = read_episodes(recording)
    chosen = episodes.loc[episodes["map"] == episodes["map"].iloc[0], "episode"]
    loaded = []
    for episode in chosen:
        try:
            loaded.append(read_flight(recording, int(episode)))
        except KeyError:  # only the first episodes of an evaluation may have been recorded
            break
        if len(loaded) == flights:
            break
    if not loaded:
        raise FileNotFoundError(f"{recording} holds no flight")
    return _course(loaded, config, f"the first {len(loaded)} recorded flights")


def fly_course(run: Run, flights: int = FLOWN_AGAIN) -> Course:
    """Fly the first episodes of a run's evaluation again.

    Raises RunError or ValueError for a policy that cannot be used, or that does not fly as it was evaluated.
    """
    from srlrace.evaluation.episodes import episode_rows
    from srlrace.evaluation.flights import fly
    from srlrace.evaluation.suites import make_suite
    from srlrace.learn.policy import load_policy

    folder = RunFolder(run.path)
    flights = min(flights, len(run.evaluations["train_map"].episode))
    suite = make_suite(run.config, "train_map")
    race, history = fly(load_policy(run.config, folder.file("policy.safetensors")), suite, flights, flights)
    assert history is not None
    flown = list(history.flights(suite, race, episode_rows(suite, race)))
    same = agreeing(run, flown)
    if same < len(flown):
        raise RunError(f"flown again, only {same} of {len(flown)} flights end as in episodes.csv; none is drawn")
    return _course(flown, run.config, f"{same} flights flown again from the policy, all ending as in its episodes.csv")


def _course(flights: Sequence[Flight], config: Config, origin: str) -> Course:
    trajectories = tuple(
        Trajectory(flight.position_w, np.linalg.norm(flight.velocity_w, axis=1), flight.outcome != "finished")
        for flight in flights
    )
    placed = np.unique(np.concatenate([flight.waypoints for flight in flights]), axis=0)
    return Course(trajectories, placed, flights[0].scene, config, origin)


def agreeing(run: Run, flights: Sequence[Flight]) -> int:
    """Return how many of the flights end as ``episodes.csv`` says."""
    evaluation, same = run.evaluations["train_map"], 0
    for flight, outcome, time in zip(flights, evaluation.outcome, evaluation.total_time_s, strict=False):
        near = flight.finish_time is None or abs(flight.finish_time - time) <= SAME_TIME
        same += bool(flight.outcome == outcome and near)
    return same
