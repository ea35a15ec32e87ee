"""Derivatives of nonlinear filters' likelihoods where covariances are zero, against fractions and textbook formulas."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters import PolynomialMoments, gaussian_filter, late_filter, mixture_filter, sequential_filter
from tests.oracles.likelihood_slopes import MOTION, READING, ROWS, SHAPES, differentiate_exactly

pytestmark = pytest.mark.slow  # each compiles a derivative
PERFECT, NAMES = hg.perfect(2), ("p", "q", "r")
FILTERS = {
    "extended": hg.extended_filter,
    "cubature": hg.cubature_filter,
    "unscented": hg.unscented_filter,
    "near points": lambda plant, sensor: hg.unscented_filter(plant, sensor, alpha=0.01),
    "quadratic": lambda plant, sensor: gaussian_filter(plant, sensor, PERFECT, transform=PolynomialMoments(2)),
    "cubic": lambda plant, sensor: gaussian_filter(plant, sensor, PERFECT, transform=PolynomialMoments(3)),
}
START = np.array([0.3, -0.2])


@cache
def compile_slopes(function):
    """Compile the derivative of a function, once for all numbers at which it is asked for."""
    return jax.jit(jax.grad(function))


def slopes_of(function, x):
    with jax.enable_x64(True):
        return np.asarray(compile_slopes(function)(np.array(x)))


def affine_models(scales, reading=READING):
    """Return a linear plant and sensor, written as functions of which a filter does not know that they are linear."""
    start, q, r = scales[:, None, None] * SHAPES
    plant = hg.Plant(lambda x, u: jnp.asarray(MOTION) @ x, q, np.zeros(2), start)
    return plant, hg.Sensor(lambda x: jnp.asarray(reading) @ x, r[: len(reading), : len(reading)])


def likelihood(models, name, x):
    return hg.log_likelihood(FILTERS[name](*models(x)), ROWS)


AFFINE = {name: partial(likelihood, affine_models, name) for name in FILTERS}


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.5), (0.0, 0.25, 0.0), (1.0, 0.25, 0.0), (0.5, 0.0, 0.25)])
@pytest.mark.parametrize("name", FILTERS)
def test_gradients_of_affine_functions_are_exact_where_covariances_are_zero(name, scales):
    """To 1e-11 of the largest: derivatives of factors are as large as variances are small, and some digits are lost."""
    slopes = slopes_of(AFFINE[name], scales)
    expected = differentiate_exactly(scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


@pytest.mark.parametrize("noise", [0.0, 1e-20])
@pytest.mark.parametrize("name", ["extended", "cubature"])
def test_gradients_with_a_precise_sensor_of_one_of_the_states(name, noise):
    """To 1e-11 of the largest, as above: the other state has no slope in what is measured."""
    reading, rows, scales = np.array([[1.0, 0.0]]), ROWS[:, :1], (0.8, 0.25, noise)
    slopes = slopes_of(lambda x: hg.log_likelihood(FILTERS[name](*affine_models(x, reading)), rows), scales)
    expected = differentiate_exactly(scales, reading, rows)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_second_derivatives_are_right_or_not_finite():
    """Twice along a variance of zero a filter by factors has none; elsewhere they are the Kalman filter's, to 1e-9."""

    def hessian(scales, make):
        with jax.enable_x64(True):
            return np.asarray(jax.jit(jax.hessian(lambda x: hg.log_likelihood(make(x), ROWS)))(np.array(scales)))

    def by_factors(x):
        return hg.extended_filter(*affine_models(x))

    def by_covariances(x):
        plant, sensor = affine_models(x)
        linear = hg.LinearPlant(MOTION, plant.noise.covariance, np.zeros(2), plant.initial_covariance)
        return hg.kalman_filter(linear, hg.LinearSensor(READING, sensor.noise.covariance))

    expected = hessian((0.8, 0.25, 0.4), by_covariances)
    np.testing.assert_allclose(hessian((0.8, 0.25, 0.4), by_factors), expected, rtol=1e-9)
    assert not np.any(np.isfinite(np.diagonal(hessian((0.0, 0.0, 0.5), by_factors))[:2]))


def move(x, u=()):
    return jnp.stack([0.75 * x[0] + 0.25 * jnp.sin(x[1]), 0.5 * x[1] - 0.125 * x[0] + 0.1 * x[0] ** 2])


