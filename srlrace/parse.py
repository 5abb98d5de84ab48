"""Plain data into the schema's dataclasses: unknown names, wrong types and wrong ranges are refused.

Every refusal is a `ConfigError` of one line that names the setting, what it got and what it takes.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
NAME_MEANING = "a name of letters, digits, '.', '_' and '-', at most 64, beginning with a letter or digit"
DECIMAL_COMMA = re.compile(r"\s*([+-]?\d+),(\d+)\s*")

Schema = TypeVar("Schema")


class ConfigError(ValueError):
    """A setting that cannot be used; the message is one line for the person who wrote it."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """One leaf of the schema: its dotted path, its type and what was declared about it."""

    path: str
    kind: Any
    field: dataclasses.Field[Any]

    @property
    def takes(self) -> str:
        """What the setting takes, in words."""
        return describe(self.kind, self.field.metadata)


def nearest(word: str, valid: Iterable[str]) -> str:
    """The valid name closest to a mistyped one, as ``; did you mean X?``, or nothing when none is close."""
    by_case = {name.lower(): name for name in valid}
    match = difflib.get_close_matches(word.lower(), by_case, n=1, cutoff=0.5)
    return f"; did you mean {by_case[match[0]]}?" if match else ""


def show(value: Any) -> str:
    """A value as it may stand in a one-line message: escaped, and cut when long."""
    try:
        text = repr(value)
    except ValueError:  # an integer too long for Python to print
        text = "an enormous number"
    return text if len(text) <= 60 else text[:57] + "..."


def label(name: object) -> str:
    """A name as it may stand in a message: itself when it is harmless, else escaped."""
    return str(name) if re.fullmatch(r"[\w./@-]{1,64}", str(name), re.ASCII) else show(name)


@cache
def kinds(schema: Any) -> Mapping[str, Any]:
    """The resolved type of each field of a dataclass."""
    return get_type_hints(schema)


@cache
def settings(schema: type, prefix: str = "") -> tuple[Setting, ...]:
    """Every leaf below a dataclass, in order of declaration."""
    return tuple(_leaves(schema, prefix))


def _leaves(schema: type, prefix: str) -> Iterator[Setting]:
    for field in dataclasses.fields(schema):
        kind = kinds(schema)[field.name]
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            yield from settings(kind, f"{prefix}{field.name}.")
        else:
            yield Setting(prefix + field.name, kind, field)


def parse(schema: type[Schema], data: Any, path: str = "") -> Schema:
    """Build a dataclass of the schema from plain data, checking everything below it."""
    where = path or "the configuration"
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: got {show(data)}; takes {describe(schema, {})}")
    fields = {field.name: field for field in dataclasses.fields(schema)}  # type: ignore[arg-type]
    for key in data:
        if key not in fields:
            raise ConfigError(f"{_join(path, label(key))}: no such setting{nearest(str(key)[:64], fields)}")
    values = {}
    types: Mapping[str, Any] = kinds(cast(Any, schema))
    for name, field in fields.items():
        if name in data:
            values[name] = parse_value(types[name], field.metadata, data[name], _join(path, name))
        elif field.default is dataclasses.MISSING:
            raise ConfigError(f"{_join(path, name)}: missing; takes {describe(types[name], field.metadata)}")
    return schema(**values)


def parse_value(kind: Any, bounds: Mapping[str, Any], value: Any, path: str) -> Any:
    """Check one value against its declared type and bounds; lists become tuples, whole numbers floats."""
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return parse(kind, value, path)
    if get_origin(kind) is tuple:
        return _parse_tuple(kind, bounds, value, path)
    checked = value
    if kind is float and isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63:
        checked = float(value)
    if type(checked) is not kind or not _within(checked, bounds):
        raise ConfigError(f"{path}: got {show(value)}; takes {describe(kind, bounds)}{_hint(kind, bounds, value)}")
    return checked


def _parse_tuple(kind: Any, bounds: Mapping[str, Any], value: Any, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{path}: got {show(value)}; takes {describe(kind, bounds)}")
    items = get_args(kind)
    fixed = items[-1] is not Ellipsis
    low, high = (len(items), len(items)) if fixed else (bounds["least"], bounds["most"])
    if not low <= len(value) <= high:
        raise ConfigError(f"{path}: got {len(value)} elements; takes {describe(kind, bounds)}")
    return tuple(parse_value(items[0], bounds, item, f"{path}[{i}]") for i, item in enumerate(value))


def _within(value: Any, bounds: Mapping[str, Any]) -> bool:
    if isinstance(value, str):
        return value in bounds["choices"] if bounds["choices"] else _is_name(value, bounds)
    if isinstance(value, bool):
        return True
    low, high, above = bounds["low"], bounds["high"], bounds["above"]
    return (
        math.isfinite(value)
        and (low is None or value >= low)
        and (high is None or value <= high)
        and (above is None or value > above)
    )


def _is_name(value: str, bounds: Mapping[str, Any]) -> bool:
    return bool(NAME.fullmatch(value)) or (value == "" and bounds.get("optional", False))


def describe(kind: Any, bounds: Mapping[str, Any]) -> str:
    """What a setting of this type and these bounds takes, in words."""
    if dataclasses.is_dataclass(kind):
        return "settings " + ", ".join(field.name for field in dataclasses.fields(kind))
    if get_origin(kind) is tuple:
        return _describe_tuple(kind, bounds)
    if kind is bool:
        return "true or false"
    if kind is str:
        return "one of " + ", ".join(bounds["choices"]) if bounds["choices"] else NAME_MEANING
    noun = "a whole number" if kind is int else "a number"
    low, high, above = (bounds.get(key) for key in ("low", "high", "above"))
    limits = [
        f"{sign} {bound if isinstance(bound, int) else f'{bound:g}'}"
        for sign, bound in ((">", above), (">=", low), ("<=", high))
        if bound is not None
    ]
    unit = f" [{bounds['unit']}]" if bounds.get("unit") else ""
    return " ".join([noun, " and ".join(limits)]).rstrip() + unit


def _describe_tuple(kind: Any, bounds: Mapping[str, Any]) -> str:
    items = get_args(kind)
    if items[-1] is not Ellipsis:
        return f"a list of {len(items)}, each {describe(items[0], bounds)}"
    return f"a list of {bounds['least']} to {bounds['most']}, each {describe(items[0], bounds)}"


def _hint(kind: Any, bounds: Mapping[str, Any], value: Any) -> str:
    if kind in (int, float) and isinstance(value, str) and (comma := DECIMAL_COMMA.fullmatch(value)):
        return f"; decimal comma? write {comma[1]}.{comma[2]}"
    if kind is str and bounds["choices"]:
        return nearest(str(value)[:64], bounds["choices"])
    return ""


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name
