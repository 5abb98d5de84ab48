"""The messages of a recording: protobuf schemas, and the byte layout of the fixed-width ones.

A protobuf message made of doubles only has a constant layout: tag, eight bytes, tag, eight bytes. All
messages of an episode are therefore one structured numpy array. Tags and nesting are taken from a message
that protobuf itself has serialised, with recognisable values in place of the numbers.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

EPISODE_TYPE = "srlrace.Episode"
STATE_TYPE = "srlrace.State"
WORLD_FRAME = "world"

STATE_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "time": ("time",),
    "position_w": ("position_x", "position_y", "position_z"),
    "velocity_w": ("velocity_x", "velocity_y", "velocity_z"),
    "quaternion_wb": ("quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"),
    "body_rate_b": ("body_rate_x", "body_rate_y", "body_rate_z"),
    "rotor_thrust": ("rotor_thrust_0", "rotor_thrust_1", "rotor_thrust_2", "rotor_thrust_3"),
    "action": ("action_thrust", "action_rate_x", "action_rate_y", "action_rate_z"),
    "clearance": ("clearance",),
    "target": ("target",),
}
"""Arrays of a `Flight` and the fields of a state message that hold them."""

FIRST_REWARD_FIELD = 64
"""Field number of the first reward term; the numbers below stay free for further states."""

_VARINT_BYTES = 5
"""Room for 35 bits: seconds since 1970 and nanoseconds of a timestamp both fit."""


def state_fields(reward_terms: Sequence[str]) -> tuple[str, ...]:
    """Names of the doubles of one state message, in order; a reward term `x` becomes `reward_x`."""
    for term in reward_terms:
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,62}", term):
            raise ValueError(f"{term!r} is no name for a reward term: small letters, digits and _ expected")
    if len(set(reward_terms)) != len(reward_terms):
        raise ValueError("reward terms must have different names")
    fixed = tuple(name for names in STATE_COLUMNS.values() for name in names)
    return ("episode", *fixed, "speed", *(f"reward_{term}" for term in reward_terms))


def _file(name: str, type_name: str, fields: Sequence[tuple[str, int, int]]) -> descriptor_pb2.FileDescriptorSet:
    """A descriptor set with one message of the given (name, number, type) fields."""
    message = descriptor_pb2.DescriptorProto(name=type_name.split(".")[-1])
    for field, number, kind in fields:
        label = descriptor_pb2.FieldDescriptorProto.LABEL_OPTIONAL
        message.field.add(name=field, number=number, type=kind, label=label, json_name=field)
    file = descriptor_pb2.FileDescriptorProto(name=name, package="srlrace", syntax="proto3", message_type=[message])
    return descriptor_pb2.FileDescriptorSet(file=[file])


def state_schema(reward_terms: Sequence[str]) -> bytes:
    """The serialised descriptor set of `srlrace.State` with these reward terms."""
    names = state_fields(reward_terms)
    fixed = len(names) - len(reward_terms)
    numbers = [*range(1, fixed + 1), *range(FIRST_REWARD_FIELD, FIRST_REWARD_FIELD + len(reward_terms))]
    double = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
    fields = [(name, number, double) for name, number in zip(names, numbers, strict=True)]
    return _file("srlrace/state.proto", STATE_TYPE, fields).SerializeToString(deterministic=True)


def episode_schema() -> bytes:
    """The serialised descriptor set of `srlrace.Episode`."""
    kind = descriptor_pb2.FieldDescriptorProto
    fields = [
        ("episode", 1, kind.TYPE_INT64),
        ("seed", 2, kind.TYPE_INT64),
        ("map", 3, kind.TYPE_INT64),
        ("outcome", 4, kind.TYPE_STRING),
        ("time", 5, kind.TYPE_DOUBLE),
        ("steps", 6, kind.TYPE_INT64),
    ]
    return _file("srlrace/episode.proto", EPISODE_TYPE, fields).SerializeToString(deterministic=True)


def message_class(schema: bytes, type_name: str) -> type[Message]:
    """The protobuf class of a type described by a serialised descriptor set."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(type_name))


