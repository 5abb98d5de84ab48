"""Training a run: from its configuration, or from wherever an earlier attempt was stopped."""

from __future__ import annotations

import hashlib
import json
import logging
import time
import traceback
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from srlrace.config import Config, ConfigError, load_config, run_id, to_dict
from srlrace.files import atomic_write, naming, read_limited, write_sealed
from srlrace.learn.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from srlrace.learn.display import Display
from srlrace.learn.events import EventFile
from srlrace.learn.finite import Diverged, check_rollout, check_update
from srlrace.learn.interrupt import Interrupted, StopRequest, stop_request
from srlrace.learn.lean_ppo import LeanPPO
from srlrace.learn.policy import build_policy, save_policy
from srlrace.learn.ppo import build_ppo, capture, reinstate, what_is_shown
from srlrace.learn.progress import LEARNER, ProgressFile, outcome_ratios, write_scalars
from srlrace.provenance import changes, circumstances, provenance
from srlrace.runs import DIGEST, RunFolder
from srlrace.task.reward import TERMS
from srlrace.task.vec_env import RaceVecEnv

__all__ = ["Diverged", "Interrupted", "Training", "train"]

logger = logging.getLogger(__name__)

SAVE_EVERY = 5.0  # s of wall-clock between checkpoints; results do not depend on it
ROWS = 2000  # rows of progress.csv a training is spread over, at most
SNAPSHOTS = 20  # policies kept along a training, so that its progress can be evaluated; results do not depend on it


class RolloutBoundary(BaseCallback):
    """Between two rollouts: check, report, checkpoint, stop if asked, and move the curriculum on."""

    def __init__(self, training: Training, request: StopRequest) -> None:
        super().__init__()
        self._training, self._request = training, request

    def _on_rollout_start(self) -> None:
        with self._request.deferred():
            self._training.between_rollouts()

    def _on_rollout_end(self) -> None:
        check_rollout(self._training.model)

    def _on_step(self) -> bool:
        return True