def read(x):
    return jnp.stack([x[0] + 0.5 * x[1] + 0.2 * x[1] ** 2, jnp.sinh(x[1])])


def curved_models(scales):
    start, q, r = scales[:, None, None] * SHAPES
    return hg.Plant(move, q, START, start), hg.Sensor(read, r)


def textbook_likelihood(scales, order):
    """Return the likelihood of the extended filter by covariances, of second order with 1/2 tr(f'' P) in the means."""
    (P, Q, R), m, total = scales[:, None, None] * SHAPES, jnp.asarray(START), 0.0

    def moments(function, m, P):
        slopes, bends = jax.jacfwd(function)(m), jax.jacfwd(jax.jacfwd(function))(m)
        return function(m) + (order - 1) * jnp.einsum("iab,ab->i", bends, P) / 2, slopes

    for z in ROWS:
        m, F = moments(move, m, P)
        P = F @ P @ F.T + Q
        expected, H = moments(read, m, P)
        e, S = z - expected, H @ P @ H.T + R
        total = total - (e @ jnp.linalg.solve(S, e) + jnp.linalg.slogdet(S)[1] + 2 * np.log(2 * np.pi)) / 2
        K = jnp.linalg.solve(S, H @ P).T
        m, P = m + K @ e, P - K @ S @ K.T
    return total


CURVED = {name: partial(likelihood, curved_models, name) for name in FILTERS}
FIRST_ORDER, SECOND_ORDER = (partial(textbook_likelihood, order=order) for order in (1, 2))


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.5), (0.0, 0.25, 0.0), (1.0, 0.25, 0.0), (0.5, 0.0, 0.25)])
def test_the_extended_filter_has_the_gradient_of_the_textbook(scales):
    slopes, expected = slopes_of(CURVED["extended"], scales), slopes_of(FIRST_ORDER, scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


@pytest.mark.parametrize("name", [name for name in FILTERS if name != "extended"])
def test_points_have_the_gradient_of_second_order_where_nothing_is_uncertain(name):
    """As P goes to 0 all points give the mean f + tr(f'' P) / 2 and the covariance f' P f', to the first power of P."""
    scales = (0.0, 0.0, 0.5)
    slopes, expected = slopes_of(CURVED[name], scales), slopes_of(SECOND_ORDER, scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def differences(function, x, step=1e-4):
    """Return one-sided differences of four values, whose error is the fourth power of the step."""
    weights, counts = [-25 / 12, 4, -3, 4 / 3, -1 / 4], range(5)
    rows = [[function(np.array(x) + count * step * e) for count in counts] for e in np.eye(len(x))]
    return np.array(rows) @ weights / step


LINK = np.array([[0.5, 0.25], [0.25, 1.0]])


def linear_models(scales):
    start, q, r = scales[:3, None, None] * SHAPES
    return hg.LinearPlant(MOTION, q, START, start), hg.LinearSensor(READING, r)


def fading(n):
    return hg.gilbert_elliott(hg.hop(0.8, n * LINK, dimension=2), hg.hop(0.3, 4 * n * LINK, dimension=2), 0.1, 0.3)


OTHERS = {
    "fading link": lambda x: hg.cubature_filter(*curved_models(x[:3]), hg.hop(hg.Rayleigh(0.8), x[3] * LINK)),
    "link of known gain": lambda x: hg.extended_filter(*curved_models(x[:3]), hg.hop(0.8, x[3] * LINK)),
    "modes of a link": lambda x: hg.filters.imm_filter(*linear_models(x), fading(x[3])),
    "best linear filter behind modes": lambda x: hg.linear_filter(*linear_models(x), fading(x[3])),
    "mixture": lambda x: mixture_filter(*linear_models(x), hg.hop(0.8, x[3] * LINK)),
    "late": lambda x: late_filter(hg.extended_filter(*curved_models(x[:3])), 1),
    "two nodes": lambda x: sequential_filter(
        [hg.extended_filter(*curved_models(x[:3])), hg.extended_filter(*curved_models(x[:3]), hg.hop(0.8, x[3] * LINK))]
    ),
}


def other_likelihood(name, x):
    z = np.concatenate([ROWS, ROWS[::-1]], axis=1) if name == "two nodes" else ROWS
    return hg.log_likelihood(OTHERS[name](x), z)


LIKELIHOODS = {name: partial(other_likelihood, name) for name in OTHERS}


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.5, 0.3), (0.8, 0.25, 0.4, 0.0)])
@pytest.mark.parametrize("name", OTHERS)
def test_gradients_of_other_filters_are_one_sided_differences(name, scales):
    """To 1e-5 of the largest: rounding of values over the step, and the fourth power of the step times what varies."""
    value = LIKELIHOODS[name]
    slopes, expected = slopes_of(value, scales), differences(lambda x: float(value(x)), scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-5 * np.max(np.abs(expected)))


