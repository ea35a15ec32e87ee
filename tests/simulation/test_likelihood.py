"""A run's likelihood: the textbook's for a linear Gaussian system, and its gradient."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

import heliograph as hg

A, B = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.5], [1.0]])
C, Q, R = np.array([[1.0, 0.0], [0.5, 1.0]]), np.array([[0.3, 0.1], [0.1, 0.2]]), np.diag([0.2, 0.4])
START, SPREAD = np.array([1.0, -0.5]), np.array([[0.5, 0.1], [0.1, 0.4]])
PLANT, SENSOR = hg.LinearPlant(A, Q, START, SPREAD, B), hg.LinearSensor(C, R)
STEPS = 6
INPUTS = np.linspace(-1, 1, STEPS)[:, None]


def data(holes):
    z = np.random.default_rng(0).normal(size=(STEPS, 2))
    if holes:
        z[1, 0] = z[3] = z[4, 1] = np.nan
    return z


def stacked():
    """Mean and covariance of (z_1 ... z_T) together."""
    mean, spread, means, states = START, SPREAD, [], []
    cross = np.zeros((0, 2))  # of all earlier states with the last
    joint = np.zeros((0, 0))
    for u in INPUTS:
        mean, cross = A @ mean + B @ u, (np.concatenate([cross, spread]) if states else np.zeros((0, 2))) @ A.T
        spread = A @ spread @ A.T + Q
        states.append(spread)
        means.append(C @ mean)
        joint = np.block([[joint, cross], [cross.T, spread]])
    read = np.kron(np.eye(STEPS), C)
    return np.concatenate(means), read @ joint @ read.T + np.kron(np.eye(STEPS), R)


@pytest.mark.parametrize("holes", [False, True])
def test_it_is_the_density_of_all_measurements_together(holes):
    z, (mean, covariance) = data(holes), stacked()
    here = ~np.isnan(z).ravel()
    expected = stats.multivariate_normal(mean[here], covariance[np.ix_(here, here)]).logpdf(z.ravel()[here])
    perfect = hg.perfect(2)
    for item in (hg.kalman_filter(PLANT, SENSOR), hg.linear_filter(PLANT, SENSOR, perfect)):
        assert hg.log_likelihood(item, z, INPUTS) == pytest.approx(expected, rel=1e-10)
    if not holes:
        planned = hg.kalman_filter(PLANT, SENSOR).planned(INPUTS)
        assert hg.log_likelihood(planned, z, INPUTS) == pytest.approx(expected, rel=1e-10)


def test_nodes_one_after_another_are_the_nodes_together():
    rows = [hg.LinearSensor(C[[i]], R[i, i]) for i in range(2)]
    apart = hg.filters.sequential_filter([hg.kalman_filter(PLANT, row) for row in rows])
    together = hg.kalman_filter(PLANT, SENSOR)
    result, expected = (hg.log_likelihood(item, data(True), INPUTS) for item in (apart, together))
    assert result == pytest.approx(expected, rel=1e-12)


def test_a_mixtures_likelihood_is_that_of_its_sum():
    plant, sensor = hg.LinearPlant([[1.0]], 0.3, [0.4], 0.5), hg.LinearSensor([[2.0]], 0.1)
    channel = hg.hop(hg.Discrete([0.5, 1.0], [0.3, 0.7]), 0.2)
    z, variance = 1.3, 4 * 0.8 + 0.1
    parts = [p * stats.norm.pdf(z, g * 0.8, np.sqrt(g**2 * variance + 0.2)) for p, g in ((0.3, 0.5), (0.7, 1.0))]
    likelihood = hg.log_likelihood(hg.filters.mixture_filter(plant, sensor, channel), [z])
    assert likelihood == pytest.approx(np.log(sum(parts)), rel=1e-12)


BEHIND = hg.hop(hg.Rayleigh(0.8), 0.1, dimension=2)
FILTERS = {
    "kalman": lambda plant: hg.kalman_filter(plant, SENSOR),
    "linear": lambda plant: hg.linear_filter(plant, SENSOR, BEHIND),
    "cubature": lambda plant: hg.cubature_filter(plant, SENSOR, BEHIND),
}


def likelihood_by(name):
    """Return the log-likelihood of rows by a filter, as a function of the plant's Q."""
    return lambda q, z: hg.log_likelihood(FILTERS[name](hg.LinearPlant(A, q, START, SPREAD, B)), z, INPUTS)


def by_jit(function, *arguments):
    """As `over_runs`, by JAX's compiler."""
    with jax.enable_x64(True):
        return np.asarray(jax.jit(jax.vmap(function))(*arguments))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "over"), list(zip(FILTERS, (by_jit, hg.simulation.over_runs, hg.simulation.over_runs), strict=True))
)
def test_gradients_are_finite_differences(name, over):
    """By either engine."""
    likelihood, step = likelihood_by(name), 1e-5
    both = np.stack([data(False), data(True)])
    for z, gradient in zip(both, over(jax.grad(likelihood), np.stack([Q, Q]), both), strict=True):
        for direction in (np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])):
            difference = (likelihood(Q + step * direction, z) - likelihood(Q - step * direction, z)) / (2 * step)
            assert abs(difference) > 0.01  # Q matters
            assert np.sum(gradient * direction) == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_traced_covariance_put_into_a_filter_takes_its_factor_along(name):
    """To roundings of another factor of the same covariance."""
    item, likelihood = FILTERS[name](PLANT), likelihood_by(name)

    def put(q, z):
        return hg.log_likelihood(eqx.tree_at(lambda f: f.plant.noise.covariance, item, q), z, INPUTS)

    with jax.enable_x64(True):
        value, slope = jax.jit(jax.value_and_grad(put))(2 * Q, data(True))
        expected, expected_slope = jax.jit(jax.value_and_grad(likelihood))(2 * Q, data(True))
    assert float(value) == pytest.approx(float(expected), rel=1e-13)
    # In the space of symmetric matrices: the entries above the diagonal are not told from those below.
    np.testing.assert_allclose(slope + slope.T, expected_slope + expected_slope.T, rtol=1e-11)


@pytest.mark.parametrize(
    ("measurements", "inputs", "message"),
    [
        (np.zeros((STEPS, 3)), INPUTS, r"measurements: expected shape \(rows, 2\), got shape \(6, 3\)"),
        (np.full((STEPS, 2), np.inf), INPUTS, "measurements: expected finite numbers"),
        (data(True), None, r"inputs: expected shape \(6, 1\)"),
        (data(True), np.full((STEPS, 1), np.nan), "inputs: expected finite numbers"),
        ("abc", INPUTS, "measurements: expected an array of numbers"),
    ],
)
def test_what_does_not_fit_is_refused(measurements, inputs, message):
    with pytest.raises(ValueError, match=message):
        hg.log_likelihood(hg.kalman_filter(PLANT, SENSOR), measurements, inputs)
