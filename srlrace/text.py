"""Text that is safe to show, and times that are easy to read."""

from __future__ import annotations

import unicodedata


def clean(text: object) -> str:
    """Text without control and direction characters: a stored name cannot move the cursor or hide letters."""
    plain = str(text)
    if plain.isprintable():
        return plain
    return "".join(c if unicodedata.category(c)[0] != "C" else "\ufffd" for c in plain)


def duration(seconds: float) -> str:
    """Return a time in hours, minutes and seconds, as clocks show it."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"
