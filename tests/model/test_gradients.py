"""Models hold what JAX traces: derivatives of a filter's final error covariance are those of finite differences."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import heliograph as hg
from heliograph.engine.choice import compute_once
from heliograph.factors import WeightedColumns
from heliograph.random_affine.moments import push_moments

STEPS = 6
LOST = 2  # the step of which nothing arrives
STEP = 1e-5  # of the central differences: their own error is of the order of STEP^2, that of rounding 1e-11


def plant_and_sensor(p):
    """Growth, process noise, initial variance and sensor noise are parameters."""
    plant = hg.LinearPlant(
        [[p[0], 0.1], [0.0, 0.8]], [[p[1], 0.02], [0.02, 0.3]], [1.0, -0.5], [[1.0, 0.1], [0.1, p[2]]]
    )
    return plant, hg.LinearSensor([[1.0, 0.5]], p[3])


def chain(p):
    """Two hops: the law's parameters, the first hop's noise and power, the second's amplification."""
    first = hg.hop(hg.Rayleigh(p[0]), p[1], power=p[2])
    return hg.amplify_and_forward([first, hg.hop(hg.random_affine.Rician(p[3], p[4]), 0.1, amplification=p[5])])


def with_direct(p):
    """The chain beside a direct hop with shadowing."""
    return hg.model.with_direct_link(chain(p[:6]), hg.hop(hg.random_affine.LogNormal(p[6], p[7]), p[8], power=p[9]))


def dropout(p):
    """A hop that is lost with a probability which is a parameter too, and noise that has a mean."""
    noise = hg.Gaussian([[p[3]]], [p[4]])
    return hg.dropout(hg.hop(hg.random_affine.Nakagami(p[0], p[1]), noise, power=p[2]), p[5])


def discrete(p):
    """Gains of two values, noise of two atoms; the probabilities are parameters."""
    law = hg.Discrete([p[0], 1.0], [p[1], 1 - p[1]])
    return hg.hop(law, hg.random_affine.FiniteSupport([[p[2]], [-0.2]], [p[3], 1 - p[3]]))


def uncertain(p):
    """Probabilities within a radius beside a known hop: the scalars of the bound are searched for at each step."""
    law = hg.Discrete([0.5, 1.0], [0.4, 0.6], 0.05)
    return hg.model.with_direct_link(hg.hop(law, p[0], power=p[1]), hg.hop(1.0, p[2]))


MODEL = [0.95, 0.4, 0.8, 0.2]
CHAIN = [0.9, 0.15, 1.3, 0.7, 0.4, 1.5]
CASES = {
    "two hops": (chain, CHAIN),
    "direct hop beside them": (with_direct, [*CHAIN, -0.1, 0.3, 0.2, 0.8]),
    "dropout": (dropout, [1.5, 1.2, 0.9, 0.3, 0.4, 0.7]),
    "uncertain": (uncertain, [0.15, 1.3, 0.3]),
    "discrete": (discrete, [0.3, 0.4, 0.5, 0.3]),
}


def final_error(channel, p):
    """Trace of the last error covariance; plant, sensor, channel and filter are built inside."""
    filter_ = hg.linear_filter(*plant_and_sensor(p), channel(p[len(MODEL) :]))
    assert filter_.claim == ("upper" if channel is uncertain else "exact")
    received = jnp.zeros(filter_.received)  # the covariance depends on what arrives, not on what is measured

    def body(state, k):
        return filter_.step(state, jnp.where(k == LOST, jnp.nan, received), (), k)[0], None

    last, _ = jax.lax.scan(body, filter_.init(), jnp.arange(STEPS))
    return jnp.trace(filter_.estimate(last).covariance)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_gradient_of_the_final_error_is_that_of_finite_differences(name):
    channel, parameters = CASES[name]
    p = np.array([*MODEL, *parameters])

    def error(p):
        return final_error(channel, p)

    direction = np.cos(np.arange(len(p)))

    def both_ways(p):
        """Value, gradient and slope along the direction: forward, and the same turned around."""
        value, pushed = jax.linearize(error, p)
        return value, jax.linear_transpose(pushed, p)(1.0)[0], pushed(direction)

    value, gradient, along = compute_once(both_ways, jax.jit(both_ways), (p,))  # a quarter of the time of XLA
    items = STEP * np.eye(len(p))
    differences = [(concrete(channel, p + e) - concrete(channel, p - e)) / (2 * STEP) for e in items]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(along, gradient @ direction, rtol=1e-9)
    np.testing.assert_allclose(value, concrete(channel, p), rtol=1e-12)


