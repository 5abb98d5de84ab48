"""The guards of all tests do guard."""

import io
import pickle
import socket

import numpy as np
import pytest
import torch
from guards import Networked, Unpickled
from stable_baselines3 import PPO


def test_nothing_is_unpickled(tmp_path):
    data = pickle.dumps({"a": 1})
    for attempt in (
        lambda: pickle.loads(data),  # noqa: S301
        lambda: pickle.load(io.BytesIO(data)),  # noqa: S301
        lambda: pickle.Unpickler(io.BytesIO(data)).load(),  # noqa: S301
        lambda: np.load(io.BytesIO(data), allow_pickle=True),
        lambda: torch.load(io.BytesIO(data)),
        lambda: PPO.load(tmp_path / "x"),
    ):
        with pytest.raises(Unpickled):
            attempt()


def test_nothing_is_fetched():
    assert socket.socket.connect.__module__ == "guards"  # else this test would do what it is to prevent
    with socket.socket() as outside, pytest.raises(Networked):
        outside.connect(("192.0.2.1", 80))  # an address that documentation may use
    with pytest.raises(Networked):
        socket.getaddrinfo("example.org", 80)
    with socket.socket() as listening, socket.socket() as near:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        near.connect(listening.getsockname())
