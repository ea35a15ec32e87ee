"""Particles of some states with a Gaussian of the others: against exact filters, all mode paths, and what cannot be."""

from itertools import pairwise, product

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.filters.particles.test_state_particles import PLANT, SENSOR, curved, heading, rows

CHAIN, INITIAL = np.array([[0.9, 0.1], [0.2, 0.8]]), np.array([0.6, 0.4])
MATRICES = np.array([[[1.0, 1.0], [0.0, 0.95]], [[1.0, 1.0], [0.0, 0.5]]])
NOISES = np.array([0.01, 1.0])[:, None, None] * np.outer([0.5, 1.0], [0.5, 1.0])  # singular
LAWS = [hg.LinearPlant(F, Q, [0.0, 0.0], np.eye(2), states=["x", "v"]) for F, Q in zip(MATRICES, NOISES, strict=True)]
MOTION = hg.markov_plant(LAWS, CHAIN, initial=INITIAL)
Z = np.array([[0.3], [np.nan], [1.9], [2.2]])


def by_all_paths(z, variance=0.5):
    """Return mean, covariance, P(mode) and log-likelihood after all rows, by a Kalman filter for each path of modes."""
    means, covariances, weights = [], [], []
    last = []
    for path in product(range(2), repeat=len(z)):
        m, P, log_weight = np.zeros(2), np.eye(2), np.log(INITIAL[path[0]])
        log_weight += sum(np.log(CHAIN[i, j]) for i, j in pairwise(path))
        for j, row in zip(path, z[:, 0], strict=True):
            m, P = MATRICES[j] @ m, MATRICES[j] @ P @ MATRICES[j].T + NOISES[j]
            if not np.isnan(row):
                s = P[0, 0] + variance
                log_weight -= ((row - m[0]) ** 2 / s + np.log(2 * np.pi * s)) / 2
                m, P = m + P[:, 0] * (row - m[0]) / s, P - np.outer(P[:, 0], P[0]) / s
        means, covariances, weights = [*means, m], [*covariances, P], [*weights, log_weight]
        last.append(path[-1])
    total = np.log(np.sum(np.exp(weights)))
    weights = np.exp(weights - total)
    mean = weights @ np.array(means)
    apart = np.array(means) - mean
    covariance = np.einsum("i,ijk->jk", weights, covariances) + np.einsum("i,ij,ik->jk", weights, apart, apart)
    return mean, covariance, np.bincount(last, weights), total


@pytest.mark.slow
@pytest.mark.parametrize("drawn", [[], ["v"], None])
def test_modes_of_motion_are_those_of_all_paths(drawn):
    mean, covariance, modes, total = by_all_paths(Z)
    parts = MOTION, hg.LinearSensor([[1.0, 0.0]], 0.5), hg.perfect(), 4000
    runs = [hg.filters.particle_filter(*parts, seed=seed, drawn=drawn).run(Z) for seed in range(6)]
    # Of 4,000 particles 1,600 count at the third row: of one seed a mean errs by .02 deviations, a second moment by
    # .04, a probability by .008 and log p by .025, as 24 seeds tell; of six by root 6 less. Five of those or more.
    apart = np.mean([run.means[-1] for run in runs], axis=0) - mean
    assert np.all(np.abs(apart) < 0.045 * np.sqrt(np.diagonal(covariance)))
    scale = np.sqrt(np.outer(np.diagonal(covariance), np.diagonal(covariance)))
    assert np.all(np.abs(np.mean([run.covariances[-1] for run in runs], axis=0) - covariance) < 0.09 * scale)
    assert np.all(np.abs(np.mean([run.modes[-1] for run in runs], axis=0) - modes) < 0.018)
    assert abs(np.mean([run.log_likelihood for run in runs]) - total) < 0.05


def test_modes_are_summed_before_one_is_drawn():
    # At the first row every particle has the same past, and the weight of all modes, states and noises: none is drawn.
    filter = hg.filters.particle_filter(MOTION, hg.LinearSensor([[1.0, 0.0]], 0.5), hg.perfect(), 12, drawn=[])
    run = filter.run(Z[:1])
    assert run.log_likelihood == pytest.approx(by_all_paths(Z[:1])[3], abs=1e-12)
    assert run.effective_numbers[0] == pytest.approx(12)


def test_nothing_drawn_of_one_law_is_the_kalman_filter():
    z = rows(8)
    got = hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(), 12, drawn=[]).run(z)
    right = hg.kalman_filter(PLANT, SENSOR).run(z)
    np.testing.assert_allclose(got.means, right.means, atol=1e-12)
    np.testing.assert_allclose(got.covariances, right.covariances, atol=1e-12)
    np.testing.assert_allclose(got.log_likelihoods, right.log_likelihoods, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["optimal", "prior"])
