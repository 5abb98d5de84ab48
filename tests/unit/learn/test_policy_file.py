"""Policy files: exact round trip, and nothing but the right arrays is ever accepted; nothing is unpickled."""

import json
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
import torch

from srlrace.files import FileError
from srlrace.learn.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from srlrace.learn.policy import _digest as checksum
from srlrace.learn.policy import act, build_policy, load_policy, save_policy
from srlrace.learn.tensors import TensorFileError, pack, read_arrays


@pytest.fixture(scope="module")
def policy(tiny):
    torch.manual_seed(1)
    return build_policy(tiny)


@pytest.fixture
def path(tmp_path, policy):
    save_policy(policy, tmp_path / "policy.safetensors")
    return tmp_path / "policy.safetensors"


@pytest.fixture
def no_pickle(monkeypatch):
    """Whoever unpickles fails."""

    def refuse(*args, **kwargs):
        raise AssertionError("unpickled")

    for module, name in ((pickle, "load"), (pickle, "loads"), (pickle, "Unpickler"), (torch, "load"), (np, "load")):
        monkeypatch.setattr(module, name, refuse)


@pytest.mark.usefixtures("no_pickle")
def test_round_trip(tiny, policy, path):
    loaded = load_policy(tiny, path)
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, loaded.state_dict()[name]), name
    observation = np.random.default_rng(0).normal(size=(20, 34)).astype(np.float32)
    np.testing.assert_array_equal(act(loaded, observation), act(policy, observation))
    save_policy(loaded, path.with_name("again"))
    assert path.with_name("again").read_bytes() == path.read_bytes()


def test_acting_is_what_sb3_predicts(policy):
    observation = np.random.default_rng(0).normal(size=(20, 34)).astype(np.float32)
    with torch.no_grad():
        mean = policy.get_distribution(torch.from_numpy(observation)).mode().numpy()
    np.testing.assert_allclose(act(policy, observation), mean, rtol=1e-6)
    predicted, _ = policy.predict(observation, deterministic=True)
    np.testing.assert_allclose(np.clip(mean, -1, 1), predicted, rtol=1e-6)


def test_the_file_holds_weights_alone(path, policy):
    arrays, metadata = read_arrays(path)
    assert arrays.keys() == policy.state_dict().keys()
    assert metadata["format"].startswith("srlrace-policy-2 ")


@pytest.mark.usefixtures("no_pickle")
def test_policies_of_earlier_versions_have_no_checksum(tiny, path):
    arrays, _ = read_arrays(path)
    path.write_bytes(pack(arrays, {"format": "srlrace-policy-1"}))
    load_policy(tiny, path)


def test_another_number_is_noticed(tiny, path):
    arrays, metadata = read_arrays(path)
    arrays = {name: array.copy() for name, array in arrays.items()}
    arrays[FIRST][3, 3] *= 1.0001
    path.write_bytes(pack(arrays, metadata))
    with pytest.raises(TensorFileError, match="its checksum does not match"):
        load_policy(tiny, path)


def rewrite(path, change):
    """Write the same file with its arrays changed, as a forger would."""
    arrays, _ = read_arrays(path)
    arrays = dict(arrays)
    change(arrays)
    path.write_bytes(pack(arrays, {"format": f"srlrace-policy-2 {checksum(arrays)}"}))


FIRST = "mlp_extractor.policy_net.0.weight"


def renamed(arrays):
    arrays["mlp_extractor.policy_net.7.weight"] = arrays.pop(FIRST)


def missing(arrays):
    del arrays[FIRST]


def added(arrays):
    arrays["exec"] = np.zeros(3, np.float32)


def other_shape(arrays):
    arrays[FIRST] = arrays[FIRST].T


def other_type(arrays):
    arrays[FIRST] = arrays[FIRST].astype(np.float64)


def not_a_number(arrays):
    arrays[FIRST][3, 3] = np.nan


def infinite(arrays):
    arrays["log_std"][0] = np.inf


@pytest.mark.usefixtures("no_pickle")
@pytest.mark.parametrize("change", [renamed, missing, added, other_shape, other_type, not_a_number, infinite])
def test_other_arrays_are_refused(tiny, path, change):
    rewrite(path, change)
    with pytest.raises(TensorFileError) as refusal:
        load_policy(tiny, path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def header(path, text: bytes, size: int | None = None) -> None:
    path.write_bytes(struct.pack("<Q", len(text) if size is None else size) + text)


def nothing(path):
    path.write_bytes(b"")


def garbage(path):
    path.write_bytes(np.random.default_rng(0).bytes(5000))


def truncated(path):
    path.write_bytes(path.read_bytes()[:-100])


def truncated_header(path):
    path.write_bytes(path.read_bytes()[:40])


def appended(path):
    path.write_bytes(path.read_bytes() + b"x")


def huge_header(path):
    header(path, b"{}", 2**63)


def larger_than_allowed(path):
    header(path, b'{"a": "' + b" " * 2**21 + b'"}')


def no_json(path):
    header(path, b"{" * 1000)


def deep_json(path):
    header(path, b"[" * 100_000)


def a_list(path):
    header(path, b"[1, 2]")


def bad_metadata(path):
    header(path, b'{"__metadata__": {"format": 3}}')


def past_the_end(path):
    header(path, json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode())


def overlapping(path):
    one = {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]}
    header(path, json.dumps({"a": one, "b": one}).encode())
    path.write_bytes(path.read_bytes() + bytes(8))


