"""The validated configuration of a run: built once from plain data, and its identity.

Hydra composes plain data from ``conf/``; `parse_config` turns it into one frozen `Config`, and
everything downstream takes the `Config`. A stored ``config.json`` is read back by the same function,
so what a stranger's file may hold is what the schema allows and nothing else.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from srlrace.checks import check
from srlrace.files import FileError, parse_json, read_limited
from srlrace.parse import ConfigError, parse, parse_value
from srlrace.schema import (
    AlgoConfig,
    Config,
    CurriculumConfig,
    LevelConfig,
    ObservationConfig,
    ObstacleConfig,
    QuadConfig,
    RandomizationConfig,
    RewardConfig,
    SimConfig,
    SpacingConfig,
    TrackConfig,
    Vec3,
)

__all__ = [
    "AlgoConfig",
    "Config",
    "ConfigError",
    "CurriculumConfig",
    "LevelConfig",
    "ObservationConfig",
    "ObstacleConfig",
    "QuadConfig",
    "RandomizationConfig",
    "RewardConfig",
    "SimConfig",
    "SpacingConfig",
    "TrackConfig",
    "Vec3",
    "fingerprint",
    "load_config",
    "method_name",
    "parse_config",
    "run_id",
    "stored_config",
    "to_dict",
]

TRACK_CHARACTERS = 20  # of a run id: with the seed and the hash, an id stays within the 64 of a name
METHOD_CHARACTERS = 22
PRESETS = 2048  # configurations that are kept, seeds not counted; a large study has a thousand
SEED = next(field for field in dataclasses.fields(Config) if field.name == "seed")
SEED_LINE = re.compile(rb'^ "seed": (\d{1,20}),\n', re.MULTILINE)  # as `train` writes it; no string has line breaks


def parse_config(data: Mapping[str, Any]) -> Config:
    """Check plain data and build the configuration from it; raises `ConfigError`, one line."""
    config = parse(Config, data)
    check(config)
    return config


def load_config(path: Path) -> Config:
    """Read a stored ``config.json``; raises `ConfigError` naming the file."""
    try:
        content = read_limited(path)
    except FileError as error:
        raise ConfigError(str(error)) from None
    return stored_config(content, path)


def stored_config(content: bytes, path: Path) -> Config:
    """The configuration that was read from ``path``; raises `ConfigError` naming it."""
    try:
        return _parse_stored(content, path)
    except FileError as error:
        raise ConfigError(str(error)) from None
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _parse_stored(content: bytes, path: Path) -> Config:
    """The same as `parse_config`, but what differs only in the seed, as the runs of a sweep do, is parsed once."""
    parts = SEED_LINE.split(content)
    if len(parts) == 3:
        with suppress(FileError, ConfigError):  # said below, with the file's name
            seed = parse_value(int, SEED.metadata, int(parts[1]), "seed")
            return dataclasses.replace(_parse_seedless(parts[0] + parts[2]), seed=seed)
    return parse_config(parse_json(content, path))


@lru_cache(maxsize=PRESETS)
def _parse_seedless(content: bytes) -> Config:
    data = parse_json(content, Path())
    if "seed" in data:
        raise ConfigError("seed: given twice")
    return parse_config({**data, "seed": 0})


def to_dict(config: Any) -> dict[str, Any]:
    """A configuration, or a part of one, as plain JSON data; `parse_config` reads it back unchanged."""
    return {field.name: _plain(getattr(config, field.name)) for field in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def fingerprint(config: Config) -> str:
    """SHA-256 of what defines the run, in hexadecimal.

    Settings at the default that the schema declares are left out, so that a setting added later,
    whose default is the old behaviour, does not rename every run made before.
    """
    text = json.dumps(_essence(config), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _essence(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_essence(item) for item in value]
    if not dataclasses.is_dataclass(value):
        return value
    fields = ((field, getattr(value, field.name)) for field in dataclasses.fields(value))
    return {field.name: _essence(item) for field, item in fields if item != field.default}


def method_name(config: Config) -> str:
    """What the run is called in ids and lists: its label, its baseline, or its reward and observation."""
    if config.name:
        return config.name
    name, usual = (config.baseline, config.baseline) if config.baseline != "none" else (config.reward.name, "paper")
    return name if config.observation.name == usual else f"{name}-{config.observation.name}"


def run_id(config: Config) -> str:
    """``<env>-<method>-s<seed>-<hash8>``: the same configuration has the same id, everywhere."""
    track, method = config.env.name[:TRACK_CHARACTERS], method_name(config)[:METHOD_CHARACTERS]
    return f"{track}-{method}-s{config.seed}-{fingerprint(config)[:8]}"
