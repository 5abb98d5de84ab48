"""Ten thousand run folders as a large study leaves them: half of them stand in the paper's tables, half in none."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from unittest.mock import patch

from srlrace.config import Config, run_id, to_dict
from srlrace.files import read_json, write_sealed
from srlrace.runs import DIGEST
from srlrace.sweep.plan import Plan, experiments, plan_jobs

REFERENCE = Path(__file__).parents[2] / "runs" / "reference"
WEIGHTS = 50  # rewards of each method that no table has


def synthesize(root: Path, runs: int) -> None:
    """Fill ``root`` with finished, evaluated runs: the flights of the published ones, under other settings."""
    presets = [job.config for job in plan_jobs(experiments(["paper"]), Plan(root, seeds=1))]
    with patch("os.fsync"):  # what is synthetic need not survive a power cut
        for config in islice(_settings(presets), runs):
            published = sorted(REFERENCE.glob(f"{config.env.name}-*"))
            _write(root / run_id(config), config, published[config.seed % len(published)])


def _settings(presets: list[Config]) -> Iterator[Config]:
    for seed in count():
        for preset in presets:
            yield replace(preset, seed=seed)
            weight = preset.reward.progress * (1 + (seed % WEIGHTS + 1) / 100)
            yield replace(preset, seed=seed // WEIGHTS, reward=replace(preset.reward, progress=weight))


def _write(run: Path, config: Config, published: Path) -> None:
    shutil.copytree(published / "eval", run / "eval")
    for name in ("policy.safetensors", "progress.csv"):
        os.link(published / name, run / name)  # neither a list nor a report reads all of them
    text = json.dumps(to_dict(config), indent=1) + "\n"
    (run / "config.json").write_text(text)
    facts = {"run": run.name, DIGEST: hashlib.sha256(text.encode()).hexdigest()}
    write_sealed(run / "run.json", read_json(published / "run.json") | facts)
