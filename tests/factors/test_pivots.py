"""Derivatives of a Gaussian in factors where covariances are zero or singular, against those of covariances."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.factors import (
    WeightedColumns,
    columns_of,
    columns_with_derivatives,
    condition_on_observation,
    from_covariance,
    join_columns,
    merge_mixture,
    predict_affine,
    rounding_of,
    triangularise,
)
from heliograph.numerics import write_for_derivatives

F = np.array([[0.9, 0.3, 0.0], [-0.2, 0.7, 0.4], [0.1, 0.0, 0.5]])
H, Z = np.array([[1.0, 0.5, -0.3], [0.2, 1.0, 0.4], [0.0, -1.0, 2.0]]), np.array([0.4, -1.2, 0.7])
MEAN = np.array([0.3, -0.2, 1.1])
SINGULAR = {
    "zero": np.zeros((3, 3)),
    "a known state": np.diag([1.0, 0.0, 0.5]),
    "tied states": np.outer([1.0, 1.0, -2.0], [1.0, 1.0, -2.0]),
    "regular": np.array([[1.0, 0.2, 0.1], [0.2, 2.0, -0.3], [0.1, -0.3, 0.5]]),
}
P_SLOPE, Q_SLOPE, R_SLOPE = (
    np.array([[a, b, c], [b, d, e], [c, e, f]])
    for a, b, c, d, e, f in [(1, 0.5, -0.2, 0.7, 0.1, 2), (0.4, -0.1, 0.2, 1, 0.3, 0.6), (0.5, 0.2, 0.1, 1, -0.4, 0.8)]
)
TOLERANCE = 1e-12  # a hundred operations on numbers of order 1, whose derivatives are up to ten


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def derivative(function, slopes, *given, tolerance=TOLERANCE):
    """Return the function at `given` and its derivative along slopes that all move alike, by both modes of JAX.

    The function takes `given`, and then a change along each slope.
    """
    value, forward, backward = differentiated(function)(0.0, slopes, given)
    for a, b in zip(jax.tree.leaves(forward), jax.tree.leaves(backward), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, float(np.max(np.abs(b)))))
    return value, forward


@cache
def differentiated(function):
    """Return value and derivatives as one program, compiled once for all covariances that it is given."""

    @jax.jit
    def differentiate(t, slopes, given):
        def evaluate(t):
            with write_for_derivatives():
                return function(*given, *(t * slope for slope in slopes))

        return *jax.jvp(evaluate, (t,), (1.0,)), jax.jacrev(evaluate)(t)

    return differentiate


def covariance_of_factors(factor, P, change):
    return factor(P + change).covariance


FACTORS = [
    partial(covariance_of_factors, factor)
    for factor in (columns_of, columns_with_derivatives, lambda P: from_covariance(MEAN, P))
]


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("name", SINGULAR)
def test_factors_have_the_derivatives_of_their_covariance(name, factor):
    """Of a covariance that moves in any direction: W' of each column is as large as its weight is small."""
    value, slope = derivative(factor, (P_SLOPE,), SINGULAR[name])
    np.testing.assert_allclose(slope, P_SLOPE, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(value, SINGULAR[name], rtol=0, atol=1e-14)


def noise_of(covariance):
    """Return a noise with the rounding of numbers of order 1, as models have it."""
    return triangularise(join_columns(columns_of(covariance), rounding_of(np.ones(3))))


def predict(P, Q, dP, dQ):
    return predict_affine(from_covariance(MEAN, P + dP), F, MEAN, noise_of(Q + dQ)).covariance


@pytest.mark.parametrize("process", ["zero", "a known state"])
@pytest.mark.parametrize("start", SINGULAR)
def test_a_prediction_has_the_derivative_of_the_covariance(start, process):
    _, slope = derivative(predict, (P_SLOPE, Q_SLOPE), SINGULAR[start], SINGULAR[process])
    np.testing.assert_allclose(slope, F @ P_SLOPE @ F.T + Q_SLOPE, rtol=0, atol=TOLERANCE)


# The density of what is determined has no derivative: what is measured must have a regular covariance.
WITH_DENSITY = [
    (start, noise)
    for start in SINGULAR
    for noise in ("zero", "a known state", "regular")
    if np.linalg.matrix_rank(H @ SINGULAR[start] @ H.T + SINGULAR[noise]) == 3
]


def observe(z, P, R, dP, dR):
    x = from_covariance(MEAN, P + dP)
    after, seen = condition_on_observation(x, H @ x.root, z - H @ x.mean, noise_of(R + dR))
    return after.mean, after.covariance, seen.log_density(np.full(3, True), np.abs(Z))


@jax.jit
def differentiate_by_covariances(P0, R0):
    """Return mean, covariance and density after Z by P - K S K' with K = P H' S^-1, and their derivatives."""

    def by_covariances(t):
        P, R = P0 + t * P_SLOPE, R0 + t * R_SLOPE
        S, e = H @ P @ H.T + R, Z - H @ MEAN
        K = jnp.linalg.solve(S, H @ P).T
        density = -(e @ jnp.linalg.solve(S, e) + jnp.linalg.slogdet(S)[1] + 3 * np.log(2 * np.pi)) / 2
        return MEAN + K @ e, P - K @ S @ K.T, density

    return jax.jvp(by_covariances, (0.0,), (1.0,))


@pytest.mark.slow
@pytest.mark.parametrize("start, noise", WITH_DENSITY)
def test_an_observation_has_the_derivatives_of_mean_covariance_and_density(start, noise):
    """The noise is only the rounding of numbers, or a part of it is."""
    P, R = SINGULAR[start], SINGULAR[noise]
    tolerance = max(TOLERANCE, 4 * np.finfo(float).eps * np.linalg.cond(H @ P @ H.T + R))  # cond S is up to 1e4
    value, slopes = derivative(observe, (P_SLOPE, R_SLOPE), Z, P, R, tolerance=tolerance)
    expected = differentiate_by_covariances(P, R)
    for a, b in zip((*value, *slopes), (*expected[0], *expected[1]), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, float(np.max(np.abs(b)))))


