"""The replay in headless Chromium: its numbers are the recording's, its controls work, nothing is wrong or leaks."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from courses import course_flight, record_course
from pages import wait_until

from srlrace.recording import Flight, read_flight
from srlrace.replay.command import replay
from srlrace.replay.reference import Ghost
from srlrace.replay.select import Wish

READY = "document.documentElement.dataset.interactive !== undefined"
HOSTILE = "</script><script>window.broken=1</script><img src=x onerror='window.broken=2'>\u202e\"&amp;"


@pytest.fixture(scope="module")
def flights(config: Any) -> list[Flight]:
    forest = config("env=forest")
    kinds = ((6.0, "finished"), (7.5, "finished"), (8.0, "crashed"))
    return [course_flight(forest, i, seconds, outcome) for i, (seconds, outcome) in enumerate(kinds)]


@pytest.fixture(scope="module")
def course(config: Any, flights: list[Flight], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_course(tmp_path_factory.mktemp("replay") / "flights.mcap", config("env=forest"), flights)


@pytest.fixture(scope="module")
def page(course: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One flight of median time, with the others in its list."""
    return replay(course.parent, [str(course)], Wish(), out=course.parent / "page.html")


@pytest.fixture
def paused(visit: Callable[..., Any], page: Path) -> Any:
    """The page, standing still at its start, from above: software draws that a hundred times faster."""
    return at(visit, page, "play=0", webgl=False).page


def at(visit: Callable[..., Any], page: Path, state: str, **options: Any) -> Any:
    opened = visit(page, fragment=state, **({"size": (900, 600)} | options))
    wait_until(opened.page, READY)
    return opened


