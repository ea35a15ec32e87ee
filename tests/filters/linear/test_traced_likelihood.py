"""Derivatives of a linear filter's likelihood, by covariances, against those of its factors and differences."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.oracles.likelihood_slopes import MOTION, READING, ROWS, SHAPES, differentiate_exactly

STEPS = 20
A, B = np.array([[0.9, 0.2, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 0.7]]), np.array([[1.0], [0.5], [0.0]])
C, SKEW = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3]]), np.array([[1.0, 0.2], [0.2, 1.0]])
NUMBERS = {"matrix": 0.9, "push": 0.3, "q": 0.1, "start": 1.0, "spread": 1.0, "slope": 0.5, "r": 0.25, "bias": 0.3,
           "scale": 0.8, "link": 0.05}  # fmt: skip
X = np.array(list(NUMBERS.values()))
FILTERS = {
    "fading": lambda plant, sensor, s, N: hg.linear_filter(plant, sensor, hg.hop(hg.Rayleigh(s), N, dimension=2)),
    "known": lambda plant, sensor, s, N: hg.linear_filter(plant, sensor, hg.hop(s, N, dimension=2)),
    "kalman": lambda plant, sensor, s, N: hg.kalman_filter(plant, sensor),
}
KALMANS_LINK = "kalman", ("link",)  # there is none
U = np.random.default_rng(1).normal(size=(STEPS, 1))
Z = np.random.default_rng(0).normal(size=(STEPS, 2)) + 1
Z[5, 0] = Z[9] = Z[11, 1] = np.nan


def make(kind, x):
    """Return the filter of a plant, sensor and link of which every part depends on a number in x."""
    matrix, push, q, start, spread, slope, r, bias, scale, noise = x
    plant = hg.LinearPlant(
        jnp.asarray(A).at[0, 0].set(matrix),
        hg.Gaussian(q * np.diag([1.0, 0.5, 0.1]), push * np.ones(3)),
        start * np.array([1.0, -1.0, 2.0]),
        spread * np.eye(3),
        push * B,
    )
    sensor = hg.LinearSensor(jnp.asarray(C).at[0, 1].set(slope), hg.Gaussian(r * SKEW, bias * np.array([1.0, 2.0])))
    return FILTERS[kind](plant, sensor, scale, noise * SKEW)


def likelihood(kind):
    return lambda x, z=Z, u=U: hg.log_likelihood(make(kind, x), z, u)


@pytest.mark.slow
def test_gradients_in_all_numbers_and_data_are_those_of_the_factors():
    """To 1e-12 of the largest: two ways of some thousand operations."""

    def by_factors(x, z, u):
        return jnp.sum(make("fading", x).scan(z, u, lambda state, innovation, k: innovation.log_likelihood))

    with jax.enable_x64(True):
        value, slopes = jax.jit(jax.value_and_grad(likelihood("fading"), (0, 1, 2)))(X, Z, U)
        same, expected = jax.jit(jax.value_and_grad(by_factors, (0, 1, 2)))(X, Z, U)
    assert value == same
    for a, b in zip(slopes, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * np.max(np.abs(b)))


@cache
def compile_slopes_and_value(kind):
    """Compile both, once for all numbers that are zero."""
    return jax.jit(jax.grad(likelihood(kind))), jax.jit(likelihood(kind))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "zero"),
    [(kind, zero) for kind in FILTERS for zero in (("q", "spread"), ("r",), ("link",)) if (kind, zero) != KALMANS_LINK],
)
def test_gradients_where_a_covariance_is_zero(kind, zero):
    """Of several components: the derivative of the factors of a covariance of zero misses what correlates them."""
    x, step = X.copy(), 1e-6
    x[[list(NUMBERS).index(name) for name in zero]] = 0.0
    with jax.enable_x64(True):
        gradient, value = compile_slopes_and_value(kind)
        slopes = gradient(x)
        # One-sided differences, as variances have none below zero; their error is the square of the step.
        at = [[float(value(x + count * step * e)) for count in (0, 1, 2)] for e in np.eye(len(x))]
    differences = np.array(at) @ [-3.0, 4.0, -1.0] / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


@jax.jit
@jax.grad
def slopes_of_kalman(scales):
    start, q, r = scales[:, None, None] * SHAPES
    plant, sensor = hg.LinearPlant(MOTION, q, np.zeros(2), start), hg.LinearSensor(READING, r)
    return hg.log_likelihood(hg.kalman_filter(plant, sensor), ROWS)


@pytest.mark.slow
@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.5), (0.0, 0.25, 0.0), (1.0, 0.25, 0.0), (0.5, 0.0, 0.25)])
def test_kalmans_gradient_is_exact_where_covariances_are_zero(scales):
    """To some thousand roundings."""
    with jax.enable_x64(True):
        slopes = slopes_of_kalman(np.array(scales))
    expected = differentiate_exactly(scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-12 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_a_kalman_filter_that_starts_from_another_law_than_its_plant():
    """The derivatives are by the filter's law of the first state: at zero those of the plant's with the same law."""
    plant = hg.LinearPlant(MOTION, 0.25 * SHAPES[1], np.ones(2), np.eye(2))
    sensor = hg.LinearSensor(READING, 0.5 * SHAPES[2])

    def from_filter(x):
        return hg.log_likelihood(hg.kalman_filter(plant, sensor, x * np.ones(2), x * SHAPES[0]), ROWS)

    def from_plant(x):
        other = hg.LinearPlant(MOTION, 0.25 * SHAPES[1], x * np.ones(2), x * SHAPES[0])
        return hg.log_likelihood(hg.kalman_filter(other, sensor), ROWS)

    with jax.enable_x64(True):
        both = jax.jit(lambda x: (jax.grad(from_filter)(x), jax.grad(from_plant)(x)))(0.0)
    assert both[0] == pytest.approx(float(both[1]), rel=1e-13)


@pytest.mark.slow
def test_second_derivatives_are_differences_of_gradients():
    """Forward over backward mode, in which JAX forgets the rules of derivatives in a loop."""

    def function(x):
        plant = hg.LinearPlant([[0.9]], [[x[0]]], [0.3], [[1.0]])
        sensor = hg.LinearSensor([[1.0]], [[x[1]]])
        return hg.log_likelihood(hg.linear_filter(plant, sensor, hg.hop(hg.Rayleigh(0.8), 0.1)), Z[:4, 1:])

    x, step = np.array([0.2, 0.3]), 1e-5
    with jax.enable_x64(True):
        gradient, second = jax.jit(jax.grad(function)), jax.jit(jax.hessian(function))(x)
        along = jax.jit(lambda x: jax.jvp(function, (x,), (x,))[1])(x)
        differences = [(gradient(x + step * e) - gradient(x - step * e)) / (2 * step) for e in np.eye(2)]
        assert float(along) == pytest.approx(float(gradient(x) @ x), rel=1e-12)
    # Differences err by a sixth of the square of the step times third derivatives, which are some hundred.
    np.testing.assert_allclose(second, differences, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_a_trace_that_is_not_differentiated_has_the_value_of_a_call():
    """Without derivatives the filter is scanned as by a call with numbers; engines differ by roundings."""
    function = likelihood("fading")
    with jax.enable_x64(True):
        assert float(jax.jit(function)(X)) == pytest.approx(function(X), rel=1e-14)
