"""Run folders that somebody made to do harm: each begins as a genuine run, with one thing exchanged."""

from __future__ import annotations

import json
import os
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zstandard

VARIABLE, SECRET = "SRLRACE_CANARY", "canary-4711-value"
Attack = Callable[[Path, Path], None]
"""Changes the run folder (first); the second is the folder outside of it whose files must stay as they are."""

MEBIBYTE = 2**20
SUITE = "eval/train_map"
FILES = (
    "config.json", "run.json", "policy.safetensors", "progress.csv", "error.txt", "train.log", "lock",
    f"{SUITE}/summary.json", f"{SUITE}/episodes.csv", f"{SUITE}/trajectories.mcap",
)  # fmt: skip
TEXTS = {
    "terminal": "\x1b]0;owned\x07\x1b[2J\x9b31m\u202eevil",
    "markup": "[bold red]x[/] [link=file:///etc/passwd]y[/link] [/nothing]",
    "script": "</script><script>alert(1)</script><img src=x onerror=alert(1)>",
    "latex": r"\input{/etc/passwd}\write18{touch canary}",
    "formula": "=cmd|'/C touch canary'!A0",
    "interpolation": f"${{oc.env:{VARIABLE}}}${{hydra:runtime.cwd}}",
    "path": "../../../../outside/victim",
    "format": "{0.__class__.__mro__} %s %n",
}
TARGETS: tuple[Any, ...] = (
    {"_target_": "os.system", "command": "touch canary"},
    {"_target_": "builtins.open", "file": "canary", "mode": "w"},
    {"_target_": "pathlib.Path.write_text", "self": "canary", "data": "x"},
    {"_target_": "shutil.copy", "src": "/etc/passwd", "dst": "canary"},
    {"_target_": "subprocess.Popen", "args": ["touch", "canary"]},
    {"_target_": "builtins.exec", "_args_": ["open('canary', 'w')"]},
    {"_target_": "hydra.utils.instantiate", "_recursive_": True, "config": {"_target_": "os.abort"}},
    {"_partial_": True, "_target_": "os.system", "command": "touch canary"},
    {"_convert_": "object", "_target_": "torch.load", "f": "policy.safetensors"},
    {"_target_": "srlrace.cli.main"},
    {"_target_": "os.system", "_args_": ["touch canary"], "name": "forest"},
    [{"_target_": "os.system", "command": "touch canary"}],
)
YAML_TAG = "!!python/object/apply:os.system ['touch canary']\n"
YAML_BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


class _Payload:
    def __reduce__(self) -> Any:
        return os.system, ("touch canary",)


PICKLE = pickle.dumps({"weights": _Payload(), "class_name": _Payload()})


def attacks() -> Iterator[tuple[str, Attack]]:
    """Every attack, by name."""
    yield "genuine", lambda run, outside: None
    for name in FILES:
        yield f"pickle in {name}", content(name, PICKLE)
        yield f"link in {name}", link(name, "victim")
        yield f"pipe in {name}", pipe(name)
        yield f"folder in {name}", folder(name)
        yield f"ten gigabytes in {name}", sparse(name)
    for name in ("config.json", "run.json", f"{SUITE}/summary.json", "checkpoint/000000000000384.json"):
        yield f"depth in {name}", content(name, b'{"a":' * 200_000 + b"1" + b"}" * 200_000)
        yield f"long number in {name}", content(name, b'{"seed": ' + b"9" * 500_000 + b"}")
        yield f"YAML in {name}", content(name, YAML_TAG.encode())
        yield f"aliases in {name}", content(name, YAML_BOMB.encode())
        yield f"not a number in {name}", content(name, b'{"seed": NaN, "episodes": Infinity}')
        yield f"no text in {name}", content(name, b"\xff\xfe\x00\xd8")
    for index, target in enumerate(TARGETS):
        yield f"target {index} in env", setting(("env",), target)
        yield f"target {index} in algo.activation", setting(("algo", "activation"), target)
    for kind, text in TEXTS.items():
        yield f"{kind} in config", setting(("name",), text)
        yield f"{kind} in a key of config", setting((text,), text)
        yield (
            f"{kind} in run.json",
            replaced("run.json", dict.fromkeys(("argv", "cpu", "started", "run", text), text)),
        )
        yield f"{kind} in a summary", replaced(f"{SUITE}/summary.json", {"suite": text, "outcomes": text, text: text})
        yield f"{kind} in episodes", column(text)
        yield f"{kind} in progress", content("progress.csv", f"steps,{text},time_s\n384,{text},{text}\n".encode())
        yield f"{kind} in error.txt", content("error.txt", text.encode())
    for name in ("eval", "checkpoint"):
        yield f"link in {name}", link(name, ".")
    yield "zip bomb as policy", zip_bomb
    yield "SB3 zip as policy", sb3_zip
    yield "zstd bomb in the recording", zstd_bomb
    yield "header of the policy lies", content("policy.safetensors", struct.pack("<Q", 2**62) + b"{}")
    yield "tensor of the policy lies", tensor_lies
    yield "members that climb", climbing
    yield "a million columns", content(f"{SUITE}/episodes.csv", b"a," * 10**6 + b"\n" + b"1," * 10**6 + b"\n")
    yield "enormous numbers", column("9" * 400)
    yield "a network of gigabytes", setting(("algo", "policy_layers"), [65_536] * 8)
    yield "endless episodes", setting(("env", "horizon"), 1e300)
    yield "many maps", setting(("level", "maps"), 10**9)