def strange_type(path):
    header(path, json.dumps({"a": {"dtype": "PY", "shape": [1], "data_offsets": [0, 8]}}).encode())
    path.write_bytes(path.read_bytes() + bytes(8))


def a_pickle(path):
    path.write_bytes(pickle.dumps({"a": 1}))


def a_zip(path):
    path.write_bytes(b"PK\x03\x04" + bytes(100))


def other_format(path):
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(3)}, {"format": "srlrace-policy-2"}))


def a_folder(path):
    path.unlink()
    path.mkdir()


def a_link(path):
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


BROKEN = (
    nothing, garbage, truncated, truncated_header, appended, huge_header, larger_than_allowed, no_json, deep_json,
    a_list, bad_metadata, past_the_end, overlapping, strange_type, a_pickle, a_zip, other_format, a_folder, a_link,
)  # fmt: skip


@pytest.mark.usefixtures("no_pickle")
@pytest.mark.parametrize("damage", BROKEN)
def test_other_files_are_refused_in_one_line(tiny, path, damage):
    damage(path)
    with pytest.raises(FileError) as refusal:
        load_policy(tiny, path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_no_more_than_the_limit_is_read(path):
    size = path.stat().st_size
    assert read_arrays(path, size)[0]
    with pytest.raises(FileError, match=f"larger than {size - 1} bytes"):
        read_arrays(path, size - 1)


def test_a_policy_of_other_size_is_refused(config, path):
    larger = config("level=none", "algo.policy_layers=[16,17]", "algo.value_layers=[16,16]")
    with pytest.raises(TensorFileError, match=r"has shape \(\d+, ?\d*\), the config asks"):
        load_policy(larger, path)


def checkpoint(steps: int) -> Checkpoint:
    return Checkpoint(steps, {"a/b": np.arange(steps), "c": np.float32([[1, 2]])}, {"wall_s": 1.5})


def test_no_seal_is_ever_without_what_it_seals(tmp_path, monkeypatch):
    """Whichever file a save removed last before it was killed."""
    for steps in (10, 20):
        save_checkpoint(tmp_path, checkpoint(steps))
    remove, seen = Path.unlink, []

    def removing(path, missing_ok=False):
        remove(path, missing_ok)
        seals, sealed = ({found.stem for found in tmp_path.glob(f"*.{kind}")} for kind in ("json", "safetensors"))
        seen.append(seals - sealed)

    monkeypatch.setattr(Path, "unlink", removing)
    save_checkpoint(tmp_path, checkpoint(30))
    assert seen == [set(), set()]


@pytest.mark.usefixtures("no_pickle")
def test_checkpoints_keep_two_generations(tmp_path):
    folder = tmp_path / "checkpoint"
    assert load_checkpoint(folder) is None
    for steps in (10, 20, 30, 40):
        save_checkpoint(folder, checkpoint(steps))
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"{steps:015d}.{kind}" for steps in (30, 40) for kind in ("json", "safetensors")]
    loaded = load_checkpoint(folder)
    assert (loaded.steps, loaded.facts) == (40, {"wall_s": 1.5})
    np.testing.assert_array_equal(loaded.arrays["a/b"], np.arange(40))
    assert loaded.arrays["c"].dtype == np.float32


def flip(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(bytes(data))


def cut(path):
    path.write_bytes(path.read_bytes()[:-2])  # one: the line end of JSON, which is nothing


def unlink(path):
    path.unlink()


def empty(path):
    path.write_bytes(b"")


@pytest.mark.usefixtures("no_pickle")
@pytest.mark.parametrize("damage", [flip, cut, unlink, empty, a_folder])
@pytest.mark.parametrize("kind", ["safetensors", "json"])
def test_a_damaged_checkpoint_falls_back_with_a_warning(tmp_path, caplog, damage, kind):
    save_checkpoint(tmp_path, checkpoint(10))
    save_checkpoint(tmp_path, checkpoint(20))
    damage(tmp_path / f"{20:015d}.{kind}")
    assert load_checkpoint(tmp_path).steps == 10
    if (damage, kind) != (unlink, "json"):  # without its seal it does not count: a kill leaves it so
        [record] = caplog.records
        assert record.levelname == "WARNING"
        assert f"{20:015d}" in record.getMessage()
    save_checkpoint(tmp_path, checkpoint(30))  # and the next save puts everything in order
    assert load_checkpoint(tmp_path).steps == 30


def test_with_every_generation_damaged_training_starts_anew(tmp_path, caplog):
    for steps in (10, 20):
        save_checkpoint(tmp_path, checkpoint(steps))
        flip(tmp_path / f"{steps:015d}.safetensors")
    assert load_checkpoint(tmp_path) is None
    assert len(caplog.records) == 2
