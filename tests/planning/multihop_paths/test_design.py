"""Best powers of paths from arrays: water filling, descent and a plain descent agree; bounds hold."""

import numpy as np
import pytest
from scipy.optimize import minimize

import heliograph as hg
from heliograph.planning import Budget, Error, independent_paths, paths_of
from heliograph.planning.multihop_paths import make_power_task
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths
from heliograph.planning.multihop_paths.water_filling import water_filling
from heliograph.planning.power_budget import make_power_limits
from tests.planning.example import (
    NOISES,
    direct_paths,
    error_at,
    paths_in_two_units,
    powers_of,
    random_paths,
    relayed_paths,
    steady,
)

BEST = {  # total: error of equal powers, of the best ones, these, and the least power for the former error
    2: (0.91212826, 0.87632288, [0.42275, 0.60692, 0, 0.44522, 0, 0.52510], 1.6200),
    10: (0.61488712, 0.60604045, [2.31412, 1.30339, 2.88693, 1.40284, 1.03043, 1.06228], 9.4720),
}


def task_of(paths, budget, error=None):
    """Problem of all powers of some paths, with an even start."""
    error, budget = error or Error(), budget if isinstance(budget, Budget) else Budget(budget)
    free, silent = np.ones(len(paths.names), dtype=bool), np.zeros(paths.kappa.shape)
    criterion = error.criterion(tuple(f"x{i}" for i in range(paths.rows.shape[-1])))
    return make_power_task(paths, criterion, make_power_limits(budget, paths.names, free, silent), free, silent, 1, 0)


