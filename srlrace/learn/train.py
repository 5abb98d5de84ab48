"""Training a run: from its configuration, or from wherever an earlier attempt was stopped."""

from __future__ import annotations

import json
import logging
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

from srlrace.config import Config, run_id, to_dict
from srlrace.files import atomic_write, read_json
from srlrace.learn.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from srlrace.learn.interrupt import Interrupted, StopRequest, stop_request
from srlrace.learn.policy import save_policy
from srlrace.learn.ppo import build_ppo, capture, reinstate
from srlrace.learn.progress import LEARNER, Display, ProgressFile, outcome_ratios, write_scalars
from srlrace.provenance import provenance
from srlrace.runs import RunError, RunFolder
from srlrace.task.reward import TERMS
from srlrace.task.vec_env import RaceVecEnv

logger = logging.getLogger(__name__)

SAVE_EVERY = 5.0  # s of wall-clock between checkpoints; results do not depend on it
ROWS = 2000  # rows of progress.csv a training is spread over, at most


class Diverged(RunError):
    """The training met a value that is not finite; the last checkpoint is from before it."""


def check_rollout(model: PPO) -> None:
    """Raise `Diverged` when what a rollout collected is not finite, before anything is learned from it."""
    buffer = model.rollout_buffer
    arrays = {"observation": buffer.observations, "reward": buffer.rewards, "action": buffer.actions}
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise Diverged(f"{name} is not finite in the rollout that ended at step {model.num_timesteps}")


def check_update(model: PPO) -> None:
    """Raise `Diverged` when losses or weights are not finite."""
    loss = model.logger.name_to_value.get("train/loss", 0.0)
    weights = torch.cat([p.detach().flatten() for p in model.policy.parameters()])
    if not np.isfinite(loss) or not bool(torch.isfinite(weights).all()):
        raise Diverged(f"loss or weights are not finite after the update at step {model.num_timesteps}")


class RolloutBoundary(BaseCallback):
    """Between two rollouts: check, report, checkpoint, stop if asked, and move the curriculum on."""

    def __init__(self, training: Training) -> None:
        super().__init__()
        self._training = training

    def _on_rollout_start(self) -> None:
        self._training.between_rollouts()

    def _on_rollout_end(self) -> None:
        check_rollout(self._training.model)

    def _on_step(self) -> bool:
        return True


