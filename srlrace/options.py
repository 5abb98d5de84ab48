"""The options of ``srlrace train``: those of Hydra's that are safe, ``--runs`` and ``--wait``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from srlrace.catalogue import GROUPS, SETTINGS
from srlrace.parse import ConfigError, nearest, show

SWITCHES = ("-m", "--multirun", "--resolve", "--run", "-r", "--hydra-help")
SHOWS = ("job", "hydra", "all")
INFORMS = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
FLAGS = {"--cfg": SHOWS, "-c": SHOWS, "--info": INFORMS, "-i": INFORMS, "--package": (), "-p": ()}
FOLDERS = ("--config-dir", "-cd", "--runs")


@dataclass(frozen=True)
class Options:
    """Flags that are passed on to Hydra, folders of the user's presets, and where runs live."""

    flags: tuple[str, ...] = ()
    config_dirs: tuple[str, ...] = ()
    runs: str | None = None
    wait: bool = False  # for another process that is training the same run

    @property
    def multirun(self) -> bool:
        """Whether commas mean several runs."""
        return "-m" in self.flags or "--multirun" in self.flags

    @property
    def shows(self) -> bool:
        """Whether Hydra is only asked to show something."""
        return any(flag in ("--cfg", "-c", "--info", "-i", "--hydra-help") for flag in self.flags)


def split_options(arguments: Sequence[str]) -> tuple[Options, list[str]]:
    """Separate the options from the other words; raises `ConfigError` for one that is not to be used."""
    rest = list(arguments)
    options, words = Options(), []
    while rest:
        word = rest.pop(0)
        name, has_value, value = word.partition("=")
        if not word.startswith("-"):
            words.append(word)
        elif word == "--wait":
            options = replace(options, wait=True)
        elif name in SWITCHES and not has_value:
            options = replace(options, flags=(*options.flags, name))
        elif name in FLAGS:
            if not has_value:
                value = rest.pop(0) if rest and "=" not in rest[0] else ""
            options = replace(options, flags=(*options.flags, *_flag(name, value)))
        elif name in FOLDERS:
            if not has_value:
                value = rest.pop(0) if rest else ""
            options = _with_folder(options, name, value)
        else:
            raise ConfigError(_no_option(word, rest))
    return options, words


def _flag(name: str, value: str) -> list[str]:
    takes = FLAGS[name]
    needed = name not in ("--info", "-i")
    if (value or needed) and takes and value not in takes:
        raise ConfigError(f"{name}: got {show(value)}; takes one of {', '.join(takes)}{nearest(value, takes)}")
    return [name, value] if value else [name]


def _with_folder(options: Options, name: str, value: str) -> Options:
    if name == "--runs" and value:
        return replace(options, runs=value)
    if name == "--runs" or not Path(value).is_dir():
        raise ConfigError(f"{name}: got {show(value)}, which is not a folder")
    return replace(options, config_dirs=(*options.config_dirs, str(Path(value).resolve())))


def _no_option(word: str, rest: Sequence[str]) -> str:
    name, has_value, value = word.lstrip("-").partition("=")
    name = name.replace("-", "_")
    if name in SETTINGS or name in GROUPS:
        value = value if has_value else next(iter(rest), "VALUE")
        return f"{word}: settings have no dashes; write {name}={value}"
    return f"{show(word)}: no such option{nearest(word, (*SWITCHES, *FLAGS, *FOLDERS, '--wait', '--help'))}"
