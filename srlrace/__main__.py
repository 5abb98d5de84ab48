"""``python -m srlrace`` and ``srlrace``: the command line as a process of its own."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

from srlrace import cli


def main() -> None:
    """Run the command line; after a signal, leave without tidying up.

    It was stopped wherever it was: also within LLVM, whose half-made objects may crash a process that tidies up.
    """
    try:
        _run()
    except KeyboardInterrupt:  # once more, while it was leaving
        os._exit(130)


def _run() -> None:
    try:
        cli.main()
    except SystemExit as leaving:
        if not isinstance(leaving.code, int) or leaving.code <= 128:
            raise
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):
                stream.flush()
        os._exit(leaving.code)


if __name__ == "__main__":
    main()