@cache
def episode_class() -> type[Message]:
    """The protobuf class of `srlrace.Episode`."""
    return message_class(episode_schema(), EPISODE_TYPE)


class Layout:
    """Where each value of a fixed-width message lies in its bytes.

    ``dtype`` spans the whole message and names its values; ``template`` (itemsize,) uint8 is one message whose
    constant bytes (tags, lengths, strings) are set. numpy copies of a structured array leave out the bytes between
    its fields, so rows are made and moved as bytes.
    """

    def __init__(self, message: bytes, marks: Mapping[str, bytes], formats: Mapping[str, object]) -> None:
        offsets = {name: message.find(mark) for name, mark in marks.items()}
        if min(offsets.values()) < 0:
            raise AssertionError("a marked value is missing in its own message")
        spec = {
            "names": list(offsets),
            "offsets": list(offsets.values()),
            "formats": [formats[name] for name in offsets],
            "itemsize": len(message),
        }
        self.dtype = np.dtype(spec)  # type: ignore[call-overload]
        fixed = np.ones(len(message), bool)
        for name, offset in offsets.items():
            fixed[offset : offset + self.dtype[name].itemsize] = False
        self.template = np.where(fixed, np.frombuffer(message, np.uint8), 0).astype(np.uint8)
        self.constant = np.flatnonzero(fixed)  # offsets of the bytes that are the same in every message

    def fits(self, rows: np.ndarray) -> bool:
        """Whether every row of ``rows`` (N, itemsize) bytes has the constant bytes of this layout."""
        return bool((rows[:, self.constant] == self.template[self.constant]).all())


def _mark(index: int) -> float:
    """A double whose eight bytes occur nowhere else in a small message."""
    return float(struct.unpack("<d", struct.pack("<Q", 0x5A5AA5A5C3C30000 + index))[0])


def state_layout(reward_terms: Sequence[str]) -> Layout:
    """The layout of `srlrace.State`: one little-endian double per field."""
    values = {name: _mark(index) for index, name in enumerate(state_fields(reward_terms))}
    message = message_class(state_schema(reward_terms), STATE_TYPE)(**values)
    marks = {name: struct.pack("<d", value) for name, value in values.items()}
    return Layout(message.SerializeToString(deterministic=True), marks, dict.fromkeys(marks, "<f8"))


def pose_layout() -> Layout:
    """The layout of a foxglove.PoseInFrame in the world frame; the timestamp's two varints take 5 bytes each."""
    pose = PoseInFrame(frame_id=WORLD_FRAME)
    values: dict[str, float] = {}
    vectors = ((pose.pose.position, "position", "xyz"), (pose.pose.orientation, "quaternion", "wxyz"))
    for vector, prefix, axes in vectors:
        for axis in axes:
            values[f"{prefix}_{axis}"] = _mark(len(values))
            setattr(vector, axis, values[f"{prefix}_{axis}"])
    stamps = {"seconds": 0x5A5A5A5A, "nanos": 0x35A5A5A5}  # both long enough to need 5 bytes
    pose.timestamp.seconds, pose.timestamp.nanos = stamps["seconds"], stamps["nanos"]
    marks = {name: varint(np.array([value])).tobytes() for name, value in stamps.items()}
    marks |= {name: struct.pack("<d", value) for name, value in values.items()}
    formats: dict[str, object] = dict.fromkeys(values, "<f8")
    formats |= dict.fromkeys(stamps, (np.uint8, _VARINT_BYTES))
    return Layout(pose.SerializeToString(deterministic=True), marks, formats)


def varint(values: np.ndarray) -> np.ndarray:
    """Integers (N,) below 2^35 as protobuf varints padded to 5 bytes each (N, 5), which every parser takes."""
    shifts = 7 * np.arange(_VARINT_BYTES, dtype=np.int64)
    groups = (values.astype(np.int64)[:, None] >> shifts) & 0x7F
    groups[:, :-1] |= 0x80
    return groups.astype(np.uint8)