def marginal(x):
    """Return the log-density of the rows with an unknown start, but for a constant: by all of them at once."""
    F, n = MOTION, len(ROWS)
    power = [np.linalg.matrix_power(F, k) for k in range(n + 1)]
    Q, R = x[0] * SHAPES[1], x[1] * SHAPES[2]
    G = np.concatenate([READING @ power[t + 1] for t in range(n)])
    W = np.block([[READING @ power[t - j] if j <= t else np.zeros((2, 2)) for j in range(n)] for t in range(n)])
    S = W @ jnp.kron(np.eye(n), Q) @ W.T + jnp.kron(np.eye(n), R)
    z, inverse = ROWS.ravel(), jnp.linalg.inv(S)
    J = G.T @ inverse @ G
    rest = inverse - inverse @ G @ jnp.linalg.inv(J) @ G.T @ inverse
    return -(jnp.linalg.slogdet(S)[1] + jnp.linalg.slogdet(J)[1] + z @ rest @ z) / 2


def from_unknown_start(x):
    plant = hg.LinearPlant(MOTION, x[0] * SHAPES[1], np.zeros(2), hg.diffuse)
    return hg.log_likelihood(hg.kalman_filter(plant, hg.LinearSensor(READING, x[1] * SHAPES[2])), ROWS)


