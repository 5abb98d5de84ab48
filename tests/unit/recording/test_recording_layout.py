"""The layout for Foxglove and Lichtblick asks for topics and fields that a recording has."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from srlrace.recording.schema import state_fields
from srlrace.recording.topics import EPISODE_TOPIC, POSE_TOPIC, SCENE_TOPIC, STATE_TOPIC
from srlrace.task.reward import TERMS

LAYOUT = json.loads((Path(__file__).parents[3] / "docs" / "layouts" / "flight.json").read_text())
TOPICS = {EPISODE_TOPIC, POSE_TOPIC, SCENE_TOPIC, STATE_TOPIC}


def panels(node: Any) -> Iterator[str]:
    """The panels that a layout's tree places."""
    if isinstance(node, str):
        yield node
    else:
        yield from panels(node["first"])
        yield from panels(node["second"])


def plotted() -> list[str]:
    configs = LAYOUT["configById"].values()
    return [path["value"] for config in configs for path in config.get("paths", [])]


def test_every_panel_is_placed_once() -> None:
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_plots_ask_for_fields_that_exist() -> None:
    fields = set(state_fields(TERMS))
    for path in plotted():
        topic, field = path.split(".")
        assert topic == STATE_TOPIC
        assert field in fields, path
    assert {f"{STATE_TOPIC}.reward_{term}" for term in TERMS} <= set(plotted())


def test_the_3d_panel_shows_the_drone_in_its_scene() -> None:
    space = LAYOUT["configById"]["3D!flight"]
    assert {name for name, shown in space["topics"].items() if shown["visible"]} == {SCENE_TOPIC, POSE_TOPIC}
    assert space["followTf"] == "world"


def test_other_panels_read_topics_that_exist() -> None:
    paths = [config["topicPath"] for config in LAYOUT["configById"].values() if "topicPath" in config]
    assert paths == [EPISODE_TOPIC]
    assert set(paths) <= TOPICS
