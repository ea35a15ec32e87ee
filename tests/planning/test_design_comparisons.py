"""Designs compared, with a budget in whichever form `design` takes."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Budget, DesignProblem, error_over_power, worth_of_changes
from tests.planning.example import direct_paths


def network():
    plant = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
    return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.3), hg.hop(1.0, 0.2), {})})


def test_a_budget_may_be_a_number():
    front = error_over_power(DesignProblem(network(), budget=1.0), [1.0, 2.0])
    assert np.diff(front.errors)[0] < 0
    best = hg.design(DesignProblem(network(), budget=Budget(1.0)))
    assert front.errors[0] == pytest.approx(best.error, rel=1e-12)
    assert best.problem == DesignProblem(network(), budget=Budget(1.0))


def test_what_is_no_problem_is_named():
    with pytest.raises(ValueError, match="design of a DesignProblem: expected no further arguments"):
        hg.design(DesignProblem(network(), budget=1.0), budget=2.0)
    with pytest.raises(ValueError, match="problem: expected a DesignProblem"):
        error_over_power(network(), [1.0])
    with pytest.raises(ValueError, match="network of the design: expected a Network"):
        worth_of_changes(hg.design(direct_paths(), budget=1.0))
