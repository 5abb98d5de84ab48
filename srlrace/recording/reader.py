"""Reading recordings back: tables of states and episodes, single flights, metadata."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd

from srlrace.recording.archive import Archive, CorruptRecording, refusing
from srlrace.recording.flight import Flight
from srlrace.recording.scene import parse_scene
from srlrace.recording.schema import (
    STATE_COLUMNS,
    Layout,
    episode_class,
    state_fields,
    state_layout,
)
from srlrace.recording.topics import CONFIG_NAME, EPISODES_NAME, EPOCH, METADATA_NAME, Topics

INTEGERS = ("episode", "target")
"""Columns that `read_states` returns as int64; everything else is float64."""


def read_states(path: Path, episodes: Sequence[int] | None = None) -> pd.DataFrame:
    """All states of a recording, or those of some episodes: one row per state, in order of episode and time.

    The columns are the fields of `srlrace.State`. Raises CorruptRecording for a damaged file, KeyError for an
    episode that it does not hold, OSError for an unreadable one.
    """
    with Archive(path) as archive, refusing(archive.path):
        topics = Topics.check(archive.schemas, archive.channels)
        layout, names = state_layout(topics.reward_terms), state_fields(topics.reward_terms)
        chunks = _chunks_of(archive, topics, episodes)
        blocks = [_values(archive.unpack(index).get(topics.state, []), layout) for index in chunks or ()]
        table = np.concatenate(blocks, axis=1) if blocks else np.empty((len(names), 0))
        frame = pd.DataFrame(table.T, columns=list(names), copy=False)
    if chunks is None:
        raise KeyError(f"{path} does not hold all of the episodes {list(episodes or ())}")
    return frame.astype(dict.fromkeys(INTEGERS, np.int64))


def read_episodes(path: Path) -> pd.DataFrame:
    """The attached table of episodes, one row each; raises as `read_states`."""
    with Archive(path) as archive, refusing(archive.path):
        return pd.read_csv(BytesIO(archive.attachment(EPISODES_NAME)))


def recorded_episodes(path: Path) -> tuple[int, ...]:
    """Numbers of the episodes whose flights a recording holds, from its index; raises as `read_states`."""
    with Archive(path) as archive, refusing(archive.path):
        topics = Topics.check(archive.schemas, archive.channels)
        return tuple(np.unique(_owners(archive, topics)).tolist())


def read_config(path: Path) -> bytes:
    """The attached configuration of the run, as the JSON text it was recorded with; raises as `read_states`."""
    with Archive(path) as archive, refusing(archive.path):
        return archive.attachment(CONFIG_NAME)


def read_metadata(path: Path) -> dict[str, str]:
    """What the recording says of its origin (run, versions, seed); raises as `read_states`."""
    with Archive(path) as archive, refusing(archive.path):
        return archive.metadata(METADATA_NAME)


def read_flight(path: Path, episode: int) -> Flight:
    """One episode as it was written, scene included; raises as `read_states`."""
    with Archive(path) as archive, refusing(archive.path):
        topics = Topics.check(archive.schemas, archive.channels)
        chunks = _chunks_of(archive, topics, [episode])
        flight = None if chunks is None else _flight([archive.unpack(index) for index in chunks], topics)
    if flight is None:
        raise KeyError(f"{path} does not hold episode {episode}")
    return flight


def _chunks_of(archive: Archive, topics: Topics, episodes: Sequence[int] | None) -> list[int] | None:
    """Chunks of the given episodes by time, or of all; None when one is missing."""
    if episodes is None:
        return list(range(len(archive.chunks)))
    owner = _owners(archive, topics)
    if not np.isin(episodes, owner).all():
        return None
    return np.flatnonzero(np.isin(owner, episodes)).tolist()


def _owners(archive: Archive, topics: Topics) -> np.ndarray:
    """The episode (chunks,) int64 that each chunk belongs to."""
    owners: np.ndarray = (archive.chunks[:, 0].astype(np.int64) - EPOCH) // topics.period
    return owners


def _values(payloads: list[bytes], layout: Layout) -> np.ndarray:
    """The doubles (fields, N) of state messages."""
    size = layout.dtype.itemsize
    if any(len(payload) != size for payload in payloads):
        raise CorruptRecording("a state message has another length than its schema gives")
    rows = np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, size)
    if not layout.fits(rows):
        raise CorruptRecording("a state message has other fields than its schema")
    states = rows.view(layout.dtype)[:, 0]
    return np.stack([states[name] for name in layout.dtype.names or ()])


def _flight(chunks: list[dict[int, list[bytes]]], topics: Topics) -> Flight:
    """An episode from the messages of its chunks."""
    [head] = [data for chunk in chunks for data in chunk.get(topics.episode, [])]
    [scene] = [data for chunk in chunks for data in chunk.get(topics.scene, [])]
    states = [data for chunk in chunks for data in chunk.get(topics.state, [])]
    terms = topics.reward_terms
    episode = episode_class().FromString(head)
    waypoints, obstacles = parse_scene(scene)
    columns = dict(zip(state_fields(terms), _values(states, state_layout(terms)), strict=True))
    arrays = {name: np.stack([columns[field] for field in fields], axis=-1)
              for name, fields in STATE_COLUMNS.items()}  # fmt: skip
    arrays |= {name: arrays[name][:, 0] for name in ("time", "clearance", "target")}
    arrays["target"] = arrays["target"].astype(np.int64)
    rewards = np.array([columns[f"reward_{term}"] for term in terms]).reshape(len(terms), -1).T
    return Flight(
        episode=episode.episode, seed=episode.seed, map_seed=episode.map, outcome=episode.outcome,
        finish_time=None if np.isnan(episode.time) else episode.time, **arrays,
        reward_terms=rewards, waypoints=waypoints, scene=obstacles,
    )  # fmt: skip
