"""Training one run from a command: what it ends in becomes an exit status and one line."""

from __future__ import annotations

import logging
import signal
from collections.abc import Sequence
from pathlib import Path

from srlrace.config import Config, ConfigError, run_id
from srlrace.console import fail, say, setup_logging
from srlrace.runs import RunError, RunFolder

BAD_INPUT = 2
FAILED = 1

logger = logging.getLogger(__name__)


def train_run(config: Config, root: Path, argv: Sequence[str]) -> int:
    """Train, continue or skip one run below ``root``; returns the exit status after saying what happened."""
    from srlrace.learn.interrupt import Interrupted
    from srlrace.learn.train import Diverged, train

    setup_logging()
    name = run_id(config)
    try:
        train(config, root, argv)
    except Interrupted as stop:
        say(f"stopped by {signal.Signals(stop.signum).name}; resume with: {resume_command(name, root)}")
        return 128 + stop.signum
    except Diverged as error:
        fail(f"{name}: {error}")
        return FAILED
    except (ConfigError, RunError) as error:
        fail(str(error))
        return BAD_INPUT
    except OSError as error:
        fail(f"{name}: {error.strerror or error}{f': {error.filename}' if error.filename else ''}")
        return FAILED
    except Exception as error:
        logger.debug("%s failed", name, exc_info=True)
        fail(f"{name}: {type(error).__name__}: {error}{_traceback_hint(root / name)}")
        return FAILED
    return 0


def resume_run(run: RunFolder, argv: Sequence[str]) -> int:
    """Continue the training in a run folder; raises `RunError` when the folder is not the config's own."""
    config = run.load_config()
    if run_id(config) != run.id:
        raise RunError(f"{run.path}: its config.json is that of run {run_id(config)}; rename the folder to resume it")
    return train_run(config, run.path.resolve().parent, argv)


def resume_command(name: str, root: Path) -> str:
    """The command that continues a run."""
    usual = root.absolute() == Path("runs").absolute()
    return f"srlrace resume {name}" + ("" if usual else f" --runs {root}")


def _traceback_hint(folder: Path) -> str:
    return f" (traceback in {folder / 'error.txt'})" if (folder / "error.txt").is_file() else ""
