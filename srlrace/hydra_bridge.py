"""Hydra composes the configuration and runs the jobs; everything it would do besides is switched off.

`compose` turns overrides into a `Config`. `train` hands a checked command line to public `hydra.main`,
so that multirun, launchers, ``--cfg`` and ``--info`` work as Hydra documents them. Every job of a
command is composed and checked before the first one starts, so a bad value stops all of them.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from srlrace.checks import check_memory
from srlrace.confdir import conf_dir
from srlrace.config import Config, ConfigError, parse_config, run_id
from srlrace.console import say
from srlrace.locks import WAIT
from srlrace.overrides import Request, check_arguments
from srlrace.runs import RunFolder, State, runs_root
from srlrace.signals import handling, pass_on, preempted

if TYPE_CHECKING:
    from omegaconf import DictConfig

HYDRA_VERSION = "1.3"
MAX_JOBS = 10_000  # of one command
ARGV = "SRLRACE_ARGV"  # carries the user's command line into the jobs of every launcher
RUNS = "SRLRACE_RUNS"
TRUSTED_TARGETS = ("hydra._internal.core_plugins.", "hydra_plugins.")


def compose(overrides: Sequence[str]) -> Config:
    """The configuration that ``srlrace train OVERRIDES`` would train; raises `ConfigError`."""
    return compose_all(check_arguments(overrides))[0]


def compose_all(request: Request) -> list[Config]:
    """The configuration of each job of a request, all checked; raises `ConfigError`, one line."""
    from hydra import compose as hydra_compose
    from hydra import initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        with initialize_config_dir(str(conf_dir()), version_base=HYDRA_VERSION):
            extra = _search_path(request)
            jobs = [[*extra, *job] for job in expand(request)]
            composed = (hydra_compose("train", job, return_hydra_config=True) for job in jobs)
            configs = [parse_config(_plain(data)) for data in composed]
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(_one_line(error)) from None
    for config in configs:
        check_memory(config, _machine_memory())
    return configs


def expand(request: Request) -> list[list[str]]:
    """The overrides of each job of a multirun; the only job's otherwise."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    if not request.options.multirun:
        return [list(request.overrides)]
    axes = []
    for override in OverridesParser.create().parse_overrides(list(request.overrides)):
        text = override.input_line or ""
        key = text.partition("=")[0]
        values = override.sweep_string_iterator() if override.is_sweep_override() else [text.partition("=")[2]]
        axes.append([f"{key}={value}" for value in itertools.islice(values, MAX_JOBS + 1)])
    jobs = [list(job) for job in itertools.islice(itertools.product(*axes), MAX_JOBS + 1)]
    if len(jobs) > MAX_JOBS:
        raise ConfigError(f"-m: more than {MAX_JOBS} runs in one command; split it")
    return jobs


def _search_path(request: Request) -> list[str]:
    folders = ",".join("'file://" + folder.replace("'", r"\'") + "'" for folder in request.options.config_dirs)
    return [f"hydra.searchpath=[{folders}]"] if folders else []


def _plain(data: DictConfig) -> dict[str, Any]:
    """What Hydra composed, as plain data, nothing resolved; refuses what a config file sneaked into Hydra itself."""
    from omegaconf import OmegaConf

    plain: Any = OmegaConf.to_container(data, resolve=False)
    hydra = plain.pop("hydra", None)
    if hydra is not None:
        targets = [str((hydra.get(plugin) or {}).get("_target_")) for plugin in ("launcher", "sweeper")]
        env_set = hydra["job"]["env_set"] or hydra["job"]["env_copy"]
        if hydra["callbacks"] or env_set or not all(target.startswith(TRUSTED_TARGETS) for target in targets):
            raise ConfigError("hydra: a config file changes Hydra's own settings; only its launcher can be chosen")
    return dict(plain)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:400]


