"""What is no number in a filter's state shows in all that depends on it, and in nothing else."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

RANDOM = np.random.default_rng(0)


def estimates(item, z):
    """Means and covariances of a filter of one recording."""

    def step(state, row):
        state, estimate = item.step(state, row)
        return state, (estimate.mean, estimate.covariance)

    return jax.lax.scan(step, jax.tree.map(jnp.asarray, item.init()), z)[1]


# Two states of which neither depends on the other, a sensor of the first: x1 is lost, x0 is not.
APART = np.diag([0.9, 3.0])
FIRST = hg.LinearSensor([[1.0, 0.0]], 0.1)


@pytest.mark.slow
def test_a_state_that_grows_beyond_all_numbers_spoils_no_other():
    """3^1000 is more than a number may be; the measured state beside it is followed as if it were alone.

    Up to where the variance, 3^(2 k), is none either: then the factors of the covariance are none.
    """
    plant, alone = (hg.LinearPlant(APART[:n, :n], 0.1 * np.eye(n), np.ones(n), np.eye(n)) for n in (2, 1))

    def followed(plant, sensor, measurements):
        return hg.simulation.over_runs(lambda z: estimates(hg.kalman_filter(plant, sensor), z)[0], measurements)

    z = RANDOM.normal(size=(3, 1000, 1))
    z[1, 500] = np.nan  # and one that did not arrive
    means = followed(plant, FIRST, z)
    assert not np.isfinite(means[:, -1, 1]).any()
    expected = followed(alone, hg.LinearSensor([[1.0]], 0.1), z)[..., 0]
    np.testing.assert_allclose(means[:, :320, 0], expected[:, :320], rtol=1e-12)


def nan_beyond_two(x, u):
    return jnp.stack([0.9 * x[0] + 0.1 * x[1], jnp.where(x[1] > 2, jnp.nan, 0.8 * x[1]), 0.7 * x[2]])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "is_claimed"),
    [(hg.extended_filter, True), (hg.cubature_filter, False), (hg.unscented_filter, False)],
)
def test_what_a_users_function_spoils_stays_visible(make, is_claimed):
    """A state that is no number from the first step on: in itself, its variance, and the state that it moves.

    The extended filter's variance is by the derivative of f, which JAX says to be 0 where f is no number.
    """
    plant = hg.Plant(nan_beyond_two, 0.1 * np.eye(3), [1.0, 5.0, 1.0], 0.01 * np.eye(3))
    sensor = hg.LinearSensor([[0.0, 0.0, 1.0]], 0.1)
    item = make(plant, sensor, hg.perfect())
    mean, covariance = hg.simulation.over_runs(lambda z: estimates(item, z), np.ones((2, 3, 1)))
    assert np.isnan(mean[:, 0, 1]).all() and np.isnan(mean[:, 1:, :2]).all()
    spoilt = np.isnan(covariance[:, 0, 1, 1]) & np.isnan(covariance[:, 1:, 0, 0]).all(axis=1)
    assert (spoilt != is_claimed).all()
    with pytest.raises(ValueError, match="no finite number"):
        hg.Stream(item).push([1.0])
