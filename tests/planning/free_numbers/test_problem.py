"""Designs of one function share their programs, as long as the function returns the same network."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning import Error
from heliograph.planning.free_numbers.problem import FreeNumberProblem, make_free_numbers, read_free_numbers

PLANT = hg.LinearPlant([[0.9]], 0.3, [0.0], 1.0)
OUTSIDE = {"noise": 0.3}


def one_hop(amplification):
    hop = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), OUTSIDE["noise"], amplification=amplification)
    return hg.Network(PLANT, {"node": hg.Node(hg.LinearSensor([[1.0]], 0.2), hop, {})})


def marks():
    return one_hop(hg.free(1.2, name="amplification"))


def problem(start=1.2, build=one_hop, **error):
    return FreeNumberProblem(build, make_free_numbers({"amplification": (start, 0.1, 5.0)}), Error(**error))


def test_budgets_and_weights_are_no_reason_to_compile_again():
    assert problem()._slopes is problem(weight=[[2.0]])._slopes


def test_marks_are_the_same_each_time():
    first, again = (FreeNumberProblem(*read_free_numbers(marks, None), Error()) for _ in range(2))
    assert first._slopes is again._slopes


def test_other_steps_other_functions_and_a_start_of_their_own_compile():
    shared = problem()._slopes
    others = [problem(horizon=3), problem(start=1.0), problem(build=lambda amplification: one_hop(amplification))]
    assert all(item._slopes is not shared for item in others)


def test_a_number_outside_of_the_function_that_is_another_now_is_seen(monkeypatch):
    x = np.array([1.2])
    before = problem().solve_at(x)
    monkeypatch.setitem(OUTSIDE, "noise", 0.6)
    after, fresh = problem().solve_at(x), problem(build=lambda amplification: one_hop(amplification)).solve_at(x)
    assert after.error == pytest.approx(fresh.error, rel=1e-13)
    np.testing.assert_allclose(after.slopes.error, fresh.slopes.error, rtol=1e-13)
    assert after.error > 1.01 * before.error
