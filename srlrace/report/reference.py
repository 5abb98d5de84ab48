"""Time-optimal references to compare flight times with."""

from __future__ import annotations

from srlrace.schema import Config


def reference_time(config: Config) -> float | None:
    """Return the best-known time of the configuration's track [s], or None where there is none yet."""
    return None
