"""`srlrace replay`: flights of one or several policies, and a reference, as one page."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from srlrace.console import say
from srlrace.files import atomic_write
from srlrace.recording import Flight
from srlrace.replay.pack import pack_course, pack_flight, pack_obstacles
from srlrace.replay.page import render_page
from srlrace.replay.reference import Ghost
from srlrace.replay.rerun_export import write_rrd
from srlrace.replay.select import MAX_FLIGHTS, Selection, Wish, select, timed
from srlrace.replay.source import Source, open_source
from srlrace.runs import RunError
from srlrace.text import clean

NAME_LIMIT = 120  # characters of a name that are shown


@dataclass(frozen=True, eq=False)
class Shown:
    """A flight in the page."""

    source: Source
    flight: Flight
    time: float | None  # s: the lap's where laps are timed, else to the last gate
    visible: bool


def replay(
    root: Path,
    queries: Sequence[str],
    wish: Wish,
    suite: str = "train_map",
    ghost: Ghost | None = None,
    out: Path | None = None,
) -> Path:
    """Write the page and return its path; ``ghost`` overlays the time-optimal reference.

    An ``out`` that ends in .rrd gets the flights that are shown at first, for Rerun.
    Raises `RunError`, `ConfigError`, CorruptRecording or OSError with a message to the user.
    """
    sources = [open_source(root, query, suite) for query in queries]
    check_course(sources)
    shown = [flight for source in sources for flight in _flights(source, wish, sources[0])]
    if len(shown) > MAX_FLIGHTS:
        raise RunError(f"that makes {len(shown)} flights; a replay holds at most {MAX_FLIGHTS}")
    leading = next(item.flight for item in shown if item.visible)
    reference = ghost.flight(sources[0].config, leading) if ghost else None
    title = " · ".join(dict.fromkeys(_name(source.name) for source in sources))
    if out and out.suffix == ".rrd":
        write_rrd(out, title, sources[0].config, [item.flight for item in shown if item.visible])
        return out
    path = out or Path(f"{re.sub(r'[^A-Za-z0-9_.-]', '_', _name(sources[0].name)).lstrip('.')}-replay.html")
    atomic_write(path, render_page(f"{title} · srlrace replay", page_data(sources, shown, reference)))
    return path


def check_course(sources: Sequence[Source]) -> None:
    """Refuse to overlay flights through different worlds with `RunError`."""
    first = sources[0].config.env
    for source in sources[1:]:
        track = source.config.env
        if (track.waypoints, track.bounds_low, track.laps) != (first.waypoints, first.bounds_low, first.laps):
            raise RunError(f"{source.name} flies {track.name}, {sources[0].name} {first.name}: no common replay")


def _flights(source: Source, wish: Wish, first: Source) -> list[Shown]:
    """The flights of a source; further policies fly the episodes that the first one's were chosen from."""
    table = source.table if wish.needs_table or wish.episodes or source.recorded.empty else source.recorded
    chosen = select(table, wish) if source is first or wish.needs_table else _same(first, wish, table)
    say(f"{source.name}: {chosen.why}")
    times = dict(zip(source.table["episode"], timed(source.table), strict=True))
    flights = source.flights(chosen.episodes)
    return [Shown(source, flight, _finite(times[flight.episode]), flight.episode in chosen.shown)
            for flight in flights]  # fmt: skip


def _same(first: Source, wish: Wish, table: Any) -> Selection:
    leading = first.table if wish.episodes or first.recorded.empty else first.recorded
    chosen = select(leading, wish)
    numbers = tuple(number for number in chosen.shown if number in set(table["episode"]))
    if not numbers:
        return select(table, wish)
    return Selection(numbers, numbers, f"episode{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}")


def page_data(sources: Sequence[Source], shown: Sequence[Shown], reference: Flight | None) -> dict[str, Any]:
    """The data of the page, ready for JSON."""
    scenes: dict[tuple[Any, ...], int] = {}
    flights = []
    for item in shown:
        scene = scenes.setdefault(item.flight.scene, len(scenes))
        labels = {"run": sources.index(item.source), "scene": scene, "visible": item.visible, "ghost": False}
        flights.append(labels | _description(item.flight, item.time) | pack_flight(item.flight))
    if reference is not None:
        labels = {"run": -1, "scene": flights[0]["scene"], "visible": True, "ghost": True}
        flights.append(labels | _description(reference, _duration(reference)) | pack_flight(reference))
    return {
        "format": 1,
        "course": pack_course(sources[0].config),
        "runs": [_run(source) for source in sources],
        "scenes": [pack_obstacles(scene) for scene in scenes],
        "flights": flights,
    }


def _duration(flight: Flight) -> float:
    """How long a flight took, s: a delayed one counts from where it begins."""
    return float((flight.time[-1] if flight.finish_time is None else flight.finish_time) - flight.time[0])


def _description(flight: Flight, time: float | None) -> dict[str, Any]:
    return {
        "episode": flight.episode,
        "map": flight.map_seed,
        "outcome": _name(flight.outcome),
        "official": time,
        "finish": flight.finish_time,
    }


def _run(source: Source) -> dict[str, Any]:
    outcomes = source.table["outcome"].value_counts()
    return {
        "name": _name(source.name),
        "method": _name(source.method),
        "seed": source.config.seed,
        "suite": _name(source.suite),
        "episodes": len(source.table),
        "finished": int(outcomes.get("finished", 0)),
    }


def _name(text: str) -> str:
    """A stored name without characters that could move or hide its neighbours."""
    return clean(text)[:NAME_LIMIT]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
