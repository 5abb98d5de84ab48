"""Stable-Baselines3's PPO with a leaner rollout and update: the same algorithm, about twice as fast.

What is left out is overhead: distribution objects, autograd's graph, a gather per minibatch, a loop over
all drones' infos. What is computed stays the same; a test trains one update with SB3's own `PPO.train`
on the same rollout and compares the weights.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import explained_variance
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from srlrace.learn.mlp import Perceptron

LOG_SQRT_TAU = 0.5 * math.log(2.0 * math.pi)


class LeanPPO(PPO):
    """PPO for a diagonal Gaussian policy with separate policy and value networks (SB3's ``MlpPolicy``)."""

    def _setup_model(self) -> None:
        super()._setup_model()
        extractor = self.policy.mlp_extractor
        self.actor = Perceptron(extractor.policy_net, cast(nn.Linear, self.policy.action_net))
        self.critic = Perceptron(extractor.value_net, self.policy.value_net)
        self.log_std = self.policy.log_std
        parameters = list(self.policy.parameters())
        self.flat_gradient = torch.zeros(sum(p.numel() for p in parameters))
        for p, part in zip(parameters, self.flat_gradient.split([p.numel() for p in parameters]), strict=True):
            p.grad = part.view_as(p)

    @torch.no_grad()
    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with ``n_rollout_steps`` steps of every drone, bootstrapping truncated episodes."""
        assert self._last_obs is not None
        box = cast(spaces.Box, self.action_space)
        rollout_buffer.reset()
        callback.on_rollout_start()
        std = self.log_std.exp()
        for step in range(n_rollout_steps):
            observation = cast(np.ndarray[Any, Any], self._last_obs)
            tensor = torch.from_numpy(observation)
            noise = torch.randn(env.num_envs, *box.shape)
            action = (self.actor.forward(tensor) + std * noise).numpy()
            new_observation, rewards, dones, infos = env.step(np.clip(action, box.low, box.high))
            self.num_timesteps += env.num_envs
            callback.update_locals({"infos": infos, "dones": dones, "rewards": rewards})
            if not callback.on_step():
                return False
            self._bootstrap(rewards, dones, infos)
            rollout_buffer.observations[step] = observation
            rollout_buffer.actions[step] = action
            rollout_buffer.rewards[step] = rewards
            rollout_buffer.episode_starts[step] = self._last_episode_starts
            rollout_buffer.values[step] = self.critic.forward(tensor).flatten().numpy()
            rollout_buffer.log_probs[step] = self._log_prob(noise).numpy()
            self._last_obs, self._last_episode_starts = cast(Any, new_observation), dones
        rollout_buffer.pos, rollout_buffer.full = n_rollout_steps, True
        last_values = self.critic.forward(torch.from_numpy(cast(np.ndarray[Any, Any], self._last_obs)))
        rollout_buffer.compute_returns_and_advantage(last_values=last_values, dones=dones)
        callback.on_rollout_end()
        return True

    def _bootstrap(
        self, rewards: np.ndarray[Any, Any], dones: np.ndarray[Any, Any], infos: list[dict[str, Any]]
    ) -> None:
        """Add the discounted value of the state in which an episode was truncated to its last reward."""
        truncated = [i for i in np.flatnonzero(dones).tolist() if infos[i].get("TimeLimit.truncated")]
        if truncated:
            terminal = torch.from_numpy(np.stack([infos[i]["terminal_observation"] for i in truncated]))
            rewards[truncated] += self.gamma * self.critic.forward(terminal).flatten().numpy()

    def _log_prob(self, standardised: Tensor) -> Tensor:
        """Log density of actions given as (action - mean) / std, (n, actions); returns (n,)."""
        constant = float(self.log_std.sum()) + self.log_std.numel() * LOG_SQRT_TAU
        return standardised.square().sum(1).mul_(-0.5).sub_(constant)

    @torch.no_grad()
    def train(self) -> None:
        """Update policy and value function with the rollout in the buffer."""
        self._update_learning_rate(self.policy.optimizer)
        clip = float(self.clip_range(self._current_progress_remaining))  # type: ignore[operator]
        buffer = self.rollout_buffer
        rollout = [
            torch.from_numpy(np.ascontiguousarray(RolloutBuffer.swap_and_flatten(array)))
            for array in (buffer.observations, buffer.actions, buffer.log_probs, buffer.advantages, buffer.returns)
        ]
        statistics = []
        for _ in range(self.n_epochs):
            order = torch.from_numpy(np.random.permutation(len(rollout[0])))
            shuffled = [array.index_select(0, order) for array in rollout]
            for minibatch in zip(*(array.split(self.batch_size) for array in shuffled), strict=True):
                statistics.append(self._update(clip, *minibatch))
            self._n_updates += 1
        self._record(torch.stack(statistics).mean(0), buffer)

    def _update(
        self, clip: float, observation: Tensor, action: Tensor, old_log_prob: Tensor, advantage: Tensor, target: Tensor
    ) -> Tensor:
        """Take one gradient step on a minibatch; return its statistics in the order of `_record`."""
        n = len(observation)
        if self.normalize_advantage and n > 1:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        std = self.log_std.exp()
        standardised = (action - self.actor.forward(observation)).div_(std)
        log_ratio = self._log_prob(standardised).sub_(old_log_prob.flatten())
        ratio = log_ratio.exp()
        advantage = advantage.flatten()
        surrogate, clipped = advantage * ratio, advantage * ratio.clamp(1.0 - clip, 1.0 + clip)
        # The gradient flows where the clipped objective is not the smaller one.
        log_prob_gradient = torch.where(surrogate <= clipped, surrogate, 0.0).mul_(-1.0 / n).unsqueeze(1)
        self.actor.backward(log_prob_gradient * standardised / std)
        assert self.log_std.grad is not None
        self.log_std.grad.copy_((log_prob_gradient * (standardised.square() - 1.0)).sum(0) - self.ent_coef)
        error = self.critic.forward(observation).flatten() - target.flatten()
        self.critic.backward((error * (2.0 * self.vf_coef / n)).unsqueeze(1))
        self._clip_gradient()
        self.policy.optimizer.step()
        policy_loss = -torch.minimum(surrogate, clipped).mean()
        value_loss = error.square().mean()
        kl = (ratio - 1.0 - log_ratio).mean()
        clip_fraction = ((ratio - 1.0).abs() > clip).float().mean()
        entropy = self.log_std.sum() + self.log_std.numel() * (0.5 + LOG_SQRT_TAU)
        loss = policy_loss - self.ent_coef * entropy + self.vf_coef * value_loss
        return torch.stack([policy_loss, value_loss, -entropy, kl, clip_fraction, loss])

    def _clip_gradient(self) -> None:
        """Scale the whole gradient down to ``max_grad_norm``, as `torch.nn.utils.clip_grad_norm_` does."""
        norm = float(self.flat_gradient.norm())
        scale = self.max_grad_norm / (norm + 1e-6)
        if scale < 1.0 or math.isnan(norm):
            self.flat_gradient.mul_(scale)

    def _record(self, means: Tensor, buffer: RolloutBuffer) -> None:
        names = ("policy_gradient_loss", "value_loss", "entropy_loss", "approx_kl", "clip_fraction", "loss")
        for name, value in zip(names, means.tolist(), strict=True):
            self.logger.record(f"train/{name}", value)
        variance = explained_variance(buffer.values.flatten(), buffer.returns.flatten())
        self.logger.record("train/explained_variance", variance)
        self.logger.record("train/std", float(self.log_std.exp().mean()))
