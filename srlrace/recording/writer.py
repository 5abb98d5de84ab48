"""Recording flights: one MCAP file per evaluation, the same bytes for the same flights."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import numpy as np
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.opcode import Opcode
from mcap_protobuf.schema import build_file_descriptor_set

from srlrace.files import sync_folder
from srlrace.recording.container import MESSAGE_HEADER, McapStream
from srlrace.recording.flight import Flight
from srlrace.recording.scene import scene_message
from srlrace.recording.schema import (
    EPISODE_TYPE,
    STATE_COLUMNS,
    STATE_TYPE,
    Layout,
    episode_class,
    episode_schema,
    pose_layout,
    state_layout,
    state_schema,
    varint,
)
from srlrace.recording.topics import (
    CONFIG_NAME,
    EPISODE_TOPIC,
    EPISODES_NAME,
    EPOCH,
    LIBRARY,
    METADATA_NAME,
    PERIOD_KEY,
    POSE_TOPIC,
    SCENE_TOPIC,
    STATE_TOPIC,
)

ROWS_PER_CHUNK = 8192
"""A longer episode takes several chunks, so that no reader needs more than about 4 MB for one."""

_SECOND = 10**9
_GAP = 1.0
"""Pause between the longest possible episode and the next one on the timeline, s."""


class RecordingWriter:
    """Writes flights to ``<path>.part`` and renames it to ``path`` when finished.

    Use as a context manager: `write` each flight in order of its episode number, then `finish`. ``horizon`` is
    the time limit of an episode [s], ``passing_radius`` that of the drawn gates [m]. Without `finish`, or after
    an error, the ``.part`` file stays for `srlrace.recording.recover`. Raises OSError when the disk does.
    """

    def __init__(
        self,
        path: Path,
        *,
        metadata: Mapping[str, str],
        reward_terms: Sequence[str],
        horizon: float,
        config_json: bytes,
        passing_radius: float = 0.3,
    ) -> None:
        self.path = Path(path)
        self.part = self.path.with_name(self.path.name + ".part")
        self._terms = tuple(reward_terms)
        self._horizon = horizon
        self._period = round((horizon + _GAP) * _SECOND)
        self._radius = passing_radius
        self._last = -1
        self._state, self._pose = state_layout(self._terms), pose_layout()
        self._file = create(self.part)
        try:
            self._begin(metadata, config_json)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, metadata: Mapping[str, str], config_json: bytes) -> None:
        self._out = out = McapStream(self._file, LIBRARY)
        period = {PERIOD_KEY: str(self._period)}
        pose, scene = (build_file_descriptor_set(kind).SerializeToString(deterministic=True)
                       for kind in (PoseInFrame, SceneUpdate))  # fmt: skip
        self._episode_channel = out.channel(EPISODE_TOPIC, out.schema(EPISODE_TYPE, episode_schema()), period)
        self._scene_channel = out.channel(SCENE_TOPIC, out.schema("foxglove.SceneUpdate", scene), {})
        self._state_channel = out.channel(STATE_TOPIC, out.schema(STATE_TYPE, state_schema(self._terms)), period)
        self._pose_channel = out.channel(POSE_TOPIC, out.schema("foxglove.PoseInFrame", pose), {})
        out.metadata(METADATA_NAME, metadata)
        out.attachment(CONFIG_NAME, "application/json", config_json, EPOCH)
        state = _template(self._state, self._state_channel)
        drawn = _template(self._pose, self._pose_channel)
        self._row_type = np.dtype([("state", state.dtype), ("pose", drawn.dtype)])
        self._row = state.view(np.uint8).tobytes() + drawn.view(np.uint8).tobytes()

    def write(self, flight: Flight) -> None:
        """Append one episode; episode numbers must increase. Raises ValueError for a flight that does not fit."""
        if flight.episode <= self._last:
            raise ValueError(f"episode {flight.episode} follows episode {self._last}: numbers must increase")
        if np.shape(flight.reward_terms)[1] != len(self._terms):
            raise ValueError(f"episode {flight.episode}: {len(self._terms)} reward terms expected")
        if flight.time[-1] > self._horizon + _GAP / 2:
            raise ValueError(f"episode {flight.episode} lasts {flight.time[-1]} s, the horizon is {self._horizon} s")
        start = EPOCH + flight.episode * self._period
        times = np.uint64(start) + np.rint(np.asarray(flight.time, np.float64) * _SECOND).astype(np.uint64)
        rows = self._rows(flight, times)
        head, index = self._head(flight, start)
        for first in range(0, len(rows), ROWS_PER_CHUNK):
            block = rows[first : first + ROWS_PER_CHUNK]
            index |= self._index(times[first : first + len(block)], len(head))
            self._out.chunk(head + block.view(np.uint8).tobytes(), index)
            head, index = b"", {}
        self._last = flight.episode

    def _head(self, flight: Flight, start: int) -> tuple[bytes, dict[int, np.ndarray]]:
        """The two messages that open an episode, and their index."""
        seconds, nanos = divmod(start, _SECOND)
        time = np.nan if flight.finish_time is None else flight.finish_time
        episode = episode_class()(
            episode=flight.episode, seed=flight.seed, map=flight.map_seed, outcome=flight.outcome, time=time,
            steps=len(flight.time),
        )  # fmt: skip
        first = _record(self._episode_channel, flight.episode, start, episode.SerializeToString(deterministic=True))
        scene = scene_message(flight, self._radius, seconds, nanos)
        second = _record(self._scene_channel, flight.episode, start, scene)
        places = ((self._episode_channel, 0), (self._scene_channel, len(first)))
        return first + second, {channel: np.array([[start, place]], np.uint64) for channel, place in places}

    def _rows(self, flight: Flight, times: np.ndarray) -> np.ndarray:
        """All state and pose records of an episode, in order of time."""
        rows = np.frombuffer(bytearray(self._row * len(times)), self._row_type)
        for name in ("state", "pose"):
            header = rows[name]["header"]
            header["sequence"] = np.arange(len(times))
            header["log_time"] = header["publish_time"] = times
        state, pose = rows["state"]["message"], rows["pose"]["message"]
        state["episode"] = flight.episode
        state["speed"] = np.linalg.norm(np.asarray(flight.velocity_w, np.float64), axis=1)
        for array, names in STATE_COLUMNS.items():
            columns = np.asarray(getattr(flight, array), np.float64).reshape(len(times), -1).T
            for name, column in zip(names, columns, strict=True):
                state[name] = column
                if array in ("position_w", "quaternion_wb"):
                    pose[name] = column
        for term, column in zip(self._terms, np.asarray(flight.reward_terms).T, strict=True):
            state[f"reward_{term}"] = column
        seconds, nanos = np.divmod(times, np.uint64(_SECOND))
        pose["seconds"], pose["nanos"] = varint(seconds), varint(nanos)
        return rows

    def _index(self, times: np.ndarray, start: int) -> dict[int, np.ndarray]:
        offsets = np.uint64(start) + np.arange(len(times), dtype=np.uint64) * np.uint64(self._row_type.itemsize)
        width = self._row_type["state"].itemsize
        return {
            self._state_channel: np.stack([times, offsets], axis=1),
            self._pose_channel: np.stack([times, offsets + np.uint64(width)], axis=1),
        }

    def finish(self, episodes_csv: bytes) -> None:
        """Add the table of episodes, complete the file, and give it its name once it is safely on disk."""
        end = EPOCH + (self._last + 1) * self._period
        self._out.attachment(EPISODES_NAME, "text/csv", episodes_csv, end)
        self._out.finish()
        publish(self._file, self.part, self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def _template(layout: Layout, channel: int) -> np.ndarray:
    """One message record with everything constant in place."""
    data = bytearray(_record(channel, 0, 0, layout.template.tobytes()))
    return np.frombuffer(data, [("header", MESSAGE_HEADER), ("message", layout.dtype)])


def _record(channel: int, sequence: int, time: int, payload: bytes) -> bytes:
    """One message record."""
    length = MESSAGE_HEADER.itemsize - 9 + len(payload)
    header = np.array((Opcode.MESSAGE, length, channel, sequence, time, time), MESSAGE_HEADER)
    return header.tobytes() + payload


def create(path: Path) -> IO[bytes]:
    """Open a new file in place of an older one, never through a link that somebody left there."""
    path.unlink(missing_ok=True)
    return path.open("xb")


def publish(file: IO[bytes], part: Path, path: Path) -> None:
    """Close a complete file and give it its name once its bytes are on the disk."""
    file.flush()
    os.fsync(file.fileno())
    file.close()
    part.replace(path)
    sync_folder(path.parent)