class Training:
    """One attempt at a run, in its locked folder."""

    def __init__(self, config: Config, folder: RunFolder, display: Display, request: StopRequest) -> None:
        self.config, self.folder = config, folder
        self._display, self._request = display, request
        self._average = build_policy(config) if config.algo.averaged > 0.0 else None  # before the seeds are set
        self.env = RaceVecEnv(config)
        self.model = build_ppo(config, self.env)
        self._circumstances = circumstances(torch.get_num_threads())
        checkpoint = load_checkpoint(folder.file("checkpoint"))
        facts = checkpoint.facts if checkpoint else {}
        if checkpoint is not None:
            reinstate(self.model, self.env, checkpoint.arrays, self._average)
            logger.info("%s resumes at step %d", folder.id, checkpoint.steps)
            for change in changes(facts, self._circumstances):
                logger.warning("%s: the result will not be that of an undisturbed run to the last bit", change)
        self._spent = float(facts.get("wall_s", 0.0))
        progress = folder.file("progress.csv")
        with naming(progress):
            self._file = ProgressFile(progress, int(facts.get("progress_bytes", 0)))
        with naming(folder.path):
            self._board = EventFile(folder.path, self.model.num_timesteps)
        self._began = self._saved = time.monotonic()
        self._seen_steps = self.model.num_timesteps
        self._row_steps = int(facts.get("row_steps", 0))
        self._row_wall = float(facts.get("row_wall_s", 0.0))
        self._newest: Checkpoint | None = None  # complete, and not on disk yet

    @property
    def wall(self) -> float:
        """Seconds spent on this run, earlier attempts included."""
        return self._spent + time.monotonic() - self._began

    @property
    def policy(self) -> ActorCriticPolicy:
        """What the training has come to: the average of the last part's policies, once that has begun."""
        return self._average if self._average and self._averaged() else self.model.policy

    def _averaged(self) -> int:
        """Policies that the average is of by now."""
        algo, rollout = self.config.algo, self.config.algo.n_envs * self.config.algo.n_steps
        before = int((1.0 - algo.averaged) * algo.total_steps) // rollout
        return max(self.model.num_timesteps // rollout - before, 0)

    def run(self) -> None:
        """Train to the end of the budget and write the policy; a signal leaves with the newest state saved."""
        remaining = self.config.algo.total_steps - self.model.num_timesteps
        if remaining > 0:
            never: Any = None  # SB3 takes it, its annotation does not
            boundary = RolloutBoundary(self, self._request)
            try:
                with self._request.enforced():
                    self.model.learn(remaining, boundary, log_interval=never, reset_num_timesteps=False)
            except Interrupted:
                self._save()
                raise
        with self._request.deferred(check=False):
            self.between_rollouts(final=True)
        self._polish()
        with self._request.deferred(check=False):
            finished = {"steps": self.model.num_timesteps, "train_wall_s": round(self.wall, 3)}
            write_sealed(self.folder.path / "run.json", self.folder.info | finished)
            save_policy(self.policy, self.folder.path / "policy.safetensors")  # last: it says that all is done

    def _polish(self) -> None:
        """Take the last stage's steps, if there is one, a round after the other."""
        polish = self.model.polish if isinstance(self.model, LeanPPO) else None
        try:
            while polish and not polish.finished:
                self._request.check()
                with self._request.enforced():
                    polish.round()
                with self._request.deferred():
                    check_update(self.model)
                    self._keep_state()
        except Interrupted:
            self._save()
            raise

    def between_rollouts(self, final: bool = False) -> None:
        """Everything that happens when one rollout has been learned from and the next has not begun."""
        steps = self.model.num_timesteps
        if steps > self._seen_steps:
            check_update(self.model)
            self._seen_steps = steps
            self._extend_average()
            self._report(final)
            self._keep_snapshot(steps)
            self._keep_state(save=final)
        self.env.race.set_progress(steps / self.config.algo.total_steps)
        self.env.race.refresh(steps)
        if isinstance(self.model, LeanPPO):
            for helper in (self.model.teacher, self.model.room_ascent):
                if helper:
                    helper.begin_rollout(steps)

    @torch.no_grad()
    def _extend_average(self) -> None:
        """Let the average of policies include this one, if the part of the training that it is of has begun."""
        if self._average and (count := self._averaged()):
            for mean, parameter in zip(self._average.parameters(), self.model.policy.parameters(), strict=True):
                mean.lerp_(parameter, 1.0 / count)

    def _keep_snapshot(self, steps: int) -> None:
        """Keep the policy of the first boundary after each of `SNAPSHOTS` equal parts of the budget."""
        algo = self.config.algo
        before = steps - algo.n_envs * algo.n_steps
        if steps * SNAPSHOTS // algo.total_steps > before * SNAPSHOTS // algo.total_steps:
            folder = self.folder.file("snapshots")
            folder.mkdir(exist_ok=True)
            save_policy(self.policy, folder / f"{steps}.safetensors")

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
        with naming(self.folder.path / "progress.csv"):
            self._file.append(row)
        with naming(self.folder.path):
            write_scalars(self._board, row)
        self._display.show(row)

    def _keep_state(self, save: bool = False) -> None:
        """Take the state of this boundary, and put it on disk where that is asked for or due."""
        arrays = capture(self.model, self.env, self._average)
        self._newest = Checkpoint(self.model.num_timesteps, arrays, {})
        if save or time.monotonic() - self._saved >= SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        """Put the state of the last boundary on disk, if it is not there yet."""
        if self._newest is None:
            return
        with naming(self.folder.path / "progress.csv"):
            length = self._file.sync()  # nothing was added to it since that boundary
        with naming(self.folder.path):
            self._board.flush()
        facts = {
            **self._circumstances,
            "wall_s": self.wall,
            "progress_bytes": length,
            "row_steps": self._row_steps,
            "row_wall_s": self._row_wall,
        }
        save_checkpoint(self.folder.file("checkpoint"), replace(self._newest, facts=facts))
        self._newest, self._saved = None, time.monotonic()

    def close(self) -> None:
        """Close the files."""
        with naming(self.folder.path), closing(self._file), closing(self._board):
            pass


def train(config: Config, root: Path, argv: Sequence[str] = ()) -> Path:
    """Train the run of ``config`` below ``root``; return its folder.

    A finished run is left as it is, an interrupted one continues from its last checkpoint. Raises
    `Interrupted` after a signal (the state is saved), `RunError` where another process holds the run or
    the training diverged, and leaves ``error.txt`` behind for anything unforeseen.
    """
    folder = RunFolder(root / run_id(config))
    if not folder.has("policy.safetensors"):
        what_is_shown(config)  # where that is not on file, no folder shall be left behind
    # A stop may come up between two lines of a library's own clearing up; what it left switched is switched back.
    with torch.enable_grad(), stop_request(folder.id) as request, folder.lock():
        if (folder.path / "policy.safetensors").is_file():
            logger.info("%s is finished; skipped", folder.id)
            return folder.path
        begin_run(config, folder, argv)
        logger.info("training %s: %.1f M steps", folder.id, config.algo.total_steps / 1e6)
        try:
            wall = attempt(config, folder, request)
        except Exception:
            with suppress(OSError):  # the same full disk, perhaps; what is raised already says why
                atomic_write(folder.path / "error.txt", traceback.format_exc())
            raise
        logger.info("%s is finished after %.0f s; evaluate it with: srlrace eval %s", folder.id, wall, folder.id)
    return folder.path


def begin_run(config: Config, folder: RunFolder, argv: Sequence[str]) -> None:
    """Write the configuration, unless it is there, and where this attempt came from."""
    path = folder.file("config.json")
    try:
        stored = load_config(path) == config
    except ConfigError:
        stored = False
    if not stored:
        atomic_write(path, json.dumps(to_dict(config), indent=1) + "\n")
    (folder.path / "error.txt").unlink(missing_ok=True)
    earlier = folder.info.get("attempts", [])
    facts = {**provenance(argv), "run": folder.id, "threads": config.algo.threads}
    facts["attempts"] = [*(earlier if isinstance(earlier, list) else []), facts["started"]]
    facts[DIGEST] = hashlib.sha256(read_limited(path)).hexdigest()
    write_sealed(folder.path / "run.json", facts)


def attempt(config: Config, folder: RunFolder, request: StopRequest) -> float:
    """Train in a folder that is ours until the budget is spent; return the seconds it took."""
    with Display(config, folder.path) as display:
        with request.enforced():
            training = Training(config, folder, display, request)
        try:
            training.run()
        finally:
            training.close()
    return training.wall