@pytest.mark.parametrize("drawn", [["x0"], ["x1"]])
def test_one_drawn_state_tends_to_the_kalman_filter(drawn, proposal):
    z = rows(8)
    got = hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(), 4000, proposal=proposal, drawn=drawn).run(z)
    right = hg.kalman_filter(PLANT, SENSOR).run(z)
    deviation = np.sqrt(np.diagonal(right.covariances, axis1=1, axis2=2))
    # 4,000 particles of which 1,000 count: .032 deviations; four of those.
    assert np.max(np.abs(got.means - right.means) / deviation) < 0.13
    assert abs(got.log_likelihood - right.log_likelihood) < 0.2


@pytest.mark.slow
def test_a_curved_state_with_a_linear_one_has_the_moments_of_particles_of_both():
    # h is curved in s and linear in b given it; a gain of two atoms, and a row that did not arrive.
    def move(x, u):
        return jnp.stack([0.9 * x[0] + jnp.sin(x[0]), 0.8 * x[1] + 0.3 * x[0] ** 2 + 0.2 * x[0] * x[1]])

    plant = hg.Plant(move, np.array([[0.25, 0.05], [0.05, 0.1]]), [0.5, 0.0], np.eye(2), states=["s", "b"])
    sensor = hg.Sensor(lambda x: jnp.stack([x[0] ** 2 / 3 + x[1], jnp.cos(x[0]) * x[1]]), 0.3 * np.eye(2))
    link = hg.hop(hg.Discrete([0.6, 1.0], [0.3, 0.7]), 0.05 * np.eye(2))
    z = np.array([[0.4, 0.1], [np.nan, 0.3], [0.9, -0.2], [1.5, 0.5]])
    partly = hg.filters.particle_filter(plant, sensor, link, 6000, drawn=["s"]).run(z)
    whole = hg.filters.particle_filter(plant, sensor, link, 20_000, seed=1, proposal="prior").run(z)
    deviation = np.sqrt(np.diagonal(whole.covariances, axis1=1, axis2=2))
    # Some 2,000 of the first and 3,000 of the second count: .029 deviations together; four, and moments root 2 more.
    assert np.max(np.abs(partly.means - whole.means) / deviation) < 0.12
    scale = deviation[:, :, None] * deviation[:, None]
    assert np.max(np.abs(partly.covariances - whole.covariances) / scale) < 0.17
    assert abs(partly.log_likelihood - whole.log_likelihood) < 0.12


@pytest.mark.slow
def test_an_angle_that_is_drawn_leaves_a_gaussian_of_the_rest():
    filter = hg.filters.particle_filter(*heading(), hg.perfect(), 2000, drawn=["yaw"])
    run = filter.run(np.ones((5, 1)))
    # The speed is that of a Kalman filter whatever the heading is, to rounding: no particle says more than another.
    speed = hg.kalman_filter(hg.LinearPlant([[1.0]], 1e-6, [1.0], [[1e-4]]), hg.LinearSensor([[1.0]], 1e-4))
    right = speed.run(np.ones((5, 1)))
    np.testing.assert_allclose(run.covariances[:, 3, 3], right.covariances[:, 0, 0], rtol=1e-9)
    assert run.log_likelihood == pytest.approx(right.log_likelihood, rel=1e-9)
    assert abs(np.sqrt(run.covariances[-1, 2, 2]) - 1.66) < 0.08  # 2 rad on the circle; three deviations of 2,000 draws


@pytest.mark.slow
def test_a_heading_that_nothing_measures_is_right_with_the_heading_drawn():
    parts = (*heading(), hg.perfect())  # the same functions for all keys: one program
    runs = [
        hg.filters.particle_filter(*parts, 3000, seed=key, drawn=["yaw"]).run(np.ones((600, 1))) for key in range(10)
    ]
    means = np.array([run.means[-1, 0] for run in runs])
    # x is +- 41.65 by the heading alone: of 3,000 draws .76 between keys, of ten keys .24; a deviation of ten keys
    # is within half of itself.
    assert abs(means.mean() - 8.12) < 0.8 and means.std(ddof=1) < 1.15
    assert abs(np.sqrt(np.mean([run.covariances[-1, 0, 0] for run in runs])) - 41.65) < 0.5
    assert abs(np.sqrt(np.mean([run.covariances[-1, 1, 1] for run in runs])) - 42.4) < 0.5


