"""One HTML file that needs nothing else, and is allowed nothing else.

Its content policy forbids everything but the one script and the one style sheet that it carries, by their
hashes: no network, no other script, no inline handler, whatever the names in a recording contain.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
from pathlib import Path
from typing import Any

from srlrace.replay.bundle import bundle

WEB = Path(__file__).parent / "web"


def render_page(title: str, data: dict[str, Any], web: Path = WEB) -> str:
    """The page with this title and these data; raises ValueError for data with NaN or infinities."""
    script = "\n" + bundle(web / "main.js") + "\n"
    style = "\n" + "\n".join((web / name).read_text(encoding="utf-8") for name in ("style.css", "panels.css"))
    for name, text in (("script", script), ("style", style)):
        if f"</{name}" in text.lower() or "<!--" in text:
            raise ValueError(f"the page's {name} would end early")
    parts = {
        "policy": content_policy(script, style),
        "title": html.escape(title),
        "style": style,
        "script": script,
        "data": inline_json(data),
    }
    page = (web / "page.html").read_text(encoding="utf-8")
    pieces = page.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:  # one pass: nothing that is filled in can be taken for a place to fill
        name, rest = piece.split("}}", 1)
        filled.append(parts[name] + rest)
    return "".join(filled)


def content_policy(script: str, style: str) -> str:
    """A Content-Security-Policy that allows these two texts and nothing else."""
    return (
        f"default-src 'none'; script-src {_source(script)}; style-src {_source(style)}; "
        "base-uri 'none'; form-action 'none'; require-trusted-types-for 'script'; trusted-types 'none'"
    )


def inline_json(data: Any) -> str:
    """JSON that no HTML parser takes for the end of its element."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