def content(name: str, data: bytes) -> Attack:
    def attack(run: Path, outside: Path) -> None:
        (run / name).write_bytes(data)

    return attack


def _remove(path: Path) -> None:
    if path.is_dir():
        for inner in path.iterdir():
            _remove(inner)
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def link(name: str, target: str) -> Attack:
    def attack(run: Path, outside: Path) -> None:
        _remove(run / name)
        (run / name).symlink_to(outside / target)

    return attack


def pipe(name: str) -> Attack:
    def attack(run: Path, outside: Path) -> None:
        _remove(run / name)
        os.mkfifo(run / name)

    return attack


def folder(name: str) -> Attack:
    def attack(run: Path, outside: Path) -> None:
        _remove(run / name)
        (run / name).mkdir()

    return attack


def sparse(name: str) -> Attack:
    def attack(run: Path, outside: Path) -> None:
        with (run / name).open("r+b" if (run / name).exists() else "wb") as stream:
            stream.truncate(10 * 2**30)

    return attack


def setting(path: tuple[str, ...], value: Any) -> Attack:
    """Another setting, with the checksums made right again."""

    def attack(run: Path, outside: Path) -> None:
        config = json.loads((run / "config.json").read_text())
        place = config
        for name in path[:-1]:
            place = place[name]
        place[path[-1]] = value
        (run / "config.json").write_text(json.dumps(config))
        replaced("run.json", {})(run, outside)

    return attack


def replaced(name: str, values: dict[str, Any]) -> Attack:
    """Other values in a JSON file, without its checksums."""

    def attack(run: Path, outside: Path) -> None:
        data = json.loads((run / name).read_text()) | values
        for key in ("seal", "config_sha256", "episodes_sha256"):
            data.pop(key, None)
        (run / name).write_text(json.dumps(data))

    return attack


def column(text: str) -> Attack:
    """A value in every column of the episodes, one after the other, with no checksum to notice it."""

    def attack(run: Path, outside: Path) -> None:
        replaced(f"{SUITE}/summary.json", {})(run, outside)
        path = run / SUITE / "episodes.csv"
        header, *rows = path.read_text().splitlines()
        fields = [row.split(",") for row in rows]
        for index, row in enumerate(fields):
            row[index % len(row)] = '"' + text.replace('"', '""') + '"'
        path.write_text("\n".join([header, *(",".join(row) for row in fields)]) + "\n")

    return attack


def zip_bomb(run: Path, outside: Path) -> None:
    with zipfile.ZipFile(run / "policy.safetensors", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("policy.pth", bytes(200 * MEBIBYTE))


def sb3_zip(run: Path, outside: Path) -> None:
    with zipfile.ZipFile(run / "policy.safetensors", "w") as archive:
        archive.writestr("data", json.dumps({"policy_class": {":type:": "x", ":serialized:": PICKLE.hex()}}))
        archive.writestr("policy.pth", PICKLE)


def zstd_bomb(run: Path, outside: Path) -> None:
    from mcap.records import Chunk

    from srlrace.recording.container import MAGIC, serialise

    path = run / SUITE / "trajectories.mcap"
    packed = zstandard.compress(bytes(1024 * MEBIBYTE), 1)
    chunk = Chunk(compression="zstd", data=packed, message_start_time=0, message_end_time=1, uncompressed_crc=0,
                  uncompressed_size=1024 * MEBIBYTE)  # fmt: skip
    path.with_name("trajectories.mcap.part").write_bytes(MAGIC + path.read_bytes()[8:400] + serialise(chunk))
    path.write_bytes(path.read_bytes()[:-60] + serialise(chunk) + path.read_bytes()[-60:])


def tensor_lies(run: Path, outside: Path) -> None:
    header = json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    (run / "policy.safetensors").write_bytes(struct.pack("<Q", len(header)) + header)


def climbing(run: Path, outside: Path) -> None:
    """Names that lead elsewhere, in a recording's attachments and as names of suites and checkpoints."""
    from srlrace.recording.container import McapStream

    with (run / SUITE / "trajectories.mcap.part").open("wb") as stream:
        out = McapStream(stream, "x")
        for name in ("../../../../outside/victim", "/etc/canary", "config.json\0.sh"):
            out.attachment(name, "text/csv", b"harm", 0)
    for name in ("..\\x", "a\nb", "-rf", "~root", "$HOME", " "):
        (run / "eval" / name).mkdir(exist_ok=True)
        (run / "eval" / name / "summary.json").write_text('{"episodes": 1, "suite": "../../outside"}')
        (run / "checkpoint" / f"{name}.json").write_text('{"steps": 1, "sha256": "../../outside", "facts": {}}')
