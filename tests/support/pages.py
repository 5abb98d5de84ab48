"""What tests of pages in a browser share."""

from __future__ import annotations

from typing import Any

PATIENCE = 120_000  # ms; a page that hangs fails its test, a slow machine does not


def wait_until(page: Any, condition: str) -> None:
    """Wait for a JavaScript expression to become true; Playwright's own way evaluates text, which our pages forbid."""
    page.evaluate(f"""async () => {{
        const end = performance.now() + {PATIENCE};
        while (!({condition})) {{
            if (performance.now() > end) throw new Error("waited in vain");
            await new Promise(requestAnimationFrame);
        }}
    }}""")
