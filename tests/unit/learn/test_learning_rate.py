"""How Adam's step size falls along a training."""

import dataclasses
from itertools import pairwise

import pytest

from srlrace.learn.ppo import LearningRate


def rates(config, shares, **settings):
    algo = dataclasses.replace(config().algo, learning_rate=1e-2, learning_rate_final=1e-4)
    rate = LearningRate(dataclasses.replace(algo, **settings))
    return [rate(1.0 - share) for share in shares]


def test_linear_is_the_default_and_begins_at_once(config):
    assert rates(config, (0.0, 0.5, 1.0)) == pytest.approx([1e-2, 5.05e-3, 1e-4])


@pytest.mark.parametrize(("decay", "half_way"), [("linear", 5.05e-3), ("geometric", 1e-3)])
def test_it_stays_for_a_while_and_then_falls(config, decay, half_way):
    shares = (0.0, 0.2, 0.4, 0.7, 1.0)
    found = rates(config, shares, learning_rate_hold=0.4, learning_rate_decay=decay)
    assert found == pytest.approx([1e-2, 1e-2, 1e-2, half_way, 1e-4])


def test_geometric_falls_by_equal_ratios(config):
    found = rates(config, (0.0, 0.25, 0.5, 0.75, 1.0), learning_rate_decay="geometric")
    ratios = [later / earlier for earlier, later in pairwise(found)]
    assert ratios == pytest.approx([0.01**0.25] * 4)


def test_a_final_rate_that_is_the_first_one_is_constant(config):
    algo = dataclasses.replace(config().algo, learning_rate=3e-4, learning_rate_final=3e-4)
    for decay in ("linear", "geometric"):
        rate = LearningRate(dataclasses.replace(algo, learning_rate_decay=decay))
        assert [rate(left) for left in (1.0, 0.3, 0.0)] == pytest.approx([3e-4] * 3)
