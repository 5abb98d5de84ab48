"""The policy network and its file.

The architecture comes from the validated `Config`, the file holds weights alone (safetensors): loading
a stranger's policy executes nothing. SB3's own ``load`` functions unpickle and are never called.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import Tensor, nn

from srlrace.config import AlgoConfig, Config
from srlrace.files import atomic_write
from srlrace.learn.tensors import TensorFileError, pack, read_arrays
from srlrace.learn.update import LOG_STD_HIGH, LOG_STD_LOW
from srlrace.task.observation import observation_size
from srlrace.task.vec_env import action_space, observation_space

ACTIVATIONS: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh, "elu": nn.ELU}
FORMAT = "srlrace-policy-2"  # followed by a checksum of the weights
UNSEALED = "srlrace-policy-1"  # of earlier versions: without the checksum


def policy_arguments(algo: AlgoConfig) -> dict[str, Any]:
    """Return the keyword arguments that give SB3's actor-critic policy the configured architecture."""
    return {
        "net_arch": {"pi": list(algo.policy_layers), "vf": list(algo.value_layers)},
        "activation_fn": ACTIVATIONS[algo.activation],
        "log_std_init": algo.log_std_init,
    }


class StatePolicy(ActorCriticPolicy):
    """SB3's actor-critic policy with standard deviations that depend on the state.

    The policy network ends in twice as many numbers as there are actions: means, and what is added to ``log_std``.
    """

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        means = cast(nn.Linear, self.action_net)
        self.action_net = nn.Linear(means.in_features, 2 * means.out_features)
        with torch.no_grad():  # untrained, every state has the same
            for parameter, given in zip(self.action_net.parameters(), means.parameters(), strict=True):
                parameter.zero_()[: means.out_features] = given
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_action_dist_from_latent(self, latent_pi: Tensor) -> Distribution:
        output = self.action_net(latent_pi)
        means = output[:, : output.shape[1] // 2]
        return cast(DiagGaussianDistribution, self.action_dist).proba_distribution(means, log_deviations(self, output))


def log_deviations(policy: ActorCriticPolicy, output: Tensor) -> Tensor:
    """Log standard deviations (n, 4) that go with the ``output`` (n, 8) of a `StatePolicy`'s network."""
    return (policy.log_std + output[:, policy.log_std.numel() :]).clamp(LOG_STD_LOW, LOG_STD_HIGH)


def policy_class(algo: AlgoConfig) -> type[ActorCriticPolicy]:
    """Return the class of the configured policy."""
    return StatePolicy if algo.state_dependent_std else ActorCriticPolicy


def build_policy(config: Config) -> ActorCriticPolicy:
    """Build an untrained policy for ``config``, outside of any training."""
    space = observation_space(observation_size(config.observation))
    return policy_class(config.algo)(space, action_space(), lambda _: 0.0, **policy_arguments(config.algo))


def mean_head(policy: ActorCriticPolicy) -> nn.Linear:
    """Return the last layer of the policy network, as far as it gives the means of the actions."""
    head, actions = cast(nn.Linear, policy.action_net), policy.log_std.numel()
    means = nn.Linear(head.in_features, actions)
    means.load_state_dict({name: tensor[:actions] for name, tensor in head.state_dict().items()})
    return means


def state_arrays(module: nn.Module) -> dict[str, NDArray[Any]]:
    """Return the module's parameters as numpy arrays, by name."""
    return {name: tensor.detach().cpu().numpy() for name, tensor in module.state_dict().items()}


def load_state(module: nn.Module, arrays: dict[str, NDArray[Any]], source: str) -> None:
    """Load parameters strictly: same names, shapes and types, every value finite."""
    expected = module.state_dict()
    if set(arrays) != set(expected):
        raise TensorFileError(f"{source}: parameters {sorted(set(arrays) ^ set(expected))[:3]} do not match the config")
    for name, array in arrays.items():
        if array.shape != tuple(expected[name].shape) or array.dtype != expected[name].numpy().dtype:
            raise TensorFileError(
                f"{source}: {name} has shape {array.shape}, the config asks {tuple(expected[name].shape)}"
            )
        if not np.isfinite(array).all():
            raise TensorFileError(f"{source}: {name} is not finite")
    module.load_state_dict({name: torch.from_numpy(np.array(array)) for name, array in arrays.items()})


def save_policy(policy: ActorCriticPolicy, path: Path) -> None:
    """Write the policy's weights atomically."""
    arrays = state_arrays(policy)
    atomic_write(path, pack(arrays, {"format": f"{FORMAT} {_digest(arrays)}"}))  # one entry: their order is not fixed


def _digest(arrays: dict[str, NDArray[Any]]) -> str:
    """SHA-256 over names and values."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def load_policy(config: Config, path: Path) -> ActorCriticPolicy:
    """Rebuild the policy of ``config`` from its file; `TensorFileError` says why it cannot."""
    arrays, metadata = read_arrays(path)
    if metadata.get("format") not in (UNSEALED, f"{FORMAT} {_digest(arrays)}"):
        raise TensorFileError(f"{path}: not a {FORMAT} file, or damaged: its checksum does not match")
    policy = build_policy(config)
    load_state(policy, arrays, str(path))
    policy.set_training_mode(False)
    return policy


def mean_action(policy: ActorCriticPolicy, observation: Tensor) -> Tensor:
    """Return the mean action (n, 4) for observations (n, d), not clipped, for autograd to go back through."""
    features = cast(Tensor, policy.extract_features(observation, policy.pi_features_extractor))
    output: Tensor = policy.action_net(policy.mlp_extractor.forward_actor(features))
    return output[:, : policy.log_std.numel()]


def act(policy: ActorCriticPolicy, observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the deterministic action (n, 4) for observations (n, d), not yet clipped."""
    with torch.no_grad():
        action: NDArray[np.float32] = mean_action(policy, torch.from_numpy(observation)).numpy()
    return action
