"""Laws, noises and maps of a user's own, written in jax.numpy: their known numbers have all digits wherever asked."""

from math import factorial, gamma

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import gammaln

import heliograph as hg
from heliograph.testing import check_random_affine

PLANT, SENSOR = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
Z = np.array([0.3, np.nan, -0.7, 1.1])


class Weibull(hg.random_affine.AbstractLaw):
    scale: float
    shape: float

    def sample(self, key):
        return self.scale * jax.random.exponential(key, dtype=float) ** (1 / self.shape)

    def moment(self, order):
        return self.scale**order * jnp.exp(gammaln(1 + order / self.shape))


class WeibullByMath(Weibull):
    def moment(self, order):
        return self.scale**order * gamma(1 + order / self.shape)


class Laplace(hg.random_affine.AbstractNoise):
    deviation: float

    @property
    def mean(self):
        return jnp.zeros(1)

    @property
    def covariance(self):
        return jnp.array([[self.deviation**2]]) / 1.0

    def sample(self, key):
        return self.deviation / 2**0.5 * jax.random.laplace(key, (1,), dtype=float)

    def moment(self, powers):
        (k,) = powers
        return (1 - k % 2) * jnp.exp(gammaln(k + 1.0)) * (self.deviation / jnp.sqrt(2.0)) ** k


class LaplaceByMath(Laplace):
    @property
    def mean(self):
        return np.zeros(1)

    @property
    def covariance(self):
        return np.array([[self.deviation**2]])

    def moment(self, powers):
        (k,) = powers
        return 0.0 if k % 2 else factorial(k) * (self.deviation / 2**0.5) ** k


class Uniform(hg.random_affine.AbstractRandomAffine):
    """z = g y with g uniform between `low` and 1."""

    low: float

    @property
    def outputs(self):
        return 1

    @property
    def inputs(self):
        return 1

    def sample(self, key):
        return jnp.diag(jnp.array([jax.random.uniform(key, minval=self.low, dtype=float), 1.0]))

    def moments(self, order):
        k = jnp.arange(order, -1, -1)
        return jnp.diag((1 - jnp.asarray(self.low) ** (k + 1)) / ((k + 1) * (1 - self.low)))

    def mean_gain(self):
        return hg.random_affine.GainAndNoise(hg.random_affine.Constant(jnp.sqrt(0.25 + 0 * self.low)), [[1.0]], 0.0)


class UniformByNumpy(Uniform):
    def moments(self, order):
        k = np.arange(order, -1, -1)
        return np.diag((1 - self.low ** (k + 1)) / ((k + 1) * (1 - self.low)))


PAIRS = {
    "law": (hg.hop(Weibull(1.1, 2.5), 0.05), hg.hop(WeibullByMath(1.1, 2.5), 0.05)),
    "noise": (hg.hop(0.7, Laplace(0.3)), hg.hop(0.7, LaplaceByMath(0.3))),
    "map": (Uniform(0.3), UniformByNumpy(0.3)),
}


@pytest.mark.parametrize("kind", PAIRS)
def test_formulas_in_jax_have_the_digits_of_those_in_numpy(kind):
    ours, other = (hg.linear_filter(PLANT, SENSOR, channel).run(Z) for channel in PAIRS[kind])
    # A few roundings: gammaln and the logarithm lose two of sixteen digits; single precision has seven.
    np.testing.assert_allclose(ours.covariances, other.covariances, rtol=1e-13)
    np.testing.assert_allclose(ours.means, other.means, rtol=1e-13)
    check_random_affine(PAIRS[kind][0], samples=2000)


def test_they_are_asked_inside_of_a_trace_too():
    """As filters that learn their models while they run do."""
    exact = gamma(1 + 2 / 2.5)

    def second(x):
        return x * Weibull(1.0, 2.5).moment(2)

    assert isinstance(Weibull(1.0, 2.5).moment(2), np.ndarray | np.floating | float)
    assert float(jax.jit(second)(1.0)) == pytest.approx(exact, rel=1e-6)  # the user's own trace is of single precision
    with jax.enable_x64(True):
        assert float(jax.jit(second)(1.0)) == pytest.approx(exact, rel=1e-14)
        slope = jax.grad(lambda shape: Weibull(1.0, shape).moment(2))(2.5)
    # E g^2 = Gamma(1 + 2/s): its slope by central differences, of error h^2
    h = 1e-5
    assert float(slope) == pytest.approx((gamma(1 + 2 / (2.5 + h)) - gamma(1 + 2 / (2.5 - h))) / (2 * h), rel=1e-8)


def test_a_number_taken_out_of_jax_has_all_digits():
    class ByFloat(Weibull):
        def moment(self, order):
            return float(self.scale**order * jnp.exp(gammaln(1 + order / self.shape)))

    assert ByFloat(1.0, 2.5).moment(2) == pytest.approx(gamma(1 + 2 / 2.5), rel=1e-14)


@pytest.mark.slow
def test_the_shape_of_a_law_in_jax_is_fitted():
    def network(shape):
        return hg.Network(PLANT, {"node": hg.Node(SENSOR, hg.hop(Weibull(1.0, shape), 0.05), {})})

    z = hg.simulate(network(2.5), horizon=400, key=2).measurements["node"]
    found = hg.fit(lambda: network(hg.free(1.5, "shape", "positive")), {"node": z}, starts=2)
    row = found.rows(form="linear", method="hessian")[0]
    assert row.low < 2.5 < row.high
