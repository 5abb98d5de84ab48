"""Finding values that are not finite before anything is built on them."""

from __future__ import annotations

import numpy as np
import torch
from stable_baselines3 import PPO

from srlrace.runs import RunError


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
