"""Starts that cannot be survived are told from those that can."""

from srlrace.evaluation.starts import lost_starts
from srlrace.evaluation.suites import make_suite
from srlrace.hydra_bridge import compose


def test_a_start_against_a_tree_is_lost_and_others_are_not() -> None:
    suite = make_suite(compose(["env=forest", "level=mixed"]), "level2")
    touching = 506  # hits a tree within two control periods
    assert lost_starts(suite, [0, 1, 2, 3, touching]) == [touching]