@pytest.mark.parametrize("r", [0.0, 1e-20, 1e-3])
def test_a_precise_component_that_shows_one_state_alone(r):
    """The other states have slopes of 0 in it: their variances get no differences of numbers of 1 / r."""
    P, rows = SINGULAR["regular"], np.array([[1.0, 0.0, 0.0], [0.9, -1.0, 0.1]])

    def observe(dR):
        x = from_covariance(MEAN, P)
        columns = join_columns(columns_of(r * np.eye(2) + dR), rounding_of(np.ones(2)))
        after, seen = condition_on_observation(x, rows @ x.root, Z[:2], columns)
        return after.covariance, seen.log_density(np.full(2, True), np.ones(2))

    def by_covariances(dR):
        S, C = rows @ P @ rows.T + r * np.eye(2) + dR, P @ rows.T
        density = -(Z[:2] @ jnp.linalg.solve(S, Z[:2]) + jnp.linalg.slogdet(S)[1]) / 2
        return P - C @ jnp.linalg.solve(S, C.T), density

    slope = jnp.eye(2)
    expected = jax.jvp(lambda t: by_covariances(t * slope), (0.0,), (1.0,))[1]
    for a, b in zip(derivative(observe, (slope,))[1], expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=10 * TOLERANCE)


def covariance_of_observed(*given_and_changes):
    return observe(*given_and_changes)[1]


def test_an_observation_of_which_a_part_is_missing():
    z, zero, R = np.array([0.3, np.nan, -0.2]) + H @ MEAN, SINGULAR["zero"], np.eye(3) / 2
    slope = derivative(covariance_of_observed, (P_SLOPE, R_SLOPE), z, zero, R)[1]
    np.testing.assert_allclose(slope, P_SLOPE, rtol=0, atol=TOLERANCE)


def merge(P, dP, dQ):
    weights, shift = jnp.array([0.25, 0.75]), np.array([0.5, 0.0, -0.25])
    parts = [from_covariance(MEAN + s, P + d) for s, d in ((0.0, dP), (shift, dQ))]
    return merge_mixture(jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts), weights).covariance


@pytest.mark.parametrize("name", SINGULAR)
def test_a_mixture_has_the_derivative_of_its_covariance(name):
    _, slope = derivative(merge, (P_SLOPE, Q_SLOPE), SINGULAR[name])
    np.testing.assert_allclose(slope, 0.25 * P_SLOPE + 0.75 * Q_SLOPE, rtol=0, atol=TOLERANCE)


def test_many_columns_are_a_loop_of_the_same_derivatives():
    """More than 24 rows, where what is to be differentiated is not the operation that native code knows."""
    n = 30
    slope = np.eye(n) + 0.3 * np.eye(n, k=1) + 0.3 * np.eye(n, k=-1)
    given = np.diag(np.arange(n) % 2.0)

    np.testing.assert_allclose(derivative(FACTORS[0], (slope,), given)[1], slope, rtol=0, atol=TOLERANCE)


def test_what_is_not_differentiated_is_factored_as_before():
    """An infinitesimal pivot is there only where a derivative is asked for; numbers are factored by their rank."""
    columns = columns_of(jnp.zeros((2, 2)))
    assert not np.any(columns.weights)
    with write_for_derivatives():
        assert 0 < float(columns_of(jnp.zeros((2, 2))).weights[0]) < 1e-100
    assert isinstance(columns_with_derivatives(np.eye(2)), WeightedColumns)
    assert columns_with_derivatives(np.diag([1.0, 0.0])).matrix.shape == (2, 1)