def concrete(channel, p):
    """The same from plain numbers, through the public filter, step by step."""
    filter_ = hg.linear_filter(*plant_and_sensor(p), channel(p[len(MODEL) :]))
    state = filter_.init()
    for k in range(STEPS):
        received = np.full(filter_.received, np.nan if k == LOST else 0.0)
        state, estimate = filter_.step(state, received, (), k)
    return np.trace(estimate.covariance)


LAWS = {
    "rayleigh": (hg.Rayleigh, [0.7]),
    "rician": (hg.random_affine.Rician, [1.5, 0.4]),
    "rician without sight": (hg.random_affine.Rician, [0.0, 0.4]),
    "rician with much sight": (hg.random_affine.Rician, [30.0, 0.4]),
    "nakagami": (hg.random_affine.Nakagami, [1.7, 2.0]),
    "log-normal": (hg.random_affine.LogNormal, [-0.2, 0.3]),
    "discrete": (lambda a, p: hg.Discrete([a, 1.0], [p, 1 - p]), [0.0, 0.3]),
    "bernoulli": (hg.random_affine.bernoulli, [0.8]),
    "moments": (lambda m, s: hg.random_affine.GivenMoments([m, s, 2.0, 5.0]), [1.0, 1.5]),
}


@pytest.mark.parametrize("name", LAWS)
def test_moments_of_traced_laws_have_the_derivatives_of_finite_differences(name):
    make, parameters = LAWS[name]
    p = np.array(parameters)
    items = np.eye(len(p)) * STEP
    orders = range(5)

    def moments(p):
        law = make(*p)
        return jnp.stack([jnp.asarray(law.moment(k), dtype=float) for k in orders])

    with jax.enable_x64(True):
        value, slope = jax.jit(lambda p: (moments(p), jax.jacfwd(moments)(p)))(p)
    known = [make(*p).moment(k) for k in orders]
    assert all(isinstance(m, float) for m in known)
    np.testing.assert_allclose(value, known, rtol=1e-13)
    if name == "rician without sight":  # negative sight is refused; moments are even in it, so the slope is zero
        np.testing.assert_allclose(slope[:, 0], 0.0, atol=1e-12)
        items = items[1:]
        slope = slope[:, 1:]
    rows = [[(make(*(p + e)).moment(k) - make(*(p - e)).moment(k)) / (2 * STEP) for e in items] for k in orders]
    np.testing.assert_allclose(slope, rows, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("order", range(9))
@pytest.mark.parametrize("sight", [0.0, 1e-3, 0.5, 2.0, 20.0])
def test_rician_moments_are_those_of_the_hypergeometric_function(order, sight):
    expected = 0.3**order * 2 ** (order / 2) * special.gamma(1 + order / 2)
    expected *= special.hyp1f1(-order / 2, 1.0, -((sight / 0.3) ** 2) / 2)
    assert hg.random_affine.Rician(sight, 0.3).moment(order) == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_noises_and_moments_of_every_map_can_be_traced():
    """Joint moments to order four of a channel made of everything, and its draws, against their concrete numbers."""

    def make(p):
        noise = hg.random_affine.Shaped(
            [[1.0, p[0]], [0.0, 1.0]],
            hg.random_affine.Independent([hg.Gaussian([[p[1]]]), hg.Gaussian([[0.2]], [p[2]])]),
        )
        relayed = hg.random_affine.Series(
            [hg.hop(hg.Rayleigh(p[3]), noise), hg.hop(hg.random_affine.Rician(1.0, p[4]), [[p[1], 0.0], [0.0, 0.3]])]
        )
        return hg.random_affine.Stack(
            [hg.dropout(relayed, p[5]), hg.erasure(hg.random_affine.known([[1.0, p[0]]], [p[2]]), 1.0).base]
        )

    def evaluate(p):
        item = make(p)
        return item.moments(1).matrix, item.moments(4).matrix, push_moments(item, 4, np.ones(15))

    p = np.array([0.5, 0.3, 0.1, 0.8, 0.4, 0.7])
    single, two, pushed = compute_once(evaluate, jax.jit(evaluate), (p,))
    np.testing.assert_allclose(single, make(p).moments(1).matrix, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(two, make(p).moments(4).matrix, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(pushed, make(p).moments(4).matrix @ np.ones(15), rtol=1e-12)


def test_a_channel_with_an_uncertain_law_keeps_its_bound_under_a_trace():
    """The worst cases over a known polytope are functions of the hop's power; the decisions on the way are the same."""

    def make(p):
        law = hg.Discrete([0.7, 0.85, 1.0], [0.3, 0.3, 0.4], 0.02)
        relayed = hg.amplify_and_forward([hg.hop(law, p[0]), hg.hop(law, 0.1, power=p[1])])
        return relayed, hg.model.with_direct_link(relayed, hg.hop(hg.Rayleigh(p[2]), 0.1))

    p = np.array([0.2, 1.3, 0.9])

    def described(p):
        return [hg.random_affine.second_order(channel) for channel in make(p)]

    traced = compute_once(described, jax.jit(described), (p,))
    known = [hg.random_affine.second_order(channel) for channel in make(p)]
    # Columns of a known noise are a root, of a traced one L and d: their covariance is the same.
    for ours, theirs in zip(traced, known, strict=True):
        pair = [(replace(x, noise=WeightedColumns(0.0, 0.0)), *map(np.asarray, x.noise)) for x in (ours, theirs)]
        spreads = [(matrix * weights) @ matrix.T for _, matrix, weights in pair]
        np.testing.assert_allclose(*spreads, rtol=1e-12, atol=1e-14)
        for a, b in zip(*(jax.tree.leaves(x) for x, *_ in pair), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_what_is_decided_by_numbers_refuses_a_trace_in_one_line():
    with jax.enable_x64(True), pytest.raises(ValueError, match="probability radius: expected zero, where"):
        jax.jit(lambda p: hg.random_affine.bernoulli(p, 0.1).moment(1))(0.5)
    with jax.enable_x64(True), pytest.raises(ValueError, match="probability radius: expected a number, since"):
        jax.jit(lambda r: hg.random_affine.bernoulli(0.5, r).moment(1))(0.1)
    with jax.enable_x64(True), pytest.raises(ValueError, match=r"plant matrix: expected shape \(2, 2\)"):
        jax.jit(lambda a: hg.LinearPlant(a, np.eye(2), [0, 0], np.eye(2)).matrix)(np.eye(3))


def test_a_trace_reads_no_number_to_choose_a_claim():
    """A constant gain stays one: the filter is the Kalman filter, and exact, whatever is traced."""

    def claim(p):
        channel = hg.amplify_and_forward([hg.hop(p, 0.1), hg.hop(1.0, p)])
        filter_ = hg.cubature_filter(*plant_and_sensor(MODEL), channel)
        assert filter_.claim == "exact"
        random = hg.cubature_filter(*plant_and_sensor(MODEL), hg.hop(hg.Rayleigh(p), 0.1))
        assert random.claim == "nominal"
        return p

    with jax.enable_x64(True):
        jax.jit(claim)(0.7)


Z = np.random.default_rng(1).normal(size=(4, 1))
FILTERS = {
    "kalman": hg.kalman_filter, "extended": hg.extended_filter, "cubature": hg.cubature_filter,
    "unscented": hg.unscented_filter, "linear": lambda *parts: hg.linear_filter(*parts, hg.hop(1.0, 0.0)),
    "side information": lambda *parts: hg.filters.side_information_filter(*parts, hg.hop(1.0, 0.0)),
    "mixture": lambda *parts: hg.filters.mixture_filter(*parts, hg.hop(1.0, 0.0)),
}  # fmt: skip


def textbook(p):
    """Log-likelihood of x+ = .9 x + w, z = x + v by the Kalman filter's formulas; P0, Q and R are parameters."""
    mean, variance, total = 0.0, p[0], 0.0
    for z in Z[:, 0]:
        mean, variance = 0.9 * mean, 0.81 * variance + p[1]
        s = variance + p[2]
        total -= ((z - mean) ** 2 / s + jnp.log(2 * np.pi * s)) / 2
        mean, variance = mean + variance / s * (z - mean), variance * p[2] / s
    return total


SLOPE_OF_TEXTBOOK = jax.jit(jax.grad(textbook))


@cache
def compile_slope(name):
    """Compile the slope of a filter's log-likelihood by the same numbers, once for all of their values."""

    def likelihood(p):
        plant = hg.LinearPlant([[0.9]], jnp.reshape(p[1], (1, 1)), [0.0], jnp.reshape(p[0], (1, 1)))
        return hg.log_likelihood(FILTERS[name](plant, hg.LinearSensor([[1.0]], jnp.reshape(p[2], (1, 1)))), Z)

    return jax.jit(jax.grad(likelihood))


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("at", [(0.0, 0.0, 0.3), (0.0, 0.2, 0.3), (1.0, 0.0, 0.3), (1.0, 0.2, 0.0), (0.0, 0.2, 0.0)])
def test_derivatives_by_variances_at_zero(name, at):
    """Of the start, and of the noises of plant and sensor: to one side there is a slope."""
    with jax.enable_x64(True):
        slopes, expected = (slope(jnp.array(at)) for slope in (compile_slope(name), SLOPE_OF_TEXTBOOK))
    np.testing.assert_allclose(slopes, expected, rtol=1e-10, atol=1e-12)  # rounding of some hundred operations
