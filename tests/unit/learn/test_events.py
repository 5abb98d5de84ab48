"""TensorBoard's events, read back by TensorBoard."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from srlrace.learn.train import train
from srlrace.task.reward import TERMS

OUTCOMES = ("success", "crash", "obstacle", "out_of_bounds", "timeout")


def test_every_term_and_outcome_is_there(tiny: Any, tmp_path: Path) -> None:
    folder = train(tiny, tmp_path)
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    names = {f"reward/{term}" for term in TERMS} | {f"race/{outcome}_ratio" for outcome in OUTCOMES}
    assert names <= set(accumulator.Tags()["scalars"])
    rows = pd.read_csv(folder / "progress.csv")
    told = accumulator.Scalars("reward/progress")
    assert [event.step for event in told] == rows["steps"].tolist()
    assert [event.value for event in told] == pytest.approx(rows["reward/progress"].tolist(), rel=1e-4)
