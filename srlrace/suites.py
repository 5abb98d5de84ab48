"""Suites: what a policy can be evaluated on, which is a set of maps and, if named, a disturbance.

``validation`` is the training maps again, from starts that no table is made of: what settings are to be chosen by.
``level2`` is a hundred unseen forests, ``level2-wind5`` the same flights with what conf/disturbance/wind5.yaml says.
Names need no more than a listing of that folder; neither Hydra nor numpy is imported here.
"""

from __future__ import annotations

from functools import cache

from srlrace.confdir import conf_dir
from srlrace.config import to_dict
from srlrace.parse import ConfigError, nearest, parse, show
from srlrace.schema import SUITES, DisturbanceConfig

SEPARATOR = "-"  # names of suites are names of folders, where a plus sign is not allowed
OWN_MAPS = {"train_map": "", "validation": "starts for validation"}  # on the maps of the training, and in words
NOMINAL = DisturbanceConfig("nominal")


@cache
def disturbance_names() -> tuple[str, ...]:
    """The disturbances there are, by the names of their files."""
    return tuple(sorted(path.stem for path in (conf_dir() / "disturbance").glob("*.yaml")))


@cache
def suite_names() -> tuple[str, ...]:
    """Every suite: each set of maps alone and with each disturbance."""
    return (*SUITES, *(f"{maps}{SEPARATOR}{name}" for maps in SUITES for name in disturbance_names()))


def maps_of(suite: str) -> str:
    """The set of maps that a suite flies on, one of `SUITES`."""
    return suite.partition(SEPARATOR)[0]


def check_suite(suite: str, option: str = "suite") -> str:
    """Return the suite's name, or raise `ConfigError` with what there is."""
    if suite not in suite_names():
        named = f"{', '.join(SUITES)}; or one of them and a disturbance, such as {SUITES[-1]}{SEPARATOR}wind5"
        raise ConfigError(f"{option}: got {show(suite)}, takes one of {named}{nearest(suite, suite_names())}")
    return suite


@cache
def disturbance_of(suite: str) -> DisturbanceConfig:
    """How a suite differs from the nominal world; raises `ConfigError` for a suite or a file that cannot be used."""
    from yaml import YAMLError, safe_load

    name = check_suite(suite).partition(SEPARATOR)[2]
    if not name:
        return NOMINAL
    path = conf_dir() / "disturbance" / f"{name}.yaml"
    try:
        data = safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict):
            raise ConfigError("holds no settings")
        found = parse(DisturbanceConfig, data)
    except (OSError, UnicodeDecodeError, YAMLError, ConfigError) as error:
        raise ConfigError(f"{path}: {' '.join(str(error).split())}") from None
    if found.name != name:
        raise ConfigError(f"{path}: name: got {show(found.name)}; takes {name}, as the file is called")
    return found


def definition(disturbance: DisturbanceConfig) -> dict[str, object]:
    """What a disturbance changes, as plain data: its settings that are not the nominal ones."""
    nominal = to_dict(NOMINAL)
    return {key: value for key, value in to_dict(disturbance).items() if value != nominal[key]}


def describe(disturbance: DisturbanceConfig) -> str:
    """Say in a few words what a disturbance changes; empty for none."""
    d = disturbance
    noise = f"{d.position_noise:g} m, {d.velocity_noise:g} m/s, {d.attitude_noise:g} rad"
    noisy = bool(d.position_noise or d.velocity_noise or d.attitude_noise)
    parts = {
        f"mass x{d.mass:g}": d.mass != 1.0,
        f"drag x{d.drag:g}": d.drag != 1.0,
        f"thrust x{d.thrust:g}": d.thrust != 1.0,
        f"action delay {1000 * d.delay:g} ms": bool(d.delay),
        f"estimate noise {noise}": noisy,
        f"wind {d.wind:g} m/s": bool(d.wind),
    }
    return ", ".join(words for words, present in parts.items() if present)


def describe_suite(suite: str) -> str:
    """Say in words where and how a suite flies, beyond the training maps; empty for those, undisturbed."""
    maps = maps_of(suite)
    level = maps.removeprefix("level")
    where = OWN_MAPS.get(maps, f"unseen level {level}" if level != maps else "unseen maps")
    return ", ".join(filter(None, (where, describe(disturbance_of(suite)))))