@pytest.mark.slow
def test_modes_of_a_link_and_its_losses_are_counted():
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
    link = hg.random_affine.Modes(chain, [hg.erasure(hg.hop(1.0, 0.1), 0.95), hg.erasure(hg.hop(0.2, 0.1), 0.5)])
    z = np.array([[0.3], [np.nan], [np.nan], [0.9], [0.1]])
    partly = hg.filters.particle_filter(PLANT, SENSOR, link, 4000, drawn=[])
    modes_alone = hg.filters.particle_filter(PLANT, SENSOR, link, 6000)
    got, right = partly.run(z), modes_alone.run(z)
    deviation = np.sqrt(np.diagonal(right.covariances, axis1=1, axis2=2))
    assert np.max(np.abs(got.means - right.means) / deviation) < 0.07  # two Monte Carlos of some .012 each; four
    assert abs(got.log_likelihood - right.log_likelihood) < 0.06


@pytest.mark.slow
def test_it_runs_in_a_network_with_a_sensor_that_gets_stuck():
    stuck = hg.LinearSensor([[0.0, 0.0]], 0.1)
    sensor = hg.markov_sensor([hg.LinearSensor([[1.0, 0.0]], 0.5), stuck], [[0.95, 0.05], [0.3, 0.7]])
    filters = {"particles": hg.filters.particle_filter(MOTION, sensor, hg.perfect(), 60, drawn=[])}
    network = hg.Network(MOTION, {"node": hg.Node(sensor, hg.perfect(), filters)})
    record = hg.monte_carlo(network, horizon=5, runs=3, key=0)
    modes = record.estimates["node"]["particles"].modes
    assert modes.shape == (3, 5, 4)
    np.testing.assert_allclose(modes.sum(axis=-1), 1, rtol=1e-12)


def test_a_row_that_no_particle_explains_is_not_used():
    plant = hg.Plant(lambda x, u: jnp.stack([x[0], x[1] + x[0]]), 0.1 * np.eye(2), [1.0, 0.0], 0.1 * np.eye(2))
    sensor = hg.Sensor(lambda x: jnp.sqrt(x[:1] - 50) + x[1:], 0.1)  # no number where the particles are
    filter = hg.filters.particle_filter(plant, sensor, hg.perfect(), 12, drawn=["x0"])
    state = filter.predict(filter.init())
    after, innovation = filter.correct(state, [1.0])
    np.testing.assert_array_equal(after.gaussian.mean, state.gaussian.mean)
    np.testing.assert_array_equal(after.weight, state.weight)
    assert innovation.log_likelihood == -np.inf


@pytest.mark.parametrize(
    ("parts", "drawn", "said"),
    [
        (heading(), ["v"], r"drawn: expected all states that are angles, got \['yaw'\] not drawn"),
        (heading(), ["heading"], "drawn: expected some of"),
        (curved(0.1), [], r"drawn: expected states given which the plant is linear in \['x0'\]"),
        ((PLANT, hg.Sensor(lambda x: x[:1] * x[1:], 0.1)), [], r"which the sensor is linear in \['x0', 'x1'\]"),
    ],
)
def test_what_is_not_linear_given_the_drawn_states_is_refused_in_one_line(parts, drawn, said):
    with pytest.raises(ValueError, match=said) as error:
        hg.filters.particle_filter(*parts, hg.perfect(), drawn=drawn)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("function", "linear"),
    [
        (lambda x: jnp.stack([x[0] * jnp.exp(x[2]), x[1] / (1 + x[2] ** 2)]), True),
        (lambda x: jnp.where(x[2] > 0, x[:2], -x[:2]), True),
        (lambda x: (np.array([[0.0, 0.0, 1.0]]) @ x) ** 2 * x[0], True),  # a known zero is structure
        (lambda x: jnp.where(x[0] > 0, x[:2], -x[:2]), False),
        (lambda x: x[:1] * x[1:2], False),
        (lambda x: jnp.round(x), False),
        (lambda x: x[2:] / x[:1], False),
    ],
)
def test_linear_given_the_third_state(function, linear):
    plant = hg.LinearPlant(np.eye(3), np.eye(3), np.zeros(3), np.eye(3), states=["a", "b", "c"])
    size = len(function(np.ones(3)))
    parts = plant, hg.Sensor(function, np.eye(size)), hg.perfect(size), 2
    if linear:
        hg.filters.particle_filter(*parts, drawn=["c"])
        return
    with pytest.raises(ValueError, match="the sensor is linear"):
        hg.filters.particle_filter(*parts, drawn=["c"])
