"""What no test may do: unpickle anything, or reach beyond this machine."""

from __future__ import annotations

import functools
import importlib
import ipaddress
import pickle
import socket
import sys
from collections.abc import Callable
from typing import Any

# Numba loads the machine code of our own kernels, from a folder that only their owner can write to, and processes of
# one test talk to one another; neither reads a file that anybody else could have written.
EXEMPT = ("numba.", "multiprocessing.", "concurrent.", "execnet.", "_pytest.", "xdist.")
PLACES = (
    ("pickle", "load"), ("pickle", "loads"), ("torch", "load"), ("torch", "jit.load"), ("numpy", "load"),
    ("pandas", "read_pickle"), ("joblib", "load"), ("cloudpickle", "load"), ("cloudpickle", "loads"),
    ("stable_baselines3.common.save_util", "load_from_zip_file"),
    ("stable_baselines3.common.base_class", "load_from_zip_file"),
)  # fmt: skip


class Unpickled(AssertionError):
    """Something was about to be unpickled."""


class Networked(AssertionError):
    """Something was about to use the network."""


def _exempt(depth: int = 2) -> bool:
    return str(sys._getframe(depth).f_globals.get("__name__", "")).startswith(EXEMPT)


def _refusing(real: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(real)
    def call(*rest: Any, **options: Any) -> Any:
        if _exempt() or options.get("allow_pickle") is False:  # numpy's own format
            return real(*rest, **options)
        raise Unpickled(f"{real.__module__}.{real.__name__} was called")

    return call


class _Unpickler(pickle.Unpickler):
    def __init__(self, *rest: Any, **options: Any) -> None:
        if not _exempt():
            raise Unpickled("a pickle.Unpickler was made")
        super().__init__(*rest, **options)


def forbid_unpickling(patch: Callable[[Any, str, Any], None] = setattr) -> None:
    """Let every unpickler raise `Unpickled`."""
    patch(pickle, "Unpickler", _Unpickler)
    for name, attribute in PLACES:
        module = importlib.import_module(name)
        *inner, attribute = attribute.split(".")
        for part in inner:
            module = getattr(module, part)
        patch(module, attribute, _refusing(getattr(module, attribute)))


def _local(address: Any) -> bool:
    if not isinstance(address, tuple):
        return True  # a socket of this machine: a path
    try:
        return address[0] in ("", "localhost") or ipaddress.ip_address(address[0]).is_loopback
    except ValueError:
        return False


def forbid_network(patch: Callable[[Any, str, Any], None] = setattr) -> None:
    """Let every connection but those within this machine raise `Networked`."""
    for name in ("connect", "connect_ex", "sendto"):
        real = getattr(socket.socket, name)

        def connect(self: socket.socket, *rest: Any, real: Any = real) -> Any:
            if not _local(rest[-1]):
                raise Networked(f"a connection to {rest[-1]!r}")
            return real(self, *rest)

        patch(socket.socket, name, connect)
    resolve = socket.getaddrinfo

    def getaddrinfo(host: Any, *rest: Any, **options: Any) -> Any:
        if host is not None and not _local((host,)):
            raise Networked(f"a look-up of {host!r}")
        return resolve(host, *rest, **options)

    patch(socket, "getaddrinfo", getaddrinfo)
