"""Covariances and gradients against the plain recursion and against differences."""

import numpy as np
import pytest

from heliograph.planning import Error
from heliograph.planning.multihop_paths.model import (
    PlantSteps,
    RiccatiMap,
    compute_adjoint,
    compute_covariances,
    solve_fixed_point,
)
from heliograph.planning.multihop_paths.network_to_paths import paths_of
from tests.planning.published import A, Q, path_problem, two_hops


def recursion(plants, information, start, steps):
    """P^-1 = (A P A' + Q)^-1 + J, as it is written."""
    p, result, period = start, [], len(information)
    for k in range(steps):
        a, q = plants.transition[k % period], plants.process[k % period]
        p = np.linalg.inv(np.linalg.inv(a @ p @ a.T + q) + information[k % period])
        result.append(p)
    return np.array(result)


def random_steps(steps, seed):
    draws = np.random.default_rng(seed)
    turn = draws.normal(size=(steps, 3, 3)) * 0.4
    root, information = draws.normal(size=(2, steps, 3, 3))
    return np.array(turn), root @ np.swapaxes(root, 1, 2), information @ np.swapaxes(information, 1, 2)


@pytest.mark.parametrize("period", [1, 2, 5])
def test_the_fixed_point_is_where_the_recursion_converges(period):
    a, q, j = random_steps(period, period)
    plants = PlantSteps(a, q, None)
    limit = recursion(plants, j, np.eye(3), 100 * period)[-period:]
    np.testing.assert_allclose(compute_covariances(plants, j), limit, rtol=1e-11)  # inverses of the plain form round


def test_a_horizon_is_the_recursion_from_its_start():
    a, q, j = random_steps(6, 7)
    plants = PlantSteps(a, q, np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(compute_covariances(plants, j), recursion(plants, j, plants.start, 6), rtol=1e-12)


@pytest.mark.parametrize("start", [None, np.eye(3)], ids=["period", "horizon"])
def test_the_adjoint_is_the_gradient(start):
    a, q, j = random_steps(4, 3)
    plants, weights = PlantSteps(a, q, start), random_steps(4, 5)[2]
    p = compute_covariances(plants, j)
    gradient = -p @ compute_adjoint(plants, j, p, weights) @ p
    way = random_steps(4, 9)[1]  # a direction of informations
    cost = lambda s: np.sum(weights * compute_covariances(plants, j + s * way))  # noqa: E731
    h = 1e-4
    slope = (8 * (cost(h) - cost(-h)) - (cost(2 * h) - cost(-2 * h))) / (12 * h)
    assert slope == pytest.approx(np.sum(gradient * way), rel=1e-8)  # differences of fourth order leave h^4


def test_an_error_that_nobody_receives_is_refused():
    with pytest.raises(ValueError, match="steady error: expected one that converges"):
        solve_fixed_point(RiccatiMap(np.diag([1.1, 0.5]), np.diag([0.0, 1.0]), np.eye(2)))


@pytest.mark.parametrize("error", [Error(), Error(worst=True), Error(horizon=3, at_end=True), Error(period=2)], ids=str)
def test_gradients_by_powers_are_those_of_differences(error):
    paths, powers = paths_of(two_hops(), error)
    count = len(paths.names)
    free = np.arange(count) % 3 != 0
    problem = path_problem(paths, error, np.diag([1.0, 0.5, 2.0]), free, powers)
    problem = problem._replace(criterion=problem.criterion._replace(sharpness=8 if error.worst else None))
    x = np.random.default_rng(2).uniform(0.3, 2.0, (error.steps, int(free.sum())))
    gradient = problem.sensitivity(x)[2]
    h = 1e-3
    for k, f in np.ndindex(x.shape):
        move = np.zeros_like(x)
        move[k, f] = h * x[k, f]
        ends = [problem.sensitivity(x + s * move)[0] for s in (-2, -1, 1, 2)]
        slope = (8 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12 * h * x[k, f])
        assert slope == pytest.approx(gradient[k, f], rel=1e-8, abs=1e-11)  # fourth order, and rounding of 1e-16 / h


def test_a_power_of_zero_is_nothing_to_divide_by():
    paths, powers = paths_of(two_hops(), Error())
    problem = path_problem(paths, Error(), np.eye(3), np.ones(12, dtype=bool), powers)
    value, _, gradient = problem.sensitivity(np.zeros((1, 12)))
    pi = np.linalg.solve(np.eye(9) - np.kron(A, A), Q.ravel()).reshape(3, 3)
    assert value == pytest.approx(np.trace(pi), rel=1e-12)
    np.testing.assert_array_equal(gradient, 0.0)  # two hops: the first power of one of them buys nothing
