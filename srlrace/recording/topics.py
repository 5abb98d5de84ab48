"""What a recording holds: the names of its parts, its timeline, and the check that a file has them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from google.protobuf import descriptor_pb2
from mcap.records import Channel, Schema

from srlrace.recording.archive import CorruptRecording
from srlrace.recording.schema import EPISODE_TYPE, STATE_TYPE, episode_schema, state_schema

LIBRARY = "srlrace"
"""Who wrote the file, without a version: the same flights give the same bytes."""

EPOCH = 946_684_800 * 10**9
"""Start of the timeline, ns: 2000-01-01T00:00:00Z. Any fixed time would do; zero reads as missing in some tools."""

STATE_TOPIC, POSE_TOPIC, SCENE_TOPIC, EPISODE_TOPIC = "/state", "/drone/pose", "/scene", "/episode"
METADATA_NAME = "srlrace"
PERIOD_KEY = "episode_period_ns"
CONFIG_NAME, EPISODES_NAME = "config.json", "episodes.csv"


@dataclass(frozen=True)
class Topics:
    """The channels of a recording whose schemas are this version's."""

    state: int  # channel ids
    scene: int
    episode: int
    period: int  # ns from the start of an episode to that of the next number
    reward_terms: tuple[str, ...]

    @classmethod
    def check(cls, schemas: Iterable[Schema], channels: Iterable[Channel]) -> Topics:
        """Find the topics of a file; raises CorruptRecording when one is missing or has another schema."""
        known = {schema.id: schema for schema in schemas}
        topics = {channel.topic: channel for channel in channels}
        for name in (STATE_TOPIC, SCENE_TOPIC, EPISODE_TOPIC):
            if name not in topics or topics[name].schema_id not in known:
                raise CorruptRecording(f"it has no topic {name}")
        state = known[topics[STATE_TOPIC].schema_id]
        terms = _reward_terms(state)
        if state.data != state_schema(terms) or known[topics[EPISODE_TOPIC].schema_id].data != episode_schema():
            raise CorruptRecording(f"its {STATE_TYPE} or {EPISODE_TYPE} has other fields than this version's")
        period = int(topics[STATE_TOPIC].metadata[PERIOD_KEY])
        if not 0 < period < 2**62:
            raise CorruptRecording("the distance of its episodes is no time")
        return cls(topics[STATE_TOPIC].id, topics[SCENE_TOPIC].id, topics[EPISODE_TOPIC].id, period, terms)


def _reward_terms(schema: Schema) -> tuple[str, ...]:
    if schema.name != STATE_TYPE or schema.encoding != "protobuf":
        raise CorruptRecording(f"{STATE_TOPIC} has schema {schema.name[:64]!r}, expected {STATE_TYPE!r}")
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data).file
    fields = [field.name for file in files for message in file.message_type for field in message.field]
    return tuple(name.removeprefix("reward_") for name in fields if name.startswith("reward_"))
