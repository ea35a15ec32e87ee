"""Splits of a path's power and coherent sums: closed forms against descent, programmes and the published relaxation."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from heliograph.numerics.check import InputError
from heliograph.planning import split_power
from heliograph_studies.network_design.theory import (
    coherent_least_power,
    coherent_powers,
    coherent_programme,
    coherent_sum,
    path_noise,
    power_for_noise,
)


@pytest.mark.parametrize("alpha", [[1.0, 2.0], [0.3, 2.0, 0.1, 7.0]], ids=["two hops", "four hops"])
def test_the_split_is_that_of_a_descent(alpha):
    total, a = 3.0, np.array(alpha)
    descent = minimize(
        lambda p: np.log1p(a / p).sum(),
        np.full(len(a), total / len(a)),
        bounds=[(1e-6, total)] * len(a),
        constraints={"type": "eq", "fun": lambda p: p.sum() - total},
        options={"ftol": 1e-14},
    )
    p = split_power(a, total)
    np.testing.assert_allclose(p, descent.x, rtol=1e-5)  # flat at the minimum
    assert np.log(path_noise(a, total)) <= descent.fun + 1e-14
    assert p.sum() == pytest.approx(total, rel=1e-14)
    np.testing.assert_allclose(p**2 / a + p, (p**2 / a + p)[0], rtol=1e-12)  # the condition of Karush, Kuhn and Tucker
    np.testing.assert_allclose(power_for_noise(a, path_noise(a, total)), p, rtol=1e-11)


def test_two_hops_have_a_closed_form_and_one_gets_all():
    u, v = 0.3, 0.7
    assert path_noise([0.9, 2.1], 3.0) == pytest.approx((np.sqrt((1 + u) * (1 + v)) + np.sqrt(u * v)) ** 2, rel=1e-14)
    assert split_power([0.0, 2.0, 0.0], 3.0).tolist() == pytest.approx([0.0, 3.0, 0.0], rel=1e-14)
    assert path_noise([0.0, 0.0], 0.0) == 1.0 and path_noise([1.0], 0.0) == np.inf
    np.testing.assert_allclose(split_power([1e-9, 1e9, 1.0], 1e-3).sum(), 1e-3, rtol=1e-13)


def summed(seed, count=5):
    draw = np.random.default_rng(seed)
    return coherent_sum(
        0.9,
        0.3,
        draw.normal(size=count),
        draw.uniform(0.1, 1, count),
        draw.uniform(0.5, 2, count),
        draw.uniform(0, 0.5, count),
        0.7,
    )


LIMITS = [
    {"total": 3.0},
    {"per_sensor": np.array([0.2, 0.7, 0.1, 0.4, 0.9])},
    {"total": 1.0, "per_sensor": np.array([0.2, 0.7, 0.1, 0.4, 0.9])},
    {"total": 0.2, "per_sensor": 0.1},
]


@pytest.mark.parametrize("limits", LIMITS, ids=["total", "each", "both", "small"])
def test_the_closed_form_of_a_sum_is_the_cone_programme(limits):
    received = summed(3)
    result, programme = coherent_powers(received, **limits), coherent_programme(received, **limits)
    assert result.gap < 1e-14
    assert result.error == pytest.approx(programme.error, rel=1e-7)  # the solver's accuracy
    assert result.bound <= programme.error and programme.gap < 1e-7
    assert result.powers.sum() <= limits.get("total", np.inf) * (1 + 1e-14)
    assert np.all(result.powers <= limits.get("per_sensor", np.inf) * (1 + 1e-14))


def test_the_error_of_a_sum_is_that_of_the_riccati_equation():
    received = summed(1)
    a = np.random.default_rng(2).normal(size=5)
    noise = a @ (received.spread * a) + received.noise
    predicted = solve_discrete_are([[0.9]], [[received.signal @ a]], [[0.3]], [[noise]])[0, 0]
    expected = 1 / (1 / predicted + (received.signal @ a) ** 2 / noise)
    assert received.error(received.information(a)) == pytest.approx(expected, rel=1e-12)


def test_the_total_has_its_closed_form_and_its_swap():
    received = summed(4)
    result = coherent_powers(received, 3.0)
    b, d, s = received.signal, received.spread, received.second
    assert result.information == pytest.approx((b**2 / (d + received.noise * s / 3.0)).sum(), rel=1e-13)
    assert coherent_least_power(received, result.error).powers.sum() == pytest.approx(3.0, rel=1e-11)
    limit = received.error((b**2 / d).sum())
    with pytest.raises(InputError, match=f"above {limit:.6g}, which unlimited power leaves"):
        coherent_least_power(received, 0.99 * limit)


def test_the_published_relaxation_is_tight():
    """max tr(b b' X) with tr(D X) + n0 t = 1, X_ii s_i <= t P_i, X >= 0: its X has rank one, and it is no better."""
    cp = pytest.importorskip("cvxpy")
    received, limit = summed(5, count=4), np.array([0.3, 0.5, 0.2, 0.6])
    x, t = cp.Variable((4, 4), PSD=True), cp.Variable(nonneg=True)
    within = [
        cp.trace(np.diag(received.spread) @ x) + received.noise * t == 1,
        cp.multiply(received.second, cp.diag(x)) <= t * limit,
    ]
    task = cp.Problem(cp.Maximize(received.signal @ x @ received.signal), within)
    task.solve(solver=cp.CLARABEL)
    assert task.value == pytest.approx(coherent_powers(received, per_sensor=limit).information, rel=1e-6)
    values = np.linalg.eigvalsh(x.value)
    assert values[-2] < 1e-6 * values[-1]


def test_more_sensors_at_one_total_lower_the_error_of_a_sum_without_end():
    """It falls as (r + n0 s / P) / M."""
    count = 100_000
    ones = np.ones(count)
    received = coherent_sum(0.9, 0.3, ones, ones, ones, 0 * ones, 1.0)
    assert count * coherent_powers(received, 1.0).error == pytest.approx(
        1 + received.second[0], rel=1e-3
    )  # 1 / (Q j) is left


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="limits of a coherent sum: expected a total or the power per sensor"):
        coherent_powers(summed(0))
    with pytest.raises(InputError, match="total power: expected a number of at least 0"):
        coherent_powers(summed(0), -1.0)
    with pytest.raises(InputError, match="target noise: expected a factor above 1"):
        power_for_noise([1.0], 0.9)
    with pytest.raises(InputError, match="alpha of hops: expected numbers of at least 0"):
        split_power([-1.0], 1.0)
    with pytest.raises(InputError, match="steady power: expected a stable plant"):
        coherent_sum(1.1, 0.3, [1.0], [1.0], [1.0], [0.0], 1.0)
    with pytest.raises(InputError, match="noise of a coherent sum: expected a positive number"):
        coherent_sum(0.9, 0.3, [1.0], [1.0], [1.0], [0.0], 0.0)
