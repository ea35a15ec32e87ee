"""The best powers of paths of one hop: fixed point, semidefinite programme and plain descent agree; bounds hold."""

import numpy as np
import pytest
from scipy.optimize import minimize

import heliograph as hg
from heliograph.numerics.check import InputError
from heliograph.planning import (
    Budget,
    Error,
    independent_paths,
    least_power,
    paths_of,
    semidefinite_least_power,
    semidefinite_powers,
    water_filling,
)
from heliograph.planning.fixed_point import fill
from heliograph.planning.one_hop import one_hop
from tests.planning.example import NOISES, direct_paths, error_at, relayed_paths, steady

BEST = {  # total: error of equal powers, of the best ones, these, and the least power for the former error
    2: (0.91212826, 0.87632288, [0.42275, 0.60692, 0, 0.44522, 0, 0.52510], 1.6200),
    10: (0.61488712, 0.60604045, [2.31412, 1.30339, 2.88693, 1.40284, 1.03043, 1.06228], 9.4720),
}


def random_paths(seed, n=3, sensors=5, error=None, unstable=False):
    """A stable plant (or one that grows) with process noise of rank 2, and sensors with all numbers drawn."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=(n, n))
    a *= (1.1 if unstable else draw.uniform(0.5, 0.98)) / np.abs(np.linalg.eigvals(a)).max()
    b = draw.normal(size=(n, 2))
    return independent_paths(
        a,
        b @ b.T,
        draw.normal(size=(sensors, n)),
        draw.uniform(0.1, 1.0, sensors),
        1 + draw.uniform(0, 0.3, sensors),
        draw.uniform(0.1, 3.0, sensors),
        error,
        draw.normal(size=n),
        np.eye(n) if unstable else None,
    )


@pytest.mark.parametrize("total", BEST)
def test_six_sensors_have_the_printed_optimum(total):
    equal, best, powers, least = BEST[total]
    paths = direct_paths()
    assert error_at(paths, np.full(6, total / 6)) == pytest.approx(equal, abs=1e-8)
    found = water_filling(paths, total)
    assert found.error == pytest.approx(best, abs=1e-8)
    np.testing.assert_allclose(found.powers[0], powers, atol=1e-5)
    assert found.powers.sum() == pytest.approx(total, rel=1e-12)
    assert error_at(paths, found.powers[0]) == pytest.approx(found.error, rel=1e-12)
    assert found.gap < 1e-11  # 1e-12 of it is kept for rounding
    swapped = least_power(paths, error_at(paths, np.full(6, total / 6)))
    assert swapped.total == pytest.approx(least, abs=1e-4)
    assert swapped.gap < 1e-10 * total
    assert error_at(paths, swapped.powers[0]) == pytest.approx(equal, abs=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_fixed_point_programme_and_descent_agree(seed):
    """Descent is SciPy's, on the plain recursion with differences: nothing in common with the rest."""
    paths, total = random_paths(seed), 2.0 + seed
    found, programme = water_filling(paths, total), semidefinite_powers(paths, total)
    descent = minimize(
        lambda x: error_at(paths, np.maximum(x, 0) * total),
        np.full(5, 0.2),
        bounds=[(1e-9, 1)] * 5,
        constraints={"type": "eq", "fun": lambda x: x.sum() - 1},
        options={"ftol": 1e-13},
    )
    assert found.gap <= 1e-10 * found.error
    assert found.error == pytest.approx(programme.error, rel=1e-7)  # the solver's accuracy
    assert found.error == pytest.approx(descent.fun, rel=1e-6)  # and that of differences
    for bound in (found.bound, programme.bound):
        assert bound <= min(found.error, programme.error, descent.fun)