def settle(page: Any) -> None:
    """Wait until what was asked for is drawn."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")


def text(page: Any, name: str) -> str:
    settle(page)
    return str(page.inner_text(f"#{name}")).replace("\u2212", "-")


def time(page: Any) -> float:
    settle(page)
    return float(page.evaluate("document.documentElement.dataset.time"))


@pytest.mark.parametrize("step", [0, 57, 201])
def test_numbers_are_the_recordings(visit: Callable[..., Any], page: Path, course: Path, step: int) -> None:
    recorded = read_flight(course, 0)
    shown = at(visit, page, f"play=0&t={recorded.time[step]}", webgl=False).page
    assert float(text(shown, "time")) == pytest.approx(recorded.time[step], abs=0.0051)
    assert float(text(shown, "speed")) == pytest.approx(np.linalg.norm(recorded.velocity_w[step]), abs=0.051)
    assert float(text(shown, "clearance")) == pytest.approx(recorded.clearance[step], abs=0.0051)
    assert int(text(shown, "gate")) == recorded.target[step]
    weight = 0.752 * 9.81
    assert float(text(shown, "thrust-sum")) == pytest.approx(recorded.rotor_thrust[step].sum() / weight, abs=0.0051)
    rates = [float(value.replace("\u2212", "-")) for value in shown.locator("#rates .value").all_inner_texts()]
    np.testing.assert_allclose(rates, recorded.body_rate_b[step], atol=0.051)
    thrusts = [float(value) for value in shown.locator("#thrust .value").all_inner_texts()]
    np.testing.assert_allclose(thrusts, recorded.rotor_thrust[step][[0, 1, 3, 2]], atol=0.051)


def test_list_tells_outcomes_and_times(paused: Any) -> None:
    rows = paused.locator("#list button").all_inner_texts()
    assert [row.split() for row in rows] == [
        ["Episode", "0", "6.00", "s"],
        ["Episode", "1", "7.50", "s"],
        ["Episode", "2", "Crashed"],
    ]
    assert text(paused, "summary") == "2 of 3 episodes finished on train_map"


def test_keys(paused: Any) -> None:
    press = paused.keyboard.press
    press("ArrowRight")
    press("ArrowRight")
    press(".")
    assert time(paused) == pytest.approx(0.22)
    press("ArrowLeft")
    press(",")
    assert time(paused) == pytest.approx(0.1)
    press("End")
    assert time(paused) == pytest.approx(6.0, abs=0.03)
    assert text(paused, "outcome") == "Finished"
    press("r")
    assert time(paused) == 0
    for camera in ("Top", "Free", "Follow"):
        press("c")
        settle(paused)
        assert camera in text(paused, "camera")
    press("+")
    settle(paused)
    assert text(paused, "rate") == "2\u00d7"
    press("-")
    press("-")
    settle(paused)
    assert text(paused, "rate") == "0.5\u00d7"
    press("n")
    settle(paused)
    assert text(paused, "pilot-name") == "Episode 1"
    press("p")
    press("p")
    press("End")
    settle(paused)
    assert (text(paused, "pilot-name"), text(paused, "outcome")) == ("Episode 2", "Crashed")
    press("Space")
    wait_until(paused, "Number(document.documentElement.dataset.time) > 0.02")
    press("Space")
    settle(paused)
    assert paused.get_attribute("#play", "aria-label") == "Play"
    press("?")
    assert paused.is_visible("#help")
    press("Escape")
    assert not paused.is_visible("#help")


def test_clicks_and_scrubbing(paused: Any) -> None:
    box = paused.locator("#scrub").bounding_box()
    paused.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert time(paused) == pytest.approx(3.0, abs=0.1)
    paused.click("#restart")
    assert time(paused) == 0
    paused.click("#play")
    wait_until(paused, "Number(document.documentElement.dataset.time) > 0.02")
    paused.click("#play")
    stopped = time(paused)
    assert time(paused) == stopped
    paused.locator("#list input").nth(1).check()
    paused.locator("#list button").nth(1).click()
    settle(paused)
    assert text(paused, "pilot-name") == "Episode 1"
    assert paused.locator("#list input:checked").count() == 2
    paused.click("#shells")
    settle(paused)
    assert paused.get_attribute("#shells", "aria-pressed") == "true"
    paused.click("#colouring")
    settle(paused)
    assert not paused.is_visible("#legend")
    before = paused.evaluate("document.documentElement.dataset.theme")
    paused.click("#theme")
    settle(paused)
    assert paused.evaluate("document.documentElement.dataset.theme") != before
    paused.click("#flights-button")
    assert not paused.is_visible("#flights")


def test_the_picture_moves_with_the_flight_and_the_hand(visit: Callable[..., Any], page: Path) -> None:
    paused = at(visit, page, "play=0").page

    def picture() -> bytes:
        settle(paused)
        return bytes(paused.locator("#view").screenshot())

    pictures = [picture()]
    paused.keyboard.press("End")
    pictures.append(picture())
    paused.mouse.move(450, 250)
    paused.mouse.down()
    paused.mouse.move(520, 270)
    paused.mouse.up()
    pictures.append(picture())
    paused.mouse.wheel(0, 300)
    pictures.append(picture())
    assert len(set(pictures)) == len(pictures)


@pytest.mark.parametrize("webgl", [True, False])
def test_view_is_what_the_browser_can(visit: Callable[..., Any], page: Path, webgl: bool) -> None:
    shown = at(visit, page, "play=0&t=2", webgl=webgl).page
    assert shown.evaluate("document.documentElement.dataset.view") == ("3D" if webgl else "2D")
    if not webgl:
        colours = "new Set(new Uint32Array(document.getElementById('view').getContext('2d').getImageData(0,0,900,600)"
        assert shown.evaluate(f"{colours}.data.buffer)).size") > 50


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(390, 844), (1280, 800), (3840, 2160)], ids=["phone", "laptop", "4k"])
def test_nothing_is_cut_off(visit: Callable[..., Any], page: Path, size: tuple[int, int], scheme: str) -> None:
    shown = at(visit, page, "play=0&t=2", size=size, scheme=scheme, webgl=False).page
    assert shown.evaluate("document.documentElement.dataset.theme") == scheme
    boxes = [shown.locator(f"#{name}").bounding_box() for name in ("title", "tools", "hud", "transport")]
    for box in boxes:
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= size[0]
        assert box["y"] + box["height"] <= size[1]
    for name in ("hud", "transport", "tools", "title"):
        overflow = shown.evaluate(f"(() => {{ const e = document.getElementById('{name}');"
                                  "return e.scrollWidth - e.clientWidth; })()")  # fmt: skip
        assert overflow <= 1, name
    tops = sorted(boxes, key=lambda box: box["y"])
    if size[0] < 820:
        for above, below in pairwise(tops):
            assert above["y"] + above["height"] <= below["y"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_accessibility(visit: Callable[..., Any], page: Path, scheme: str) -> None:
    opened = at(visit, page, "play=0&t=8", scheme=scheme, webgl=False)
    assert opened.violations() == []
    opened.page.keyboard.press("?")
    assert opened.violations() == []


def test_reduced_motion_waits_for_the_viewer(visit: Callable[..., Any], page: Path) -> None:
    still = at(visit, page, "", reduced_motion=True, webgl=False).page
    assert still.get_attribute("#play", "aria-label") == "Play"
    assert time(still) == 0
    moving = at(visit, page, "", webgl=False).page
    wait_until(moving, "Number(document.documentElement.dataset.time) > 0")


def test_hostile_names_are_inert(visit: Callable[..., Any], config: Any, tmp_path: Path) -> None:
    forest = config("env=forest")
    flights = [course_flight(forest, 0, 6.0), course_flight(forest, 1, 6.0, HOSTILE)]
    table = "episode,map,outcome,time_s\n0,0,finished,6.0\n1,0,crashed,\n"
    file = record_course(tmp_path / "a.mcap", forest, flights, run=HOSTILE, table=table)
    page = replay(tmp_path, [str(file)], Wish(overlay=2), out=tmp_path / "page.html")
    shown = at(visit, page, "play=0&t=6", webgl=False).page
    assert shown.evaluate("window.broken") is None
    assert shown.inner_text("#policy").startswith("</script><script>window.broken=1")
    assert shown.locator("img, main script").count() == 0


def test_policy_forbids_other_scripts(visit: Callable[..., Any], page: Path) -> None:
    opened = at(visit, page, "play=0", webgl=False)
    opened.page.evaluate(
        "() => { const s = document.createElement('script'); try { s.text = 'window.broken = 1'; } catch {}"
        "document.body.append(s); try { document.body.innerHTML += '<b>'; } catch { window.refused = true; } }"
    )
    assert opened.page.evaluate("[window.broken ?? null, window.refused]") == [None, True]
    assert any("Content Security Policy" in error or "TrustedHTML" in error for error in opened.errors)
    opened.errors.clear()


def test_policies_and_a_ghost_fly_together(
    visit: Callable[..., Any], config: Any, course: Path, tmp_path: Path
) -> None:
    forest = config("env=forest")
    other = record_course(tmp_path / "b.mcap", forest, [course_flight(forest, i, 6.5) for i in range(3)], run="other")
    ghost = Ghost(record_course(tmp_path / "g.mcap", forest, [course_flight(forest, 0, 4.6)], run="bound"))
    page = replay(tmp_path, [str(course), str(other)], Wish(episodes=(0,)), ghost=ghost, out=tmp_path / "page.html")
    shown = at(visit, page, "play=0&t=1", webgl=False).page
    assert shown.locator("#list .heading").all_inner_texts() == ["forest-srl-s0", "other"]
    assert shown.locator("#list input:checked").count() == 3
    assert shown.locator("#list button").last.inner_text().split() == ["Time-optimal", "reference", "4.60", "s"]
    colours = shown.evaluate("[...document.querySelectorAll('#list li:not(.heading)')]"
                             ".map((item) => item.style.getPropertyValue('--flight'))")  # fmt: skip
    assert len(set(colours)) == 3


def test_time_to_the_first_picture_is_told(
    visit: Callable[..., Any], page: Path, record_property: Callable[[str, object], None]
) -> None:
    """Its value depends on the machine: it is reported, not judged."""
    milliseconds = int(at(visit, page, "play=0").page.evaluate("document.documentElement.dataset.interactive"))
    record_property("replay_interactive_ms", milliseconds)
    record_property("replay_page_bytes", page.stat().st_size)
    assert milliseconds > 0
