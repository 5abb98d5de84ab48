"""What a replay page carries: numbers as exact as promised, obstacles as they collide, nothing that could run."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from courses import course_flight, record_course

from srlrace.config import Config
from srlrace.recording import SceneObstacle
from srlrace.replay.bundle import BundleError, bundle
from srlrace.replay.command import replay
from srlrace.replay.pack import COLUMNS, MISSING, pack_flight, pack_obstacles
from srlrace.replay.page import WEB, inline_json
from srlrace.replay.reference import Ghost, solution_flight
from srlrace.replay.select import Wish
from srlrace.runs import RunError
from srlrace.world import obstacles

HOSTILE = "</script><script>alert(1)</script>\u202e\"'&<img src=x onerror=alert(2)>"


@pytest.fixture(scope="module")
def forest(config: Any) -> Config:
    return config("env=forest")  # type: ignore[no-any-return]


class Scripts(HTMLParser):
    """The scripts and elements of a page as a parser of HTML sees them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.data = ""
        self._inside = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._inside = ("id", "data") in attrs

    def handle_endtag(self, tag: str) -> None:
        self._inside = False

    def handle_data(self, data: str) -> None:
        self.data += data if self._inside else ""


def unpack(packed: dict[str, Any]) -> np.ndarray:
    levels = np.frombuffer(base64.b64decode(packed["values"]), "<u2").reshape(len(packed["scale"]), packed["steps"])
    low, step = np.array(packed["scale"]).T
    return np.where(levels == MISSING, np.nan, low[:, None] + step[:, None] * levels)


def test_values_are_as_exact_as_promised(forest: Config) -> None:
    flight = course_flight(forest, 3, 6.0)
    table = np.column_stack([np.asarray(getattr(flight, name)) for name in COLUMNS]).T
    found = unpack(pack_flight(flight))
    spread = table.max(axis=1) - table.min(axis=1)
    assert (np.abs(found - table).max(axis=1) <= spread / 65_534 / 2 + 1e-12).all()


def test_missing_values_stay_missing(forest: Config) -> None:
    flight = course_flight(forest, 3, 6.0)
    flight.clearance[:] = np.inf
    flight.rotor_thrust[5, 2] = np.nan
    found = unpack(pack_flight(flight))
    assert np.isnan(found[-1]).all()
    assert np.argwhere(np.isnan(found[:-1])).tolist() == [[3 + 3 + 4 + 3 + 2, 5]]


def test_obstacles_are_those_that_collide() -> None:
    scene = (SceneObstacle("box", (1.0, 2.0, 3.0), edge=2.0), SceneObstacle("cylinder", (0.0, 0.0, 4.0), 0.3, 8.0))
    packed = pack_obstacles(scene)
    [[*_, edge, count, radius]] = packed["box"]
    box = obstacles.box((1.0, 2.0, 3.0), 2.0)
    assert (edge, count, radius) == (2.0, box.count[0], pytest.approx(box.sphere_radius, abs=1e-4))
    [[*_, low, high]] = packed["cylinder"]
    heights = obstacles.cylinder((0.0, 0.0, 4.0), 0.3, 8.0).spheres()[:, 2]
    assert (low, high) == (pytest.approx(heights.min(), abs=1e-4), pytest.approx(heights.max(), abs=1e-4))


def test_json_cannot_end_its_element() -> None:
    text = inline_json({"name": HOSTILE})
    assert not set("<>&") & set(text)
    assert json.loads(text)["name"] == HOSTILE


def test_hostile_names_are_data(forest: Config, tmp_path: Path) -> None:
    flights = [course_flight(forest, 0, 6.0), course_flight(forest, 1, 6.0, HOSTILE)]
    file = record_course(tmp_path / "a.mcap", forest, flights, run=HOSTILE, table=_table())
    page = replay(tmp_path, [str(file)], Wish(overlay=2), out=tmp_path / "page.html").read_text()
    seen = Scripts(page)
    assert seen.tags.count("script") == 2
    assert "img" not in seen.tags
    assert "\u202e" not in page
    assert json.loads(seen.data)["flights"][1]["outcome"].startswith("</script><script>alert(1)")
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    assert policy[1].startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy[1]


def _table() -> str:
    return "episode,map,outcome,time_s\n0,0,finished,6.0\n1,0,crashed,\n"


def test_a_page_of_one_flight_is_small(forest: Config, tmp_path: Path) -> None:
    file = record_course(tmp_path / "a.mcap", forest, [course_flight(forest, 0, 7.0)])
    page = replay(tmp_path, [str(file)], Wish(episodes=(0,)), out=tmp_path / "page.html")
    flight = json.loads(Scripts(page.read_text()).data)["flights"][0]
    assert page.stat().st_size < 1e6
    assert len(json.dumps(flight)) < 30_000


