"""The schemas, the layouts taken from them, and the documents that name their fields."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp

from srlrace.config import RewardConfig
from srlrace.recording.schema import (
    STATE_TYPE,
    message_class,
    pose_layout,
    state_fields,
    state_layout,
    state_schema,
    varint,
)

DOCS = Path(__file__).parents[3] / "docs"


def test_layout_puts_each_double_where_protobuf_looks_for_it() -> None:
    layout = state_layout(["a", "b"])
    names = state_fields(["a", "b"])
    row = layout.template.copy().view(layout.dtype)
    for value, name in enumerate(names):
        row[name] = value + 0.5
    state = message_class(state_schema(["a", "b"]), STATE_TYPE).FromString(row.view(np.uint8).tobytes())
    assert [getattr(state, name) for name in names] == [value + 0.5 for value in range(len(names))]


def test_layout_knows_its_constant_bytes() -> None:
    layout = pose_layout()
    rows = np.stack([layout.template] * 2)
    for stamp in ("seconds", "nanos"):
        rows.view(layout.dtype)[stamp] = varint(np.array([7]))
    assert layout.fits(rows)
    assert PoseInFrame.FromString(rows[0].tobytes()).frame_id == "world"
    rows[1, layout.constant[-1]] ^= 1
    assert not layout.fits(rows)


@pytest.mark.parametrize("value", [0, 1, 127, 128, 999_999_999, 946_684_800, 2**35 - 1])
def test_padded_varints_are_read_as_what_they_are(value: int) -> None:
    padded = b"\x08" + varint(np.array([value], np.uint64)).tobytes()
    assert len(padded) == 6
    assert Timestamp.FromString(padded).seconds == value


def test_field_numbers_stay() -> None:
    """Recordings outlive versions: adding a reward term must not move a state."""
    fields = message_class(state_schema(["a", "b"]), STATE_TYPE).DESCRIPTOR.fields_by_name
    numbers = {
        name: fields[name].number for name in ("episode", "time", "position_x", "target", "reward_a", "reward_b")
    }
    assert numbers == {"episode": 1, "time": 2, "position_x": 3, "target": 25, "reward_a": 64, "reward_b": 65}


def test_layout_of_the_viewer_names_fields_that_exist() -> None:
    terms = [field.name for field in dataclasses.fields(RewardConfig) if field.name != "name"]
    text = (DOCS / "layouts" / "flight.json").read_text()
    layout = json.loads(text)
    plotted = set(re.findall(r'"/state\.(\w+)"', text))
    assert plotted
    assert plotted <= set(state_fields(terms))
    topics = layout["configById"]["3D!flight"]["topics"]
    assert set(topics) == {"/scene", "/drone/pose"}
    assert set(panels(layout["layout"])) == set(layout["configById"])


def panels(tree: object) -> list[str]:
    """The panels of a layout's tree."""
    return panels(tree["first"]) + panels(tree["second"]) if isinstance(tree, dict) else [str(tree)]
