"""Evaluation: the deterministic policy on frozen initial conditions, one row an episode."""

from srlrace.evaluation.run import evaluate_run
from srlrace.evaluation.snapshots import evaluate_snapshots

__all__ = ["evaluate_run", "evaluate_snapshots"]
