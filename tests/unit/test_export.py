"""Exported policies act as the policy does, in Stable-Baselines3 and in an ONNX runtime, without srlrace."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from srlrace.config import to_dict
from srlrace.export import export
from srlrace.learn.policy import act, build_policy, save_policy
from srlrace.runs import RunError, RunFolder


@pytest.fixture(params=["false", "true"], ids=["one-std", "std-by-state"])
def trained(config, tmp_path, request):
    """A run with a policy of random weights, and what it does with random observations."""
    settings = config(
        "level=none", "algo.policy_layers=[16,8]", "algo.value_layers=[8]", "algo.activation=elu",
        f"algo.state_dependent_std={request.param}",
    )  # fmt: skip
    torch.manual_seed(3)
    policy = build_policy(settings)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(json.dumps(to_dict(settings)))
    save_policy(policy, tmp_path / "run" / "policy.safetensors")
    size = policy.observation_space.shape[0]
    observation = 100 * np.random.default_rng(0).normal(size=(50, size)).astype(np.float32)
    return RunFolder(tmp_path / "run"), observation, np.clip(act(policy, observation), -1, 1)


LOAD = """
import sys
import numpy as np
sys.modules["srlrace"] = None  # not to be imported: whoever gets the file does not have it
from stable_baselines3 import PPO
observation, expected = np.load(sys.argv[2], allow_pickle=False), np.load(sys.argv[3], allow_pickle=False)
action, _ = PPO.load(sys.argv[1]).predict(observation, deterministic=True)
np.testing.assert_allclose(action, expected, atol=1e-5)
"""


def test_stable_baselines_loads_it(trained, tmp_path):
    """In a process of its own: loading such a file unpickles, which no test here may."""
    run, observation, expected = trained
    path = export(run, "sb3", tmp_path / "policy.zip")
    files = tmp_path / "o.npy", tmp_path / "e.npy"
    for file, array in zip(files, (observation, expected), strict=True):
        np.save(file, array)
    done = subprocess.run([sys.executable, "-c", LOAD, path, *files], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_an_onnx_runtime_runs_it(trained, tmp_path):
    pytest.importorskip("onnx", reason="the extra srlrace[export] is not installed")
    runtime = pytest.importorskip("onnxruntime", reason="no ONNX runtime is installed")
    run, observation, expected = trained
    path = export(run, "onnx", tmp_path / "policy.onnx")
    session = runtime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    [action] = session.run(["action"], {"observation": observation})
    np.testing.assert_allclose(action, expected, atol=1e-4)
    assert np.abs(expected).max() == 1  # some were clipped
    first = path.read_bytes()
    assert export(run, "onnx", path).read_bytes() == first


def test_other_formats_are_refused(trained):
    with pytest.raises(RunError, match="--to: got 'pickle'; takes one of onnx, sb3"):
        export(trained[0], "pickle")