def test_unrecorded_episodes_of_a_file_are_refused(forest: Config, tmp_path: Path) -> None:
    table = "episode,map,outcome,time_s\n0,0,finished,6.0\n1,0,crashed,\n"
    file = record_course(tmp_path / "a.mcap", forest, [course_flight(forest, 0, 6.0)], table=table)
    with pytest.raises(RunError, match="no recording of episode 1"):
        replay(tmp_path, [str(file)], Wish(episodes=(1,)), out=tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


def test_other_courses_share_no_page(forest: Config, config: Any, tmp_path: Path) -> None:
    split = config("env=split_s")
    files = [
        record_course(tmp_path / f"{c.env.name}.mcap", c, [course_flight(c, 0, 6.0)], run=c.env.name)
        for c in (forest, split)
    ]
    with pytest.raises(RunError, match="no common replay"):
        replay(tmp_path, [str(file) for file in files], Wish(), out=tmp_path / "page.html")


def test_a_lap_reference_starts_with_the_lap(config: Any) -> None:
    split = config("env=split_s")
    gates = np.array(split.env.waypoints)
    corners = np.vstack([gates, gates[:1]])
    state = np.zeros((7 * 20 + 1, 13))
    state[:, :3] = np.array([np.interp(np.arange(141) / 20, np.arange(8), corners[:, axis]) for axis in range(3)]).T
    state[:, 6] = 1
    lap = solution_flight(split, np.linspace(0, 5.0, 141), state, np.ones((141, 4)))
    assert lap.target[[0, 1, 20, 21, 140]].tolist() == [0, 1, 2, 2, 0]
    assert len(np.flatnonzero(np.diff(lap.target))) == 7


@pytest.mark.parametrize("env", ["forest", "split_s"])
def test_the_stored_reference_flies_through_the_gates(config: Any, env: str) -> None:
    settings = config(f"env={env}")
    first = course_flight(settings, 0, 7.0)
    ghost = Ghost().flight(settings, first)
    start = first.time[np.argmax(first.target != first.target[0])] if settings.env.laps else 0.0
    assert ghost.time[0] == pytest.approx(start)
    for gate in ghost.waypoints:
        nearest = np.linalg.norm(ghost.position_w - gate, axis=1).min()
        assert nearest < settings.env.passing_radius + 1e-3


def test_a_reference_of_another_track_is_refused(forest: Config, config: Any, tmp_path: Path) -> None:
    split = config("env=split_s")
    file = record_course(tmp_path / "ref.mcap", split, [course_flight(split, 0, 6.0)])
    with pytest.raises(RunError, match="another track"):
        Ghost(file).flight(forest, course_flight(forest, 0, 6.0))


def test_modules_are_bundled_in_order(tmp_path: Path) -> None:
    (tmp_path / "main.js").write_text('import { one, two } from "./part.js";\nconsole.log(one, two());\n')
    (tmp_path / "part.js").write_text("export const one = 1;\nexport function two() { return 2; }\n")
    script = bundle(tmp_path / "main.js")
    assert script.index("const m_part") < script.index("const m_main")
    assert "return { one: one, two: two };" in script
    assert "const { one, two } = m_part;" in script


@pytest.mark.parametrize("line", ['import x from "./part.js";', "export default 3;", 'import "./part.js";'])
def test_unknown_forms_of_modules_are_refused(line: str, tmp_path: Path) -> None:
    (tmp_path / "part.js").write_text("export const x = 1;\n")
    (tmp_path / "main.js").write_text(line + "\n")
    with pytest.raises(BundleError, match=r"main\.js"):
        bundle(tmp_path / "main.js")


def test_modules_import_what_exists() -> None:
    """A name that is imported and not exported would be undefined only when it is used."""
    exported: dict[str, set[str]] = {}
    for path in [*WEB.glob("*.js"), *WEB.glob("three/*.min.js")]:
        text = path.read_text()
        listed = re.search(r"export\s*\{([^{}]*)\};?\s*$", text)
        names = {item.split(" as ")[-1].strip() for item in listed[1].split(",")} if listed else set()
        exported[path.name] = names | set(re.findall(r"^export (?:function|class|const) (\w+)", text, re.MULTILINE))
    for path in WEB.glob("*.js"):
        for names, target in re.findall(r'^import \{([^}]*)\} from "([^"]+)"', path.read_text(), re.MULTILINE):
            wanted = {name.strip() for name in names.split(",") if name.strip()}
            assert wanted <= exported[Path(target).name], path.name
