"""What holds of a runs folder after any failure: complete old files or complete new ones, and listing works.

And how far its runs have come, to fail them there.
"""

from __future__ import annotations

import io
import time
from hashlib import sha256
from pathlib import Path

from rich.console import Console

from srlrace.config import load_config
from srlrace.files import LEFTOVER, read_json
from srlrace.learn.checkpoint import load_generation
from srlrace.learn.policy import load_policy
from srlrace.recording import read_metadata
from srlrace.report.collect import collect
from srlrace.runs import list_runs
from srlrace.tables import runs_table

FINAL = ("policy.safetensors", "config.json")
EVALUATED = ("episodes.csv", "summary.json", "trajectories.mcap")


def check_root(root: Path) -> None:
    """Every file below ``root`` that bears its final name is complete, and the commands that look at runs work."""
    for folder in root.glob("*/"):
        check_run(folder)
    Console(file=io.StringIO(), width=200).print(runs_table(list_runs(root)))
    collect(root)


def check_run(folder: Path) -> None:
    config_path, policy = folder / "config.json", folder / "policy.safetensors"
    if config_path.exists():
        config = load_config(config_path)
        if policy.exists():
            load_policy(config, policy)
    if (folder / "run.json").exists():
        read_json(folder / "run.json")
    for seal in folder.glob("checkpoint/*.json"):
        load_generation(seal)
    for suite in folder.glob("eval/[a-z]*/"):
        if (suite / "summary.json").exists():
            read_json(suite / "summary.json")
        if (suite / "episodes.csv").exists():
            assert (suite / "episodes.csv").read_bytes().endswith(b"\n")
        if (suite / "trajectories.mcap").exists():
            read_metadata(suite / "trajectories.mcap")  # verifies the checksum of all of it


def leftovers(root: Path) -> list[str]:
    """What killed processes left behind."""
    return [path.name for path in root.rglob(".*") if LEFTOVER.fullmatch(path.name)]


def results(folder: Path) -> dict[str, str]:
    """Hashes of what must be the same to the byte however a run was disturbed: settings, weights, evaluation."""
    found = {name: (folder / name).read_bytes() for name in FINAL}
    for path in sorted(folder.glob("eval/*/*")):
        if path.name in EVALUATED:
            found[f"{path.parent.name}/{path.name}"] = path.read_bytes()
    rows = (folder / "progress.csv").read_text().splitlines()
    untimed = [[row.split(",")[0], *row.split(",")[3:]] for row in rows]  # without wall-clock and speed
    found["progress.csv"] = repr(untimed).encode()
    return {name: sha256(content).hexdigest() for name, content in found.items()}


def saved(root: Path) -> int:
    """The newest checkpoint's step, by its name: reading it would race with the training."""
    return max((int(path.stem) for path in root.glob("*/checkpoint/*.json")), default=0)


def wait_for_progress(root: Path, steps: int) -> None:
    """Wait until a training has saved so many steps, or is done."""
    give_up = time.monotonic() + 60
    while saved(root) < steps and not list(root.glob("*/policy.safetensors")) and time.monotonic() < give_up:
        time.sleep(0.001)
