"""HTML by small functions: whatever is not marked as HTML is escaped, so that a hostile name stays a name."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

from srlrace.text import clean

VOID = ("meta", "br", "hr")


class Html(str):
    """Text that is HTML already."""


def text(value: object) -> Html:
    """Return anything as text: escaped, without control and direction characters."""
    return value if isinstance(value, Html) else Html(escape(clean(value)))


def join(parts: Iterable[object], separator: str = "") -> Html:
    """Return the parts one after the other, each escaped unless it is HTML."""
    return Html(text(separator).join(text(part) for part in parts))


def tag(name: str, /, *children: object, **attributes: object) -> Html:
    """Return an element; ``class_`` means class and ``data_x`` data-x, True is an attribute alone, None is none."""
    words = [name]
    for key, value in attributes.items():
        if value is not None and value is not False:
            written = key.rstrip("_").replace("_", "-")
            words.append(written if value is True else f'{written}="{text(str(value))}"')
    opened = f"<{' '.join(words)}>"
    return Html(opened if name in VOID else f"{opened}{join(children)}</{name}>")


def scrolling(table: Html, label: str) -> Html:
    """Return a wide table that scrolls by itself, by keyboard as well."""
    return tag("div", table, class_="scroll", tabindex="0", role="region", aria_label=label)
