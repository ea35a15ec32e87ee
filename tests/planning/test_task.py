"""What is asked of a design, with a budget in whichever form `design` takes; and what is no problem at all."""

import numpy as np
import pytest

import heliograph as hg
from heliograph import planning

PATHS = planning.independent_paths([[0.9]], [[0.1]], [[1.0], [1.0]], [0.3, 0.2], 1.05, [1.0, 2.0])


def test_a_budget_may_be_a_number():
    plant = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
    network = hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.3), hg.hop(1.0, 0.2), {})})
    front = planning.error_over_power(network, planning.Task(budget=1.0), [1.0, 2.0])
    assert np.diff(front.errors)[0] < 0
    assert front.errors[0] == pytest.approx(planning.Task(budget=planning.Budget(1.0)).solve(network).error, rel=1e-12)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: planning.water_filling(3, 1.0), r"paths: expected Paths \(independent_paths, paths_of\), got 3"),
        (lambda: planning.water_filling(PATHS, 1.0, "trace"), "error: expected an Error, got 'trace'"),
        (lambda: planning.choose_sensors(3, 1, powers=1.0), "paths: expected Paths"),
        (lambda: planning.choose_sensors(PATHS, 1, powers=-1.0), "powers: expected finite numbers of at least zero"),
        (lambda: planning.relay_map(3, 1.0, [0.0], [0.0]), "scene: expected a RelayScene, got 3"),
    ],
)
def test_what_is_no_problem_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