def _machine_memory() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def train(arguments: Sequence[str]) -> int:
    """Run ``srlrace train ARGUMENTS``: check everything, then let Hydra run it. Returns the exit status."""
    stopped: list[int] = []
    try:
        with _terminable(stopped):
            return _train(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 1
    except Exception:
        if not stopped:
            raise
        return 128 + stopped[0]  # a parser had a callback interrupted, and took that for bad input


def _train(arguments: Sequence[str]) -> int:
    request = check_arguments(arguments)
    configs = compose_all(request)
    root = runs_root(request.options.runs).absolute()
    sweep_dir = root / ".multirun" / str(os.getpid())
    words = [*request.options.flags, *_search_path(request), *request.overrides, *_plumbing(sweep_dir)]
    environment = {RUNS: str(root), ARGV: json.dumps(["srlrace", "train", *arguments]), "HYDRA_FULL_ERROR": "1"}
    environment |= {WAIT: "1"} if request.options.wait else {}
    try:
        with _swapped(["srlrace train", *words], environment):
            _hydra_main()
    finally:
        with suppress(OSError):
            (sweep_dir / "multirun.yaml").unlink(missing_ok=True)
            sweep_dir.rmdir()
            sweep_dir.parent.rmdir()
    return 0 if request.options.shows else unfinished(configs, root)


def unfinished(configs: Sequence[Config], root: Path) -> int:
    """Exit status after all jobs of a command ended: 1 when a run of it is not finished."""
    return int(any(RunFolder(root / run_id(config)).state is not State.FINISHED for config in configs))


def _plumbing(sweep_dir: Path) -> list[str]:
    """Hydra writes nothing of its own, moves nowhere, and leaves logging alone."""
    folder = str(sweep_dir).replace("'", r"\'")
    return ["hydra.output_subdir=null", "hydra.run.dir=.", f"hydra.sweep.dir='{folder}'", "hydra.sweep.subdir=.",
            "hydra.job.chdir=false", "hydra/job_logging=none", "hydra/hydra_logging=none"]  # fmt: skip


def _hydra_main() -> None:
    import hydra

    hydra.main(version_base=HYDRA_VERSION, config_path=str(conf_dir()), config_name="train")(run_job)()


def run_job(data: DictConfig) -> None:
    """Train one run of a command; Hydra's task function, also in a launcher's processes."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    from srlrace.training import train_run

    config = parse_config(_plain(data))
    status = train_run(config, Path(os.environ[RUNS]), json.loads(os.environ[ARGV]))
    if status == 128 + signal.SIGUSR2 or (status > 128 and preempted()):
        pass_on(signal.SIGUSR2)  # submitit's handler starts the job anew, elsewhere or later
    alone = HydraConfig.get().mode is not RunMode.MULTIRUN
    if status and (alone or status > 128):  # one failed run of several does not stop the others; a signal does
        raise SystemExit(status)


@contextmanager
def _swapped(argv: list[str], environment: dict[str, str]) -> Iterator[None]:
    """Show Hydra, and the processes it starts, this command line and these variables."""
    old_argv, old_environment = sys.argv, {name: os.environ.get(name) for name in environment}
    with ExitStack() as stack:
        stack.callback(setattr, sys, "argv", old_argv)
        stack.callback(_restore, old_environment)
        sys.argv = argv
        os.environ.update(environment)
        yield


def _restore(environment: dict[str, str | None]) -> None:
    for name, value in environment.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


@contextmanager
def _terminable(stopped: list[int]) -> Iterator[None]:
    """Let a signal between jobs, or to the parent of a launcher's processes, leave through every clean-up.

    The signal's number is added to ``stopped``; a second one leaves at once.
    """

    def leave(signum: int, frame: FrameType | None) -> None:
        if stopped:
            os._exit(128 + signum)
        stopped.append(signum)
        say("stopped; the same command continues")
        raise SystemExit(128 + signum)

    with handling(leave):
        yield
