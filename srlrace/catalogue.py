"""The names a command line may use: settings of the schema, and the presets that stand in files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from srlrace.confdir import conf_dir
from srlrace.parse import label, nearest, settings
from srlrace.schema import Config

GROUPS = ("env", "level", "reward", "observation", "baseline", "quad", "randomization", "curriculum", "algo")
SETTINGS = {setting.path: setting for setting in settings(Config) if setting.path not in GROUPS}
SECTIONS = tuple(dict.fromkeys(path.partition(".")[0] for path in SETTINGS))


def unknown(key: str) -> str:
    """The message for a setting that does not exist."""
    name = label(key)
    if key.startswith("hydra"):
        return f"{name}: not for you to set; of Hydra's settings takes hydra/launcher and hydra.launcher.*"
    if key in SECTIONS:
        members = [path.partition(".")[2] for path in SETTINGS if path.startswith(f"{key}.")]
        return f"{key}: takes one setting at a time: {key}.{members[0]}=...; it has {', '.join(members)}"
    leaf = key.rpartition(".")[2]
    homes = [path for path in SETTINGS if path.rpartition(".")[2] == leaf]
    hint = f"; did you mean {homes[0]}?" if len(homes) == 1 else nearest(key, (*SETTINGS, *GROUPS))
    return f"{name}: no such setting{hint}"


def choices(group: str, config_dirs: Sequence[str] = ()) -> tuple[str, ...]:
    """The names that a group takes: its files in conf/ and in the user's config directories."""
    folders = [folder / group for folder in (conf_dir(), *map(Path, config_dirs))]
    return tuple(sorted({path.stem for folder in folders for path in folder.glob("*.yaml")}))
