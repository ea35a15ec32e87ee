"""Filters with a factored covariance are the filters they are made of."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.gaussian.factored import factored
from tests.follow import apart, follow_known

STEPS = 40
LINE = hg.LinearPlant(
    [[1, 0.1], [0, 0.95]], [[0.02, 0.01], [0.01, 0.03]], [1.0, 2.0], [[1, 0.2], [0.2, 0.5]], [[0.0], [0.1]]
)
LINEAR = hg.LinearSensor([[1.0, 0.3], [0.0, 1.0]], hg.Gaussian([[0.05, 0.01], [0.01, 0.02]], [0.1, -0.2]))
CURVED = hg.Plant(
    lambda x, u: jnp.stack([x[0] + 0.1 * jnp.cos(x[1]), 0.9 * x[1] + u[0]]),
    noise=lambda u: jnp.diag(jnp.stack([0.02, 0.03 + 0.1 * u[0] ** 2])),
    initial_mean=[1.0, 2.0],
    initial_covariance=[[1, 0.2], [0.2, 0.5]],
    inputs=["u"],
)
BENT = hg.Sensor(lambda x: jnp.stack([jnp.sin(x[0]), x[0] * x[1]]), noise=[[0.05, 0.01], [0.01, 0.02]])
RELAY = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02), hg.hop(1.0, 0.01, amplification=1.2)])
APART = hg.parallel([RELAY, hg.perfect()])
SHARED = hg.hop(hg.Rayleigh(0.8), 0.02, dimension=2)
TURNING = hg.Plant(
    lambda x, u: jnp.stack([x[0] + 0.4, x[1] + 0.1 * jnp.sin(x[0]) + u[0]]),
    0.01 * np.eye(2), [3.0, 0.0], 0.1 * np.eye(2), states=["heading", "place"], inputs=["u"], circular=["heading"],
)  # fmt: skip
COMPASS = hg.Sensor(lambda x: jnp.stack([x[0], x[1]]), 0.02 * np.eye(2), ["heading", "place"], circular=["heading"])

QUADRATIC = hg.filters.PolynomialMoments(2)
SHARED_OF_TWO = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1, dimension=2)


def over_time():
    hops = [hg.hop(hg.Rayleigh(0.5 + k / STEPS), 0.02, dimension=2) for k in range(STEPS)]
    plants = [
        hg.LinearPlant([[1, 0.1], [0, 0.9 + k / 999]], (0.01 + k / 999) * np.eye(2), [1, 2], np.eye(2), [[0], [0.1]])
        for k in range(STEPS)
    ]
    return hg.model.over_time(plants), LINEAR, hg.model.over_time(hops)


FILTERS = {
    "kalman": lambda: hg.kalman_filter(LINE, LINEAR),
    "linear, a gain for each": lambda: hg.linear_filter(LINE, LINEAR, APART),
    "linear, one gain for both": lambda: hg.linear_filter(LINE, LINEAR, SHARED),
    "linear, over time": lambda: hg.linear_filter(*over_time()),
    "cubature": lambda: hg.cubature_filter(CURVED, BENT, SHARED),
    "cubature, linear plant": lambda: hg.cubature_filter(LINE, BENT, APART),
    "extended": lambda: hg.extended_filter(CURVED, BENT, APART),
    "extended, over time": lambda: hg.extended_filter(*over_time()),
    "mean gain": lambda: hg.mean_gain_filter(CURVED, LINEAR, SHARED),
    "angles": lambda: hg.cubature_filter(TURNING, COMPASS, hg.perfect(2)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_it_is_the_filter_it_is_made_of(name):
    """Equal to rounding where components are missing, one or all: 1e-11 deviations, since curved filters amplify it.

    A cubature filter is another one for another root of the covariance: L is Cholesky's, as the filter's.
    """
    base = FILTERS[name]()
    item = factored(base)
    rng = np.random.default_rng(0)
    z, u = rng.normal(size=(STEPS, 2)) + 1, 0.1 * rng.normal(size=(STEPS, 1))
    z[rng.random((STEPS, 2)) < 0.25] = np.nan
    z[7] = np.nan
    assert max(apart(follow_known(item, z, u), follow_known(base, z, u))) < 1e-11
    assert (item.claim, item.states, item.received, item.horizon) == (
        base.claim, base.states, base.received, base.horizon,
    )  # fmt: skip


def test_its_innovations_are_the_filter_s():
    base = hg.linear_filter(LINE, LINEAR, APART)
    item, u, z = factored(base), np.array([0.1]), np.array([1.2, np.nan])
    (_, of_base), (_, of_item) = (f.correct(f.predict(f.init(), u), z) for f in (base, item))
    np.testing.assert_allclose(of_item.value, of_base.value, rtol=1e-13)
    np.testing.assert_allclose(of_item.covariance, of_base.covariance, rtol=1e-12)
    np.testing.assert_allclose(of_item.log_likelihood, of_base.log_likelihood, rtol=1e-12)


def test_it_carries_moments_before_data_only_where_gains_are_random():
    assert factored(hg.linear_filter(LINE, LINEAR, hg.perfect(2))).init().before_data is None
    assert factored(hg.linear_filter(LINE, LINEAR, SHARED)).init().before_data is not None


@pytest.mark.parametrize(
    ("make", "came"),
    [
        (lambda: hg.filters.mixture_filter(LINE, LINEAR, SHARED_OF_TWO), "MixtureFilter"),
        (lambda: hg.filters.gaussian_filter(CURVED, LINEAR, SHARED, QUADRATIC), "PolynomialMoments"),
    ],
)
def test_other_filters_are_refused(make, came):
    expected = "single precision: expected a linear, extended or cubature filter, or a schedule of gains, got .*" + came
    with pytest.raises(ValueError, match=expected):
        factored(make())
