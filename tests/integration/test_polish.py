"""A trained policy that is polished flies faster, on the flights of the evaluation, which no round has seen."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch

from srlrace.evaluation.episodes import episode_rows, summarise
from srlrace.evaluation.flights import fly
from srlrace.evaluation.suites import make_suite
from srlrace.learn.policy import act, load_policy
from srlrace.learn.polish import Polish
from srlrace.runs import list_runs
from srlrace.task.race import Race, RaceMode

REFERENCE = Path(__file__).parents[2] / "runs" / "reference"
EPISODES = 200


def test_a_round_makes_a_published_policy_faster() -> None:
    runs = (run for run in list_runs(REFERENCE) if run.id.startswith("forest-srl-s0-"))
    run = next(run for run in runs if "train_map" in run.evaluations)
    config = run.load_config()
    curriculum = dataclasses.replace(config.curriculum, polish_rounds=2, polish_starts=1000, polish_time=0.005)
    config = dataclasses.replace(config, curriculum=curriculum)
    policy, suite = load_policy(config, run.file("policy.safetensors")), make_suite(config, "train_map")

    def flown() -> dict[str, Any]:
        race, _ = fly(policy, suite, EPISODES, 0)
        return summarise(run.id, suite, episode_rows(suite, race))

    torch.set_num_threads(1)
    before = flown()
    Polish(Race(config, RaceMode.training(0, 1)), policy, lambda seen: act(policy, seen), None).round()
    after = flown()
    assert after["outcomes"]["finished"] >= before["outcomes"]["finished"] - 1
    assert after["time_mean_s"] < before["time_mean_s"] - 0.02