@pytest.mark.parametrize(
    ("error", "budget"),
    [
        (Error(period=3), Budget(3.0, peak=2.0)),
        (Error(horizon=4), Budget(2.0, each=0.6, peak=1.5)),
        (Error(horizon=4, at_end=True), Budget(2.0, peak=1.5)),
        (Error({"x0": 1.0}), Budget(3.0, each=1.0)),
    ],
    ids=["period", "horizon", "end", "one state"],
)
def test_programme_and_fixed_point_agree_over_time(error, budget):
    paths = random_paths(5, error=error, unstable=error.horizon is not None)
    states = ("x0", "x1", "x2")
    found, programme = water_filling(paths, budget, error, states), semidefinite_powers(paths, budget, error, states)
    assert found.gap <= 1e-9 * found.error
    assert found.error == pytest.approx(programme.error, rel=1e-7)
    mean = found.powers.mean(axis=0)
    assert mean.sum() == pytest.approx(budget.total, rel=1e-9)
    assert np.all(mean <= (budget.each or np.inf) * (1 + 1e-9)) and np.all(found.powers <= (budget.peak or np.inf))


def test_sending_at_every_step_alike_is_best_over_a_period():
    error = Error(period=3)
    assert water_filling(direct_paths(error), 10, error).error == pytest.approx(BEST[10][1], abs=1e-8)


def test_the_worst_direction_is_bounded_by_its_dual():
    paths, error = random_paths(7), Error(worst=True)
    found = semidefinite_powers(paths, 3.0, error)
    assert found.bound <= found.error <= found.bound * (1 + 1e-6)
    trace = water_filling(paths, 3.0)
    assert found.error < np.linalg.eigvalsh(steady(paths, trace.powers[0]))[-1] - 1e-3  # or nothing would differ
    assert found.error == pytest.approx(np.linalg.eigvalsh(steady(paths, found.powers[0]))[-1], rel=1e-9)
    least = semidefinite_least_power(paths, found.error, None, error)
    assert least.total == pytest.approx(3.0, rel=1e-6)
    assert least.bound <= 3.0 * (1 + 1e-9)


def test_the_gradient_is_that_of_differences():
    error = Error(horizon=4)
    problem = one_hop(random_paths(2, error=error, unstable=True), 3.0, error)
    p = np.random.default_rng(0).uniform(0.2, 1.0, (4, 5))
    step = 1e-6 * np.random.default_rng(1).normal(size=(3, 4, 5))
    for one in step:
        difference = problem.at(p + one).value - problem.at(p - one).value
        # error of differences: third derivatives times 1e-18, and rounding 1e-16 of a value of 10
        assert 2 * np.sum(problem.at(p).gradient * one) == pytest.approx(difference, rel=1e-7, abs=1e-14)


def test_powers_and_noises_in_other_units_are_the_same_design():
    paths = direct_paths()
    louder = paths._replace(alpha=1e6 * paths.alpha)
    found, again = water_filling(paths, 2.0), water_filling(louder, 2e6)
    np.testing.assert_allclose(again.powers, 1e6 * found.powers, rtol=1e-9, atol=1e-3)
    assert semidefinite_powers(louder, 2e6).error == pytest.approx(found.error, rel=1e-7)


def test_least_power_by_both_ways_falls_with_the_error_that_is_wanted():
    paths = direct_paths()
    totals = [least_power(paths, wanted).total for wanted in (1.0, 0.8, 0.6)]
    assert totals == sorted(totals)
    assert semidefinite_least_power(paths, 0.6).total == pytest.approx(totals[2], rel=1e-6)
    capped = least_power(paths, 0.8, Budget(each=0.6))
    assert capped.total > totals[1] + 1e-3 and capped.gap <= 1e-9 and np.all(capped.powers <= 0.6)


def test_a_sensor_without_noise_and_a_hop_that_is_free():
    """a = 0: the information is linear in the power. alpha = 0: it costs nothing."""
    paths = independent_paths([[0.9]], [[0.3]], np.ones((3, 1)), [0.0, 0.1, 0.2], [1.0, 1.0, 1.1], [1.0, 2.0, 0.0])
    found, programme = water_filling(paths, 1.0), semidefinite_powers(paths, 1.0)
    assert found.error == pytest.approx(programme.error, rel=1e-7) and found.powers[0, 2] == 0
    assert found.bound <= programme.error