@pytest.mark.parametrize("total", BEST)
def test_six_sensors_have_the_printed_optimum(total):
    equal, best, powers, least = BEST[total]
    paths = direct_paths()
    assert error_at(paths, np.full(6, total / 6)) == pytest.approx(equal, abs=1e-8)
    result = hg.design(paths, budget=total)
    assert result.error == pytest.approx(best, abs=1e-8)
    np.testing.assert_allclose(powers_of(result)[0], powers, atol=1e-5)
    assert result.total == pytest.approx(total, rel=1e-12)
    assert error_at(paths, powers_of(result)[0]) == pytest.approx(result.error, rel=1e-12)
    assert result.certificate.convex and result.certificate.gap < 1e-14  # rounding
    swapped = hg.design(paths, target_error=error_at(paths, np.full(6, total / 6)))
    assert swapped.total == pytest.approx(least, abs=1e-4)
    assert swapped.certificate.gap < 1e-12 * total
    assert error_at(paths, powers_of(swapped)[0]) == pytest.approx(equal, abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_water_filling_is_the_optimum_before_any_descent(seed):
    """Its gap closes, and the descent that begins there changes powers by no more than a flat optimum hides."""
    paths, total = random_paths(seed), 2.0 + seed
    task = task_of(paths, total)
    filled = water_filling(
        task.problem.limits, task.problem.sensitivity, SplitPaths(*task.whole_paths()), task.starts[0]
    )
    error = task.problem.compute_exact_error(filled)
    assert error - task.problem.lower_bound(filled) <= 1e-13 * error
    np.testing.assert_allclose(filled, powers_of(hg.design(paths, budget=total)), atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_design_and_plain_descent_agree(seed):
    """Plain descent is SciPy's, on the plain recursion with differences: nothing in common with the rest."""
    paths, total = random_paths(seed), 2.0 + seed
    result = hg.design(paths, budget=total)
    descent = minimize(
        lambda x: error_at(paths, np.maximum(x, 0) * total),
        np.full(5, 0.2),
        bounds=[(1e-9, 1)] * 5,
        constraints={"type": "eq", "fun": lambda x: x.sum() - 1},
        options={"ftol": 1e-13},
    )
    assert result.certificate.gap <= 1e-10 * result.error
    assert result.error == pytest.approx(descent.fun, rel=1e-6)  # that of differences
    assert result.bound <= min(result.error, descent.fun)


@pytest.mark.parametrize(
    ("error", "budget"),
    [
        (Error(period=3), Budget(3.0, peak=2.0)),
        (Error(horizon=4), Budget(2.0, per_transmitter=0.6, peak=1.5)),
        (Error(horizon=4, at_end=True), Budget(2.0, peak=1.5)),
        (Error({"x0": 1.0}), Budget(3.0, per_transmitter=1.0)),
    ],
    ids=["period", "horizon", "end", "one state"],
)
def test_limits_hold_over_time(error, budget):
    paths = random_paths(5, error=error, unstable=error.horizon is not None)
    result = hg.design(paths, error=error, budget=budget)
    assert result.certificate.gap <= 1e-12 * result.error
    powers = powers_of(result)
    mean = powers.mean(axis=0)
    assert mean.sum() == pytest.approx(budget.total, rel=1e-9)
    limits = budget.per_transmitter or np.inf, budget.peak or np.inf
    assert np.all(mean <= limits[0] * (1 + 1e-9)) and np.all(powers <= limits[1] * (1 + 1e-15))


def test_sending_at_every_step_alike_is_best_over_a_period():
    error = Error(period=3)
    assert hg.design(direct_paths(error), error=error, budget=10).error == pytest.approx(BEST[10][1], abs=1e-8)


def test_the_worst_direction_is_bounded_by_the_weights_of_its_directions():
    paths, error = random_paths(7), Error(worst=True)
    result = hg.design(paths, error=error, budget=3.0)
    assert result.bound <= result.error <= result.bound * (1 + 4e-5)  # n^(1/32768): what smoothing leaves
    trace = hg.design(paths, budget=3.0)
    assert result.error < np.linalg.eigvalsh(steady(paths, powers_of(trace)[0]))[-1] - 1e-3  # or nothing would differ
    assert result.error == pytest.approx(np.linalg.eigvalsh(steady(paths, powers_of(result)[0]))[-1], rel=1e-9)
    least = hg.design(paths, error=error, target_error=result.error)
    assert least.total == pytest.approx(3.0, rel=1e-2) and least.bound <= 3.0 * (1 + 1e-9)


def test_the_gradient_is_that_of_differences():
    error = Error(horizon=4)
    problem = task_of(random_paths(2, error=error, unstable=True), 3.0, error).problem
    p = np.random.default_rng(0).uniform(0.2, 1.0, (4, 5))
    step = 1e-6 * np.random.default_rng(1).normal(size=(3, 4, 5))
    for direction in step:
        difference = problem.sensitivity(p + direction)[0] - problem.sensitivity(p - direction)[0]
        # error of differences: third derivatives times 1e-18, and rounding 1e-16 of a value of 10
        assert 2 * np.sum(problem.sensitivity(p)[2] * direction) == pytest.approx(difference, rel=1e-7, abs=1e-14)


def test_powers_and_noises_in_other_units_are_the_same_design():
    paths = direct_paths()
    louder = paths._replace(alpha=1e6 * paths.alpha)
    result, again = hg.design(paths, budget=2.0), hg.design(louder, budget=2e6)
    np.testing.assert_allclose(powers_of(again), 1e6 * powers_of(result), rtol=1e-9, atol=1e-3)


def test_least_power_falls_with_the_target():
    paths = direct_paths()
    totals = [hg.design(paths, target_error=target).total for target in (1.0, 0.8, 0.6)]
    assert totals == sorted(totals)
    capped = hg.design(paths, target_error=0.8, budget=Budget(per_transmitter=0.6))
    assert capped.total > totals[1] + 1e-3 and capped.certificate.gap <= 1e-9 and np.all(powers_of(capped) <= 0.6)


def test_a_sensor_without_noise_and_a_hop_that_is_free():
    """a = 0: the information is linear in the power. alpha = 0: it costs nothing."""
    paths = independent_paths([[0.9]], [[0.3]], np.ones((3, 1)), [0.0, 0.1, 0.2], [1.0, 1.0, 1.1], [1.0, 2.0, 0.0])
    result = hg.design(paths, budget=1.0)
    assert powers_of(result)[0, 2] == 0 and result.certificate.gap < 1e-14


def test_several_hops_are_designed_from_arrays_too():
    result = hg.design(relayed_paths(), budget=6.0)
    assert result.error == pytest.approx(1.36438855, abs=1e-8) and not result.certificate.convex
    assert np.isnan(result.present)
    with pytest.raises(hg.InputError, match="network of a design: expected a design of a Network"):
        _ = result.network


def test_what_cannot_be_is_refused():
    paths = direct_paths()
    limit = task_of(paths, 1e13).problem.compute_exact_error(np.full((1, 6), 1e13))
    with pytest.raises(hg.InputError, match=rf"target error: expected more than {limit:.5g}.*: unlimited power leaves"):
        hg.design(paths, target_error=0.3)
    with pytest.raises(hg.InputError, match="error: expected that over 1 steps"):
        hg.design(paths, error=Error(period=2), budget=1.0)
    with pytest.raises(hg.InputError, match="free powers of paths: expected all of them"):
        hg.design(paths, free=["sender0"], budget=1.0)
    with pytest.raises(hg.InputError, match="budget: expected one that limits every transmitter"):
        hg.design(paths, budget=Budget(per_transmitter={"sender0": 1.0}))
    with pytest.raises(hg.InputError, match=r"network: expected a Network, a RelayNetwork, Paths or .* got int"):
        hg.design(3, budget=1.0)
    with pytest.raises(hg.InputError, match="error: expected an Error, got 'trace'"):
        hg.design(paths, error="trace", budget=1.0)
    with pytest.raises(hg.InputError, match=r"steady power: expected a stable plant.*1\.1"):
        independent_paths([[1.1]], [[1.0]], [[1.0]], [1.0], 1.0, [1.0])
    with pytest.raises(hg.InputError, match="paths over a horizon: expected initial_covariance"):
        independent_paths([[1.1]], [[1.0]], [[1.0]], [1.0], 1.0, [1.0], Error(horizon=2))
    with pytest.raises(hg.InputError, match=r"kappa of paths: expected numbers of at least 1, got 0\.9"):
        independent_paths([[0.5]], [[1.0]], [[1.0]], [1.0], [0.9], [1.0])
    with pytest.raises(hg.InputError, match="noises of paths: expected shape"):
        independent_paths([[0.5]], [[1.0]], [[1.0]], NOISES, 1.0, [1.0])


@pytest.mark.parametrize("seed", range(4))
def test_states_in_very_different_units_are_the_same_design(seed):
    plain, scaled, units = paths_in_two_units(seed)
    result, again = hg.design(plain, budget=2.0), hg.design(scaled, error=Error(np.diag(units**-2.0)), budget=2.0)
    np.testing.assert_allclose(powers_of(again), powers_of(result), atol=1e-7)


def test_the_paths_of_a_network_have_the_powers_of_its_design():
    plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], np.diag([0.1, 0.2]), [0.0, 1.0], np.eye(2))
    far = hg.hop(hg.random_affine.Rician(1.0, 0.3), 0.7, power=3.0)
    near = hg.dropout(hg.hop(hg.random_affine.Nakagami(2.0, 1.3), 0.4, power=2.0), 0.8)
    nodes = {
        "far": hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.5), far, {}),
        "near": hg.Node(hg.LinearSensor([[1.0, -1.0]], 0.3), near, {}),
    }
    network, error = hg.Network(plant, nodes), Error(horizon=3)
    paths, _ = paths_of(network, error)
    result, design = hg.design(paths, error=error, budget=2.0), hg.design(network, error=error, budget=2.0)
    assert result.error == pytest.approx(design.error, rel=1e-10) and result.bound <= design.error
    np.testing.assert_allclose(powers_of(result), powers_of(design), rtol=1e-5)


@pytest.mark.parametrize("seed", range(1, 4))
def test_two_worst_directions_at_once_leave_what_smoothing_does(seed):
    """At the optimum of seed 2 two eigenvalues are equal: the gap is that of their smoothing, and of the weights."""
    result = hg.design(random_paths(seed), error=Error(worst=True), budget=3.0)
    assert result.certificate.gap < 4e-5 * result.error