@pytest.mark.parametrize("scales", [(0.25, 0.0), (0.0, 0.5), (0.25, 0.5)])
def test_an_unknown_start_has_the_gradient_of_the_marginal_density(scales):
    """Of z = G delta + y with an unknown delta: -(log |S| + log |G' S^-1 G| + y' S^-1 (y - G delta^)) / 2."""
    slopes, expected = slopes_of(from_unknown_start, scales), slopes_of(marginal, scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_a_traced_known_part_of_an_unknown_start():
    """One state is unknown, the other has a variance that is differentiated, at 0."""

    def likelihood(p):
        plant = hg.LinearPlant(MOTION, 0.25 * SHAPES[1], np.zeros(2), hg.diffuse(["x0"], known=p * np.diag([0.0, 1.0])))
        return hg.log_likelihood(hg.kalman_filter(plant, hg.LinearSensor(READING, 0.5 * SHAPES[2])), ROWS)

    expected = differences(lambda x: float(likelihood(float(x[0]))), [0.0], step=1e-3)[0]
    assert slopes_of(likelihood, 0.0) == pytest.approx(expected, rel=1e-8)


def test_what_has_no_derivative_is_no_number():
    """By side information, where nothing is uncertain; elsewhere it is that of the best linear filter."""

    def by_side_information(x):
        return hg.log_likelihood(hg.filters.side_information_filter(*linear_models(x), fading(x[3])), ROWS)

    assert np.all(np.isnan(slopes_of(by_side_information, (0.0, 0.0, 0.5, 0.3))))
    regular = slopes_of(by_side_information, (0.8, 0.25, 0.4, 0.3))
    best = slopes_of(LIKELIHOODS["best linear filter behind modes"], (0.8, 0.25, 0.4, 0.3))
    np.testing.assert_allclose(regular, best, rtol=1e-10)


def test_a_transform_of_moments_alone_has_no_derivative_where_nothing_is_uncertain():
    class Moments(hg.filters.AbstractTransform):
        def apply(self, function, mean, covariance):
            slopes = jax.jacfwd(function)(mean)
            return hg.filters.Transformed(function(mean), slopes @ covariance @ slopes.T, covariance @ slopes.T)

    def likelihood(x):
        return hg.log_likelihood(gaussian_filter(*curved_models(x), PERFECT, transform=Moments()), ROWS)

    assert np.isnan(slopes_of(likelihood, (0.0, 0.0, 0.5))[0])
    expected = slopes_of(FIRST_ORDER, (0.8, 0.25, 0.4))
    np.testing.assert_allclose(slopes_of(likelihood, (0.8, 0.25, 0.4)), expected, rtol=1e-9)


def planned_likelihood(x):
    return hg.log_likelihood(hg.kalman_filter(*linear_models(x)).planned(np.zeros((len(ROWS), 0))), ROWS)


def kalman_likelihood(x):
    return hg.log_likelihood(hg.kalman_filter(*linear_models(x)), ROWS)


@pytest.mark.parametrize("scales", [(0.0, 0.0, 0.5), (1.0, 0.25, 0.0)])
def test_a_planned_filter_has_the_gradient_of_the_filter_itself(scales):
    """Its matrices are recorded in the same trace; to some thousand roundings of the largest."""
    slopes, expected = slopes_of(planned_likelihood, scales), slopes_of(kalman_likelihood, scales)
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def scalar_models(scales):
    start, q, r = scales[:3, None, None]
    return hg.LinearPlant([[0.8]], q, [0.3], start), hg.LinearSensor([[1.0]], r)


@pytest.mark.parametrize("scales", [(0.8, 0.25, 0.3), (0.0, 0.0, 0.5)])
def test_a_sender_that_is_silent_by_chance(scales):
    """Silence has no innovation, of which NaN took part in the derivative backwards. To 1e-5, as of other filters."""

    def likelihood(x):
        trigger = hg.StochasticTrigger(0.6)
        return hg.log_likelihood(hg.event_filter(*scalar_models(x), hg.perfect(), trigger), [[1.25], [np.nan], [0.4]])

    expected = differences(lambda x: float(likelihood(x)), scales)
    np.testing.assert_allclose(slopes_of(likelihood, scales), expected, rtol=0, atol=1e-5 * np.max(np.abs(expected)))


def test_a_clock_has_a_gradient():
    """Backwards too: whether a clock is observed is judged by eigenvalues. It has none where a state is known."""
    dt, clock, z = 0.5, {"b": hg.model.Clock(0.5, 2e-3)}, np.array([[0.6, 0.2], [1.1, 0.7], [1.4, 1.3]])

    def likelihood(x):
        cart = hg.LinearPlant([[1.0, dt], [0.0, 1.0]], x[1] * SHAPES[1], [0.0, 1.0], x[0] * SHAPES[0])
        position = hg.LinearSensor([[1.0, 0.0]], x[2:, None])
        plant, sensors = hg.model.with_clocks(cart, dict.fromkeys("ab", position), clock, [[0.0, 1.0], [0.0, 0.0]], dt)
        both = hg.model.joint_sensor(sensors)
        return hg.log_likelihood(hg.filters.clock_filter(plant, both, hg.parallel([hg.perfect()] * 2), ["b"]), z)

    expected = differences(lambda x: float(likelihood(x)), (0.8, 0.25, 0.5))
    slopes = slopes_of(likelihood, (0.8, 0.25, 0.5))
    assert np.any(np.isnan(slopes_of(likelihood, (0.0, 0.0, 0.5))))
    np.testing.assert_allclose(slopes, expected, rtol=0, atol=1e-5 * np.max(np.abs(expected)))


def test_what_jumps_or_is_excluded_has_no_derivative():
    """A precise value beyond a limit is moved into it by what is left of the covariance; 1.2 is no multiple of 0.25."""

    def within_limits(x):
        start, q, r = x[:, None, None] * SHAPES
        plant = hg.LinearPlant(MOTION, q, START, start, limits={"x0": (-1.0, 0.5)})
        return hg.log_likelihood(hg.kalman_filter(plant, hg.LinearSensor(READING, r)), ROWS)

    def in_steps(x):
        plant, sensor = scalar_models(x)
        sensor = hg.LinearSensor([[1.0]], sensor.noise.covariance, resolution=0.25)
        return hg.log_likelihood(hg.word_filter(plant, sensor), [[1.25], [1.2]])

    assert np.all(np.isnan(slopes_of(within_limits, (0.8, 0.25, 0.0))))
    assert np.all(np.isnan(slopes_of(in_steps, (0.8, 0.25, 0.5))))