class Training:
    """One attempt at a run, in its locked folder."""

    def __init__(self, config: Config, folder: RunFolder, display: Display, request: StopRequest) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.config, self.folder = config, folder
        self._display, self._request = display, request
        self.env = RaceVecEnv(config)
        self.model = build_ppo(config, self.env)
        checkpoint = load_checkpoint(folder.path / "checkpoint")
        facts = checkpoint.facts if checkpoint else {}
        if checkpoint is not None:
            reinstate(self.model, self.env, checkpoint.arrays)
            logger.info("%s resumes at step %d", folder.id, checkpoint.steps)
        self._spent = float(facts.get("wall_s", 0.0))
        self._file = ProgressFile(folder.path / "progress.csv", int(facts.get("progress_bytes", 0)))
        self._board = SummaryWriter(str(folder.path), purge_step=self.model.num_timesteps)
        self._began = self._saved = time.monotonic()
        self._seen_steps = self.model.num_timesteps
        self._row_steps = int(facts.get("row_steps", 0))
        self._row_wall = float(facts.get("row_wall_s", 0.0))

    @property
    def wall(self) -> float:
        """Seconds spent on this run, earlier attempts included."""
        return self._spent + time.monotonic() - self._began

    def run(self) -> None:
        """Train to the end of the budget and write the policy."""
        remaining = self.config.algo.total_steps - self.model.num_timesteps
        if remaining > 0:
            never: Any = None  # SB3 takes it, its annotation does not
            self.model.learn(remaining, RolloutBoundary(self), log_interval=never, reset_num_timesteps=False)
            self.between_rollouts(final=True)
        save_policy(self.model.policy, self.folder.path / "policy.safetensors")

    def between_rollouts(self, final: bool = False) -> None:
        """Everything that happens when one rollout has been learned from and the next has not begun."""
        steps = self.model.num_timesteps
        fresh = steps > self._seen_steps
        if fresh:
            check_update(self.model)
            self._seen_steps = steps
            self._report(final)
        self.env.race.set_progress(steps / self.config.algo.total_steps)
        stopping = self._request.signum is not None
        if fresh and (final or stopping or time.monotonic() - self._saved >= SAVE_EVERY):
            self._save()
        if stopping and not final:
            assert self._request.signum is not None
            raise Interrupted(self._request.signum, self.folder.id)

    def _report(self, final: bool) -> None:
        steps = self.model.num_timesteps
        spacing = self.config.algo.total_steps / ROWS
        if steps - self._row_steps < spacing and not final:
            return
        new, wall = steps - self._row_steps, self.wall
        values = self.model.logger.name_to_value
        row: dict[str, Any] = {
            "steps": steps,
            "wall_s": wall,
            "steps_per_s": new / max(wall - self._row_wall, 1e-9),
            **outcome_ratios(self.env.race.take_ledger(), new),
            "collision_weight": float(self.env.race.current_weights[TERMS.index("collision")]),
            "learning_rate": self.model.policy.optimizer.param_groups[0]["lr"],
            **{f"train/{name}": float(values.get(f"train/{name}", np.nan)) for name in LEARNER},
        }
        self._row_steps, self._row_wall = steps, wall
        self._file.append(row)
        write_scalars(self._board, row)
        self._display.show(row)

    def _save(self) -> None:
        facts = {
            "wall_s": self.wall,
            "progress_bytes": self._file.sync(),
            "row_steps": self._row_steps,
            "row_wall_s": self._row_wall,
            "threads": self.config.algo.threads,
        }
        save_checkpoint(
            self.folder.path / "checkpoint",
            Checkpoint(self.model.num_timesteps, capture(self.model, self.env), facts),
        )
        self._saved = time.monotonic()

    def close(self) -> None:
        """Close the files."""
        self._file.close()
        self._board.close()


def train(config: Config, root: Path, argv: Sequence[str] = ()) -> Path:
    """Train the run of ``config`` below ``root``; return its folder.

    A finished run is left as it is, an interrupted one continues from its last checkpoint. Raises
    `Interrupted` after a signal (the state is saved), `RunError` where another process holds the run or
    the training diverged, and leaves ``error.txt`` behind for anything unforeseen.
    """
    folder = RunFolder(root / run_id(config))
    with stop_request() as request, folder.lock():
        if (folder.path / "policy.safetensors").is_file():
            logger.info("%s is finished; skipped", folder.id)
            return folder.path
        begin_run(config, folder, argv)
        logger.info("training %s: %.1f M steps", folder.id, config.algo.total_steps / 1e6)
        try:
            steps, wall = attempt(config, folder, request)
        except Exception as error:
            if not isinstance(error, Interrupted):
                atomic_write(folder.path / "error.txt", traceback.format_exc())
            raise
        facts = {**read_json(folder.path / "run.json"), "steps": steps, "train_wall_s": round(wall, 3)}
        atomic_write(folder.path / "run.json", json.dumps(facts, indent=1) + "\n")
        logger.info("%s is finished after %.0f s; evaluate it with: srlrace eval %s", folder.id, wall, folder.id)
    return folder.path


def begin_run(config: Config, folder: RunFolder, argv: Sequence[str]) -> None:
    """Write the configuration and where this attempt came from."""
    atomic_write(folder.path / "config.json", json.dumps(to_dict(config), indent=1) + "\n")
    (folder.path / "error.txt").unlink(missing_ok=True)
    facts = {**provenance(argv), "run": folder.id, "threads": config.algo.threads}
    earlier = folder.info.get("attempts", [])
    attempts = [*(earlier if isinstance(earlier, list) else []), facts["started"]]
    atomic_write(folder.path / "run.json", json.dumps({**facts, "attempts": attempts}, indent=1) + "\n")


def attempt(config: Config, folder: RunFolder, request: StopRequest) -> tuple[int, float]:
    """Train in a folder that is ours until the budget is spent; return steps and seconds."""
    with Display(folder.id, config.algo.total_steps) as display:
        training = Training(config, folder, display, request)
        try:
            training.run()
        finally:
            training.close()
    return training.model.num_timesteps, training.wall
