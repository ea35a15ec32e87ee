"""Traced programs draw the same from keys with the written-out hash, and keep theirs where they cannot take them."""

import jax
import numpy as np

import heliograph as hg
from heliograph.simulation.hashing import evaluated, written_out


def traced(function):
    return jax.make_jaxpr(function)(jax.random.key(0))


def test_a_traced_program_draws_the_same():
    def draws(key):
        first, second = jax.random.split(key)
        return jax.random.normal(first, (3,)) * 2, jax.random.rayleigh(second, 0.5)

    program = traced(draws)
    key = jax.random.key(7)
    taken = written_out(key, [program])
    assert jax.random.key_impl(taken) != jax.random.key_impl(key)
    for one, other in zip(jax.jit(draws)(key), jax.jit(evaluated(program))(taken), strict=True):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))


def test_ordinary_keys_stay_where_a_loop_holds_them():
    """Poisson numbers are drawn in a loop that JAX writes for its own keys alone."""
    key = jax.random.key(7)
    assert written_out(key, [traced(lambda key: jax.random.poisson(key, 3.0))]) is key


def test_keys_of_another_hash_stay():
    key = jax.random.key(7, impl="rbg")
    assert written_out(key, [traced(lambda key: jax.random.normal(key))]) is key


class Counted(hg.random_affine.AbstractNoise):
    """Poisson counts about their mean."""

    rate: float

    @property
    def dimension(self):
        return 1

    @property
    def mean(self):
        return np.zeros(1)

    @property
    def covariance(self):
        return np.array([[self.rate]])

    def sample(self, key):
        return jax.random.poisson(key, self.rate, (1,)) - self.rate

    def moment(self, powers):
        return {1: 0.0, 2: self.rate, 3: self.rate}[powers[0]]


def test_a_noise_of_counts_is_simulated():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
    sensor = hg.LinearSensor([[1.0]], Counted(4.0))
    node = hg.Node(sensor, hg.perfect(1), {"kalman": hg.kalman_filter(plant, sensor)})
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), 20, 64, 0)
    heard = record.measurements["a"][:, :, 0] - np.asarray(record.truth)[:, :, 0]
    np.testing.assert_allclose(heard + 4.0, np.round(heard + 4.0), atol=1e-12)  # whole numbers, to rounding
    assert abs(heard.mean()) < 4 * 2 / np.sqrt(heard.size)  # four standard errors, the deviation being 2
