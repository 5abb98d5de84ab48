"""Evaluation: the deterministic policy on frozen initial conditions, one row an episode."""

from srlrace.evaluation.run import evaluate_run

__all__ = ["evaluate_run"]
