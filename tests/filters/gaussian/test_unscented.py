"""The unscented transform against its printed weights, and the filter against a textbook's loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from heliograph.filters.gaussian.unscented import Unscented
from heliograph.numerics.float64 import in_float64
from tests.oracles.unscented import sigma_points, unscented_kalman, weighted_moments

CLOSE = dict(rtol=1e-10, atol=1e-10)  # what is asked of agreement with FilterPy


@in_float64
def applied(transform, function, mean, covariance):
    return transform.apply(function, jnp.asarray(mean), jnp.asarray(covariance))


def bent(x):
    return jnp.stack([x[0] * jnp.cos(x[1]), x[0] * jnp.sin(x[1]), x[0] ** 2])


@pytest.mark.slow
@given(st.floats(0.1, 2.0), st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.integers(0, 1000))
def test_it_is_the_sum_over_the_printed_points(alpha, beta, kappa, seed):
    rng = np.random.default_rng(seed)
    mean, root = rng.normal(size=2), rng.normal(size=(2, 2))
    covariance = root @ root.T + 0.1 * np.eye(2)
    result = applied(Unscented(alpha, beta, kappa), bent, mean, covariance)
    points, *weights = sigma_points(mean, covariance, alpha, beta, kappa)
    with jax.enable_x64(True):
        values = np.array([np.asarray(bent(x)) for x in points])
    center, spread, cross = weighted_moments(points, values, *weights)
    for value, expected in zip(result, (center, spread, cross), strict=True):
        np.testing.assert_allclose(
            value, expected, rtol=0, atol=1e-10 * np.abs(expected).max()
        )  # weights of 100 lose two digits


def test_cubature_is_its_special_case():
    mean, covariance = np.array([1.0, 0.3]), np.array([[0.2, 0.05], [0.05, 0.1]])
    both = [applied(t, bent, mean, covariance) for t in (Unscented(1.0, 0.0, 0.0), hg.filters.Cubature())]
    for value, expected in zip(*both, strict=True):
        np.testing.assert_allclose(value, expected, rtol=1e-13, atol=1e-14)  # other orders of sums


@given(st.floats(0.05, 2.0), st.floats(0.0, 3.0), st.floats(-1.9, 3.0), st.integers(0, 1000))
def test_no_covariance_is_indefinite_where_parameters_are_taken(alpha, beta, kappa, seed):
    item = Unscented(alpha, beta, kappa)
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(3, 2)), 3 * rng.normal(size=(3, 2, 2))

    def curved(x):
        return a @ x + jnp.einsum("kij,i,j->k", b, x, x) + jnp.abs(x[0])

    try:
        item.check(2)
    except ValueError as error:
        assert "kappa: expected at least" in str(error) and alpha**2 * kappa + 2 * beta < 0
        return
    spread = applied(item, curved, rng.normal(size=2), np.eye(2)).covariance
    assert np.linalg.eigvalsh(spread)[0] >= -1e-12 * np.trace(spread)


def test_equal_changes_make_the_bound_tight():
    """f that jumps away from the mean: e_i all equal, so that the covariance is (1 / s + beta - alpha^2) d d'."""
    jump = Unscented(1.0, 0.0, 0.0)
    values = applied(jump, lambda x: jnp.where(jnp.abs(x[:1]) + jnp.abs(x[1:]) > 0, 1.0, 0.0), np.zeros(2), np.eye(2))
    assert values.covariance == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize(
    ("alpha", "beta", "kappa"), [(0.5, 2.0, 0.0), (1e-3, 2.0, 0.0), (1.0, 0.0, 1.0), (1.0, 2.0, -1.0)]
)
def test_the_filter_is_the_textbooks(monkeypatch, alpha, beta, kappa):
    plant = hg.Plant(lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] - 0.2 * jnp.sin(x[0])]), 0.01, [0.5, 0.0], 0.2)
    sensor = hg.Sensor(lambda x: jnp.stack([jnp.sqrt(4 + x[0] ** 2), x[0] * x[1]]), 0.05 * np.eye(2))
    z = np.random.default_rng(1).normal(size=(30, 2)) * 0.3 + [2.0, 0.0]
    item = hg.unscented_filter(plant, sensor, hg.perfect(2), alpha, beta, kappa)
    with jax.enable_x64(True):
        means, covariances = unscented_kalman(plant, sensor, z, alpha, beta, kappa)
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")  # which says so if it cannot
    result = item.run(z)
    tolerance = 1e-10 if alpha > 0.1 else 1e-6  # the oracle's weights of 1e6 lose the other digits
    np.testing.assert_allclose(result.means, means, atol=tolerance, rtol=tolerance)
    np.testing.assert_allclose(result.covariances, covariances, atol=tolerance, rtol=tolerance)


def test_linear_plant_and_sensor_make_it_the_kalman_filter():
    plant, sensor = hg.state_space([[1.0, 1.0], [0.0, 1.0]], [[1.0, 0.0]], 0.1, 1.0, [0.0, 0.0], 1.0)
    z = np.random.default_rng(2).normal(size=10)
    item = hg.unscented_filter(plant, sensor, hg.perfect())
    assert item.claim == "exact"
    np.testing.assert_allclose(item.run(z).means, hg.kalman_filter(plant, sensor).run(z).means, **CLOSE)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (dict(alpha=0.0), "alpha: expected a positive number"),
        (dict(kappa=-2.0), "kappa: expected more than -2 for 2 states"),
        (dict(alpha=1.0, beta=0.0, kappa=-1.0), "kappa: expected at least 0 for 2 states, so that no covariance"),
    ],
)
def test_parameters_without_points_are_refused(arguments, words):
    plant, sensor = hg.state_space(np.eye(2), np.eye(2), 1.0, 1.0, [0.0, 0.0], 1.0)
    with pytest.raises(ValueError, match=words):
        hg.unscented_filter(plant, sensor, hg.perfect(2), **arguments)
