"""ES modules as one script: each becomes a function that returns what it exports.

The modules of the page use the plain forms only: ``import { a, b } from "./file.js";`` and ``export`` before a
function, class or const, or one ``export {a as b};`` at the end, as minifiers write it.
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r'^import\s*\{([^}]*)\}\s*from\s*"(\.[\w./-]+)";?\s*$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const)\b(?:\s*\*)?\s+(\w+))", re.MULTILINE)
_EXPORT_LIST = re.compile(r"export\s*\{([^{}]*)\};?\s*$")


class BundleError(ValueError):
    """A module that is missing, or written in a form that the bundler does not know."""


def bundle(entry: Path) -> str:
    """The script of a module and all that it imports, each once, imported ones first.

    Raises `BundleError` for an import that cannot be resolved, OSError for a file that cannot be read.
    """
    parts: dict[Path, str] = {}
    _add(entry.resolve(), entry.resolve().parent, parts, ())
    return "\n".join(parts.values())


def _add(path: Path, root: Path, parts: dict[Path, str], above: tuple[Path, ...]) -> None:
    if path in above:
        raise BundleError(f"{path.name} imports itself by way of {above[-1].name}")
    if path in parts or not path.is_relative_to(root):
        return
    text = path.read_text(encoding="utf-8")
    for _, target in _IMPORT.findall(text):
        _add((path.parent / target).resolve(), root, parts, (*above, path))
    parts[path] = _wrapped(text, path, root)


def _wrapped(text: str, path: Path, root: Path) -> str:
    """One module as ``const m_name = (() => { ...; return { exports }; })();``."""

    def local(match: re.Match[str]) -> str:
        names = match[1].replace(" as ", ": ").strip()
        return f"const {{ {names} }} = {_variable((path.parent / match[2]).resolve(), root)};"

    exports = {name: name for name in _EXPORT.findall(text)}
    listed = _EXPORT_LIST.search(text)
    if listed:
        pairs = (item.split(" as ") for item in listed[1].split(",") if item.strip())
        exports |= {pair[-1].strip(): pair[0].strip() for pair in pairs}
    body = _EXPORT.sub("", _EXPORT_LIST.sub("", _IMPORT.sub(local, text)))
    if re.search(r"^(import|export)\b", body, re.MULTILINE):
        raise BundleError(f"{path.name}: an import or export in a form that is not supported")
    returned = ", ".join(f"{name}: {value}" for name, value in exports.items())
    return f"const {_variable(path, root)} = (() => {{\n{body}\nreturn {{ {returned} }};\n}})();"


def _variable(path: Path, root: Path) -> str:
    return "m_" + re.sub(r"\W", "_", str(path.relative_to(root).with_suffix("")))
