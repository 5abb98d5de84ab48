"""Figures inside the page: matplotlib's SVG, without style attributes, in colours that follow the page's theme."""

from __future__ import annotations

import io
import re
from xml.etree import ElementTree

from srlrace.report.page.html import Html, tag, text
from srlrace.report.plots import Key, Panel, Plot, panel_figure
from srlrace.report.style import NAMES, SPEEDS, styled

SVG = "{http://www.w3.org/2000/svg}"
LINK = "{http://www.w3.org/1999/xlink}href"
DROPPED = ("metadata", "style")
GEOMETRY = ("d", "x", "y", "transform", "points", "width", "height")
NUMBER = re.compile(r"-?\d+\.\d{2,}")
REFERENCE = re.compile(r"#([\w-]+)")
SWATCH = {"o": "●", "D": "◇", "|": "❙", "s": "■", "x": "✕"}


def figure_html(plot: Plot) -> Html:
    """Return a plot's panels, legend and caption as a figure element."""
    with styled():
        panels = [panel_svg(panel, f"{plot.name}-{i}") for i, panel in enumerate(plot.panels)]
    caption = tag("figcaption", tag("strong", f"{plot.title}. "), plot.caption)
    legend = [tag("ul", *map(_key, plot.keys), class_="keys")] if plot.keys else []
    scale = [_speed_scale(plot.speed_mps)] if plot.speed_mps else []
    return tag("figure", tag("div", *panels, class_="panels"), *legend, *scale, caption, id=f"figure-{plot.name}")


def panel_svg(panel: Panel, name: str) -> Html:
    """Return one panel as an SVG element whose ids begin with ``name``."""
    figure = panel_figure(panel)
    figure.patch.set_visible(False)
    for axes in figure.axes:
        axes.patch.set_visible(False)
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    root = ElementTree.fromstring(stream.getvalue())  # what matplotlib has just written, nothing from outside
    referenced = {
        match for element in root.iter() for value in element.attrib.values() for match in REFERENCE.findall(value)
    }
    body = "".join(_element(child, name, referenced) for child in root)
    box = root.attrib["viewBox"]
    return Html(f'<svg viewBox="{box}" role="img" aria-label="{text(panel.alt)}">{body}</svg>')


def _element(element: ElementTree.Element, prefix: str, referenced: set[str]) -> str:
    name = element.tag.removeprefix(SVG)
    if name in DROPPED:
        return ""
    children = "".join(_element(child, prefix, referenced) for child in element)
    content = text(element.text.strip()) if element.text and element.text.strip() else ""
    attributes = _attributes(element, prefix, referenced)
    if name in ("g", "defs") and not attributes:
        return children if name == "g" else f"<defs>{children}</defs>" * bool(children)
    written = "".join(f' {key}="{text(value)}"' for key, value in attributes.items())
    return f"<{name}{written}>{content}{children}</{name}>"


def _attributes(element: ElementTree.Element, prefix: str, referenced: set[str]) -> dict[str, str]:
    found = dict(element.attrib)
    style = (part.split(":", 1) for part in found.pop("style", "").split(";") if ":" in part)
    found |= {key.strip(): value.strip() for key, value in style}
    found.pop("font-family", None)  # the page's
    if found.get("id") not in referenced:
        found.pop("id", None)
    if LINK in found:
        found["href"] = found.pop(LINK)
    return {key: _value(key, value, prefix) for key, value in found.items()}


def _value(key: str, value: str, prefix: str) -> str:
    if key in GEOMETRY:
        rounded = NUMBER.sub(lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), value)
        return " ".join(rounded.split())
    if key == "id":
        return f"{prefix}-{value}"
    if "#" in value and value not in NAMES:
        return REFERENCE.sub(rf"#{prefix}-\1", value)
    return f"var({NAMES[value]})" if value in NAMES else value


def _key(key: Key) -> Html:
    colour = f"var({NAMES[key.colour]})"
    if key.marker:
        return tag(
            "li", tag("span", SWATCH[key.marker], class_=f"mark {NAMES[key.colour][2:]}", aria_hidden="true"), key.label
        )
    dashes = key.dashes[1] if isinstance(key.dashes, tuple) else ()
    line = f'<path d="M1 5H27" stroke="{colour}" stroke-width="2.4" stroke-dasharray="{_dash(dashes)}"></path>'
    return tag("li", Html(f'<svg class="swatch" viewBox="0 0 28 10" aria-hidden="true">{line}</svg>'), key.label)


def _dash(dashes: tuple[float, ...]) -> str:
    return " ".join(f"{1.6 * length:g}" for length in dashes) or "none"


def _speed_scale(top: float) -> Html:
    boxes = "".join(
        f'<rect x="{20 * i}" width="20" height="10" fill="var({NAMES[c]})"></rect>' for i, c in enumerate(SPEEDS)
    )
    bar = Html(f'<svg viewBox="0 0 {20 * len(SPEEDS)} 10" aria-hidden="true">{boxes}</svg>')
    return tag("p", "0", bar, f"{top:g} m/s", class_="scale", aria_label=f"Colours from 0 to {top:g} m/s")
