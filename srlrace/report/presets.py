"""Which configuration a row of a table means, read from the presets without starting Hydra.

Hydra takes a tenth of a second for each row, two thirds of a report's time. Rows choose presets and little else, which
is quickly done by hand; a test holds the result against Hydra's for every row there is, and whatever is not understood
here goes to Hydra.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from srlrace.catalogue import SETTINGS
from srlrace.confdir import conf_dir
from srlrace.config import Config, ConfigError, parse_config
from srlrace.hydra_bridge import compose

GLOBAL = "# @package _global_"
OVERRIDE = "override /"
PLAIN = re.compile(r"[\w.+-]*|\[[\w.,+-]*\]", re.ASCII)


class _Unknown(Exception):
    """Something that only Hydra understands."""


@cache
def row_config(overrides: tuple[str, ...]) -> Config:
    """Return what ``srlrace train OVERRIDES`` would train; raises `ConfigError`, one line."""
    try:
        return parse_config(_compose(overrides))
    except (_Unknown, ConfigError):
        return compose(list(overrides))


def _compose(overrides: Sequence[str]) -> dict[str, Any]:
    data, _ = _load(conf_dir() / "train.yaml")
    defaults = dict(entry.popitem() for entry in data.pop("defaults") if isinstance(entry, dict))
    given = dict(word.split("=", 1) for word in overrides if "=" in word)
    if len(given) != len(overrides) or not given.keys() <= defaults.keys() | {"seed", "name"} | SETTINGS.keys():
        raise _Unknown
    chosen = _choices(defaults, given)
    for group, option in chosen.items():
        content, everywhere = _preset(group, option)
        content.pop("defaults", None)
        data |= content if everywhere else {group: content}
    for name, value in given.items():
        if name not in defaults:
            group, _, setting = name.rpartition(".")
            (data[group] if group else data)[setting] = _value(value)
    return data


def _value(text: str) -> Any:
    """Read a value that YAML and Hydra read alike: a number, true, false, a name, or a list of those."""
    if not PLAIN.fullmatch(text):
        raise _Unknown
    return yaml.safe_load(text)


def _choices(defaults: dict[str, str], given: dict[str, str]) -> dict[str, str]:
    """Return the option of each group: the row's, else what a chosen preset brings along, else the default."""
    chosen = defaults | {name: value for name, value in given.items() if name in defaults}
    for group in defaults:
        for entry in _preset(group, chosen[group])[0].get("defaults", ()):
            ((target, option),) = entry.items()
            brought, _, package = target.removeprefix(OVERRIDE).partition("@")
            if not target.startswith(OVERRIDE) or brought not in defaults or package not in ("", f"_global_.{brought}"):
                raise _Unknown
            if brought not in given:
                chosen[brought] = option
    return chosen


def _preset(group: str, option: str) -> tuple[dict[str, Any], bool]:
    path = conf_dir() / group / f"{option}.yaml"
    if "/" in option or not path.is_file():
        raise _Unknown
    content, everywhere = _load(path)
    entries = content.get("defaults", [])
    match entries:
        case [str(base)] if not everywhere:  # the preset that it starts from
            del content["defaults"]
            content = _preset(group, base)[0] | content
        case _ if any(isinstance(entry, str) for entry in entries):
            raise _Unknown
    return content, everywhere


def _load(path: Path) -> tuple[dict[str, Any], bool]:
    """Return a preset's content, and whether it stands for the whole configuration instead of its own group."""
    content, everywhere = _read(path)
    return deepcopy(content), everywhere


@cache
def _read(path: Path) -> tuple[dict[str, Any], bool]:
    text = path.read_text(encoding="utf-8")
    content = yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # noqa: S506 - both are safe
    if not isinstance(content, dict) or ("@package" in text and not text.startswith(GLOBAL)):
        raise _Unknown
    return content, text.startswith(GLOBAL)
