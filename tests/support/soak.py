"""Whether the tests of failures run in full, as ``make soak`` does, or in the small version of the default tests."""

from __future__ import annotations

import os

SOAKED = os.environ.get("SRLRACE_SOAK") == "1"