def test_what_cannot_be_is_refused():
    paths = direct_paths()
    limit = fill(one_hop(paths, 1e13, None))[2].error
    with pytest.raises(
        InputError, match=rf"wanted error: expected one above {limit:.5g}.*which unlimited power leaves"
    ):
        least_power(paths, 0.3)
    with pytest.raises(InputError, match="paths of a convex design: expected one hop each, got 12 hops of 6 paths"):
        water_filling(relayed_paths(), 1.0)
    with pytest.raises(InputError, match="semidefinite_powers takes"):
        water_filling(paths, 1.0, Error(worst=True))
    with pytest.raises(InputError, match="expected one over the 1 steps"):
        water_filling(paths, 1.0, Error(period=2))
    with pytest.raises(InputError, match="budget: expected one that limits every transmitter"):
        water_filling(paths, Budget(each={"sender0": 1.0}))
    with pytest.raises(InputError, match="budget of least power"):
        least_power(paths, 0.5, Budget(3.0))
    with pytest.raises(InputError, match=r"steady powers: expected a stable plant.*1\.1"):
        independent_paths([[1.1]], [[1.0]], [[1.0]], [1.0], 1.0, [1.0])
    with pytest.raises(InputError, match="paths over a horizon: expected initial_covariance"):
        independent_paths([[1.1]], [[1.0]], [[1.0]], [1.0], 1.0, [1.0], Error(horizon=2))
    with pytest.raises(InputError, match=r"kappa of paths: expected numbers of at least 1, got 0\.9"):
        independent_paths([[0.5]], [[1.0]], [[1.0]], [1.0], [0.9], [1.0])
    with pytest.raises(InputError, match="noises of paths: expected shape"):
        independent_paths([[0.5]], [[1.0]], [[1.0]], NOISES, 1.0, [1.0])


@pytest.mark.parametrize("seed", range(4))
def test_states_in_very_different_units_are_the_same_design(seed):
    """Units over eight decades, process noise of rank one: the optimum, its bound and the programme do not mind."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=(3, 3))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    b, c, units = draw.normal(size=(3, 1)), draw.normal(size=(4, 3)), 10.0 ** draw.uniform(-4, 4, 3)
    rest = ([0.5, 0.4, 0.3, 0.6], 1.05, draw.uniform(0.1, 3.0, 4))
    plain = independent_paths(a, b @ b.T, c, *rest)
    other = independent_paths(a * units[:, None] / units, (b @ b.T) * np.outer(units, units), c / units, *rest)
    for worst in (False, True):
        error = Error(np.diag(units**-2.0), worst=worst)
        found, again = semidefinite_powers(plain, 2.0, Error(worst=worst)), semidefinite_powers(other, 2.0, error)
        assert again.error == pytest.approx(found.error, rel=1e-6)  # the solver's accuracy
        assert again.bound <= again.error <= again.bound * (1 + 1e-5)
    found = water_filling(plain, 2.0)
    np.testing.assert_allclose(water_filling(other, 2.0, Error(np.diag(units**-2.0))).powers, found.powers, atol=1e-7)


def test_the_paths_of_a_network_have_the_powers_of_its_design():
    """Fixed point and descent are different programs over one description."""
    plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], np.diag([0.1, 0.2]), [0.0, 1.0], np.eye(2))
    far = hg.hop(hg.Rician(1.0, 0.3), 0.7, power=3.0)
    near = hg.dropout(hg.hop(hg.Nakagami(2.0, 1.3), 0.4, power=2.0), 0.8)
    nodes = {
        "far": hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.5), far, {}),
        "near": hg.Node(hg.LinearSensor([[1.0, -1.0]], 0.3), near, {}),
    }
    network, error = hg.Network(plant, nodes), Error(horizon=3)
    paths, _ = paths_of(network, error)
    found, design = water_filling(paths, 2.0, error), hg.design(network, error=error, budget=2.0)
    assert found.error == pytest.approx(design.error, rel=1e-10) and found.bound <= design.error
    np.testing.assert_allclose(found.powers, np.transpose(list(design.powers.values())), rtol=1e-5)
