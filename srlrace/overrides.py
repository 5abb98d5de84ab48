"""What the user wrote after ``srlrace train``, checked against the schema before Hydra sees it.

Hydra accepts much that would silently do nothing or do harm: settings nobody reads, interpolations that
read the environment, output folders anywhere, options that unpickle. Here each argument is either
understood and rewritten in a form Hydra cannot misread, or refused with one line. Imports no Hydra.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from srlrace.catalogue import GROUPS, SETTINGS, choices, unknown
from srlrace.options import Options, split_options
from srlrace.parse import DECIMAL_COMMA, ConfigError, Setting, describe, label, nearest, parse_value, show

SWEEP_FUNCTION = re.compile(r"(range|choice)\([\w\s.,+-]*\)")
PLAIN_LIST = re.compile(r"\[[\w\s.,+\-\[\]{}:'\"]*\]")
LAUNCHER = re.compile(r"hydra/launcher|hydra\.launcher\.[A-Za-z]\w*(\.[A-Za-z]\w*)*")
TRACK_FILE = re.compile(r".*(/|\\|\.ya?ml$)")


@dataclass(frozen=True)
class Request:
    """A checked command line: overrides that Hydra can take literally, and the options beside them."""

    overrides: tuple[str, ...]
    options: Options


def check_arguments(arguments: Sequence[str]) -> Request:
    """Check a command line of overrides and Hydra's options; raises `ConfigError`, one line."""
    options, words = split_options(arguments)
    checked: dict[str, list[str]] = {}
    for word in words:
        key, value = _split_word(word)
        if key in checked:
            raise ConfigError(f"{key}: given twice")
        checked[key] = list(_check_word(key, value, options))
    if len(checked.get("env", [])) > 1:  # a track file, written out as settings: what the user sets comes after it
        track = checked.pop("env")
        level = [] if "level" in checked else ["level='none'"]
        checked = {"env": [*level, *track]} | checked
    return Request(tuple(word for group in checked.values() for word in group), options)


def _split_word(word: str) -> tuple[str, str]:
    key, equals, value = word.partition("=")
    if key.startswith("~"):
        raise ConfigError(f"{show(word)}: a setting cannot be removed; choose another value for it")
    bare = key.lstrip("+")
    if bare != key and (bare in SETTINGS or bare in GROUPS):
        raise ConfigError(f"{show(word)}: the setting exists already; write {bare}={value}")
    if not equals:
        raise ConfigError(f"{show(word)}: not a setting; takes name=value{_as_choice(word)}")
    if "${" in value or "${" in key:
        raise ConfigError(f"{label(bare)}: got {show(value)}; takes a plain value"
                          " (nothing is interpolated)")  # fmt: skip
    return bare, value.strip()


def _as_choice(word: str) -> str:
    found = [group for group in GROUPS if word in choices(group)]
    return f"; did you mean {found[0]}={word}?" if found else ""


def _check_word(key: str, value: str, options: Options) -> Iterator[str]:
    if key == "hydra/launcher":
        yield f"{key}={_quote(_unquote(value))}"  # a name even where it looks like a number
    elif LAUNCHER.fullmatch(key):
        yield f"{key}={value}"
    elif key in GROUPS:
        yield from _check_choice(key, value, options)
    elif key in SETTINGS:
        yield f"++{key}={_check_setting(SETTINGS[key], value, options.multirun)}"
    else:
        raise ConfigError(unknown(key))


def _check_choice(group: str, value: str, options: Options) -> Iterator[str]:
    valid = choices(group, options.config_dirs)
    names = [_unquote(name) for name in _parts(group, value, options.multirun)]
    if group == "env" and len(names) == 1 and names[0] not in valid and TRACK_FILE.match(names[0]):
        from srlrace.own_track import track_overrides

        yield from track_overrides(names[0])
        return
    for name in names:
        if name not in valid:
            takes = ", ".join(valid) + (", or the path of a track.yaml" if group == "env" else "")
            raise ConfigError(f"{group}: got {show(name)}; takes one of {takes}{nearest(name, valid)}")
    yield f"{group}={','.join(map(_quote, names))}"


def _check_setting(setting: Setting, value: str, multirun: bool) -> str:
    if multirun and SWEEP_FUNCTION.fullmatch(value):
        return value
    comma = DECIMAL_COMMA.fullmatch(value) if setting.kind in (int, float) else None
    if comma and (not multirun or comma[2].startswith("00")):
        hint = "; several values: add -m" if not multirun else ""
        raise ConfigError(
            f"{setting.path}: got {show(value)}; takes {setting.takes};"
            f" decimal comma? write {comma[1]}.{comma[2]}{hint}"
        )
    return ",".join(_check_part(setting, part) for part in _parts(setting.path, value, multirun))


def _check_part(setting: Setting, text: str) -> str:
    """Check one value and write it so that Hydra reads back exactly that."""
    if setting.kind not in (int, float, bool, str):
        if not PLAIN_LIST.fullmatch(text):
            raise ConfigError(
                f"{setting.path}: got {show(text)}; takes {describe(setting.kind, setting.field.metadata)}"
            )
        return text
    value = parse_value(setting.kind, setting.field.metadata, read_scalar(text, setting.kind), setting.path)
    return _quote(value) if isinstance(value, str) else repr(value).lower() if isinstance(value, bool) else repr(value)


def read_scalar(text: str, kind: Any) -> Any:
    """Read what the user wrote as the kind of value the setting takes; the text itself when it is not one."""
    if kind is str:
        return _unquote(text)
    if kind is bool:
        return {"true": True, "false": False}.get(text.lower(), text)
    with suppress(ValueError):
        return int(text)
    with suppress(ValueError):
        number = float(text)
        return int(number) if kind is int and number.is_integer() else number
    return text


def _parts(path: str, value: str, multirun: bool) -> list[str]:
    """Split at the commas that mean several runs; those inside brackets and quotes do not."""
    parts, depth, quote = [""], 0, ""
    for character in value:
        quote = "" if character == quote else quote or (character if character in "'\"" else "")
        depth += 0 if quote else (character in "[{(") - (character in "]})")
        if character == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += character
    if len(parts) > 1 and not multirun:
        raise ConfigError(f"{path}: got {show(value)}; takes one value; to train one run for each, add -m")
    return [part.strip() for part in parts]


def _unquote(text: str) -> str:
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if quoted else text


def _quote(text: str) -> str:
    return f"'{text}'"
