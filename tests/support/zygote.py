"""Starts srlrace's commands in processes of their own without the seconds that importing everything takes.

Run as a program, it imports all, trains and evaluates once to load every kernel, and then forks a process for each
line of JSON that it reads: ``{"calls": [[word, ...], ...], "out": file, "env": {...}, "cwd": folder, "set": {...}}``,
whose commands that process runs one after the other. It answers with the process's id, and to ``{"wait": id}`` with
how it ended and what it used. `Zygote` is the other end, for tests.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import guards

PATIENCE = 600  # s after which a process that hangs is ended; no test waits for so long
WARM = [
    "level=1", "algo.n_envs=8", "algo.n_steps=16", "algo.batch_size=64", "algo.n_epochs=1", "algo.policy_layers=[16]",
    "algo.value_layers=[16]", "algo.total_steps=128",
]  # fmt: skip


@dataclass(frozen=True)
class Ending:
    """How a process ended: its exit status (negative: the signal that killed it), and what it used."""

    status: int
    seconds: float  # of CPU
    peak: int  # bytes of memory, at most at once


class Zygote:
    """A running zygote."""

    def __init__(self) -> None:
        command = [sys.executable, str(Path(__file__).absolute())]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout.readline() == "ready\n"

    def _ask(self, question: dict[str, Any]) -> Any:
        self._process.stdin.write(json.dumps(question) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())

    def start(self, *calls: list[str], out: Path, cwd: Path | None = None, env: dict[str, str] | None = None,
              set: dict[str, Any] | None = None, file_limit: int = 0, guarded: bool = False) -> int:  # fmt: skip
        """Start a process that runs ``srlrace`` with each list of words; returns its id.

        ``set`` gives attributes of modules other values there, as ``module:attribute``; ``file_limit`` is the size
        in bytes that its files may have. ``guarded``: it can neither unpickle nor use the network.
        """
        calls_text = [[str(word) for word in call] for call in calls]
        return self._ask({"calls": calls_text, "out": str(out), "cwd": str(cwd or out.parent), "env": env or {},
                          "set": set or {}, "file_limit": file_limit, "guarded": guarded})  # fmt: skip

    def wait(self, process: int) -> Ending:
        """How a process ended."""
        return Ending(**self._ask({"wait": process}))

    def run(self, *calls: list[str], out: Path, **options: Any) -> Ending:
        """Start a process and wait for its end."""
        return self.wait(self.start(*calls, out=out, **options))

    def close(self) -> None:
        self._process.stdin.close()
        self._process.wait(timeout=30)


def main() -> None:
    from srlrace import __main__ as program

    with (
        tempfile.TemporaryDirectory() as folder,
        Path(os.devnull).open("w") as null,
        contextlib.redirect_stderr(null),
        contextlib.redirect_stdout(null),
    ):
        for module in ("report.command", "tables", "bench", "recording.recover", "hydra_bridge"):
            importlib.import_module(f"srlrace.{module}")
        call(program, ["train", *WARM, "--runs", folder])
        call(program, ["eval", "--episodes", "3", "--runs", folder])
    answer("ready")
    for line in sys.stdin:
        question = json.loads(line)
        answer(json.dumps(ended(question["wait"]) if "wait" in question else born(program, question)))


def answer(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def born(program: Any, question: dict[str, Any]) -> int:
    process = os.fork()
    if process:
        return process
    status = 70
    try:
        os.close(0)
        out = os.open(question["out"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.dup2(out, 1)
        os.dup2(out, 2)
        os.environ.update(question["env"])
        os.chdir(question["cwd"])
        if question["file_limit"]:
            resource.setrlimit(resource.RLIMIT_FSIZE, (question["file_limit"],) * 2)
        for place, value in question["set"].items():
            module, _, attribute = place.partition(":")
            setattr(importlib.import_module(module), attribute, value)
        signal.alarm(PATIENCE)
        if question["guarded"]:
            guards.forbid_unpickling()
            guards.forbid_network()
        for words in question["calls"]:
            status = call(program, words)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def call(program: Any, words: list[str]) -> int:
    sys.argv = ["srlrace", *words]
    try:
        program.main()
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    return 0


def ended(process: int) -> dict[str, Any]:
    _, status, used = os.wait4(process, 0)
    seconds = used.ru_utime + used.ru_stime
    return {"status": os.waitstatus_to_exitcode(status), "seconds": seconds, "peak": used.ru_maxrss * 1024}


if __name__ == "__main__":
    main()
