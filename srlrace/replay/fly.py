"""Flying episodes that were not recorded: the evaluation's own flights, kept in memory."""

from __future__ import annotations

from io import BytesIO

import pandas as pd
import torch

from srlrace.evaluation.episodes import episode_rows, rows_csv
from srlrace.evaluation.flights import fly
from srlrace.evaluation.suites import make_suite
from srlrace.learn.policy import load_policy
from srlrace.recording import Flight
from srlrace.runs import RunError, RunFolder, State


def fly_suite(run: RunFolder, suite: str, episodes: int, recorded: int) -> tuple[pd.DataFrame, list[Flight]]:
    """Fly the first ``episodes`` of a suite; return their table and the trajectories of the first ``recorded``.

    Raises `RunError` when the run has no policy, `srlrace.files.FileError` for one that cannot be used.
    """
    if run.state is not State.FINISHED:
        raise RunError(f"{run.id} has no policy yet; finish it with: srlrace resume {run.id}")
    config = run.load_config()
    torch.set_num_threads(config.algo.threads)
    policy = load_policy(config, run.path / "policy.safetensors")
    prepared = make_suite(config, suite)
    race, history = fly(policy, prepared, episodes, recorded)
    rows = episode_rows(prepared, race)
    table = pd.read_csv(BytesIO(rows_csv(rows)))
    return table, list(history.flights(prepared, race, rows)) if history else []
