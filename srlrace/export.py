"""A trained policy for use elsewhere: as ONNX for deployment, or as a file that Stable-Baselines3 loads.

Both map an observation as srlrace defines it (docs/task.md) to an action in [-1, 1]⁴. Only srlrace's own files are
read. There is no import: a file of Stable-Baselines3 is a pickle, and reading one would run what it holds.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn

from srlrace.config import Config
from srlrace.files import atomic_write
from srlrace.learn.policy import load_policy, mean_head, policy_arguments
from srlrace.runs import RunError, RunFolder
from srlrace.task.vec_env import action_space

FORMATS = {"onnx": ".onnx", "sb3": ".zip"}
OPSET = 17  # of ONNX: understood by every runtime since 2022
IR = 8  # file version of ONNX that belongs to it
ACTIVATIONS: dict[type[nn.Module], str] = {nn.ReLU: "Relu", nn.Tanh: "Tanh", nn.ELU: "Elu"}


def export(run: RunFolder, to: str, out: Path | None = None) -> Path:
    """Write the policy of a run as ``to``, `FORMATS`, and return the file's path; default: ``<run id>.<suffix>`` here.

    Raises `RunError` for another format or a missing package, `FileError` for a policy that cannot be used.
    """
    if to not in FORMATS:
        raise RunError(f"--to: got {to!r:.40}; takes one of {', '.join(FORMATS)}")
    path = out or Path(run.id + FORMATS[to])
    config = run.load_config()
    policy = load_policy(config, run.file("policy.safetensors"))
    atomic_write(path, onnx_bytes(policy) if to == "onnx" else sb3_bytes(config, policy))
    return path


class _Spaces(gymnasium.Env[Any, Any]):
    """What Stable-Baselines3 asks of an environment before anything is flown: its spaces."""

    def __init__(self, policy: ActorCriticPolicy) -> None:
        self.observation_space = policy.observation_space
        self.action_space = action_space()


def sb3_bytes(config: Config, policy: ActorCriticPolicy) -> bytes:
    """The policy as a file of Stable-Baselines3's PPO, without a class of srlrace in it.

    Standard deviations that depend on the state stay behind: the file's policy has the same means.
    """
    model = PPO("MlpPolicy", _Spaces(policy), policy_kwargs=policy_arguments(config.algo), device="cpu", n_steps=2,
                batch_size=2, gamma=config.algo.gamma)  # fmt: skip
    head = {f"action_net.{name}": tensor for name, tensor in mean_head(policy).state_dict().items()}
    model.policy.load_state_dict(policy.state_dict() | head)
    stream = io.BytesIO()
    model.save(stream)
    return stream.getvalue()


def onnx_bytes(policy: ActorCriticPolicy) -> bytes:
    """The deterministic policy as an ONNX graph: ``observation`` (n, d) float32 to ``action`` (n, 4) float32."""
    try:
        from onnx import TensorProto, checker, helper, numpy_helper
    except ImportError:
        raise RunError("--to onnx needs a package: pip install 'srlrace[export]'") from None
    layers = [*policy.mlp_extractor.policy_net, mean_head(policy)]
    nodes, weights, name = [], [], "observation"
    for index, layer in enumerate(layers):
        if isinstance(layer, nn.Linear):
            stored = {f"weight{index}": layer.weight, f"bias{index}": layer.bias}
            weights += [numpy_helper.from_array(_numbers(tensor), key) for key, tensor in stored.items()]
            nodes.append(helper.make_node("Gemm", [name, *stored], [f"layer{index}"], transB=1))
        else:
            nodes.append(helper.make_node(ACTIVATIONS[type(layer)], [name], [f"layer{index}"]))
        name = f"layer{index}"
    weights += [numpy_helper.from_array(np.array(limit, np.float32), key) for key, limit in (("low", -1), ("high", 1))]
    nodes.append(helper.make_node("Clip", [name, "low", "high"], ["action"]))
    size = policy.observation_space.shape[0] if policy.observation_space.shape else 0
    given = helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["n", size])
    taken = helper.make_tensor_value_info("action", TensorProto.FLOAT, ["n", 4])
    graph = helper.make_graph(nodes, "srlrace", [given], [taken], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))


def _numbers(tensor: torch.Tensor) -> NDArray[np.float32]:
    return np.ascontiguousarray(tensor.detach().numpy(), np.float32)
