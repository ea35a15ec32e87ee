"""The best linear filter of plants and sensors with modes: all paths of modes, published numbers, what is refused."""

from itertools import pairwise, product

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modes.test_modes_of_motion import LINK, MATRICES, NOISES, ROWS, SENSOR, motion

SHIFTS, INPUTS = [np.array([0.1, 0.2]), np.array([-0.3, 0.0])], [np.array([[0.3], [0.5]]), np.array([[0.0], [-1.0]])]
FAR, SPREAD, LAW = np.array([50.0, -0.5]), np.array([[1.0, 0.3], [0.3, 2.0]]), np.array([0.4, 0.6])
SENSES, NOISE, BIAS = np.array([[1.0, 0.0], [0.0, 0.2]]), [1.0, 0.5], [0.1, -0.4]
CHAIN, FIRST = np.array([[0.9, 0.1], [0.3, 0.7]]), np.array([0.7, 0.3])
STEPS, LOST = 3, 1
draw = np.random.default_rng(0)
U, Z = draw.normal(size=(STEPS, 1)), draw.normal(size=(STEPS, 1))
Z[LOST] = np.nan


def system():
    plants = [
        hg.LinearPlant(F, hg.Gaussian(Q, mean), FAR, SPREAD, input_matrix=B)
        for F, Q, mean, B in zip(MATRICES, NOISES, SHIFTS, INPUTS, strict=True)
    ]
    sensors = [hg.LinearSensor([h], hg.Gaussian([[r]], [v])) for h, r, v in zip(SENSES, NOISE, BIAS, strict=True)]
    return hg.markov_plant(plants, ROWS, LAW), hg.markov_sensor(sensors, CHAIN, FIRST)


def paths(law, rows):
    for path in product(range(2), repeat=STEPS):
        yield path, law[path[0]] * np.prod([rows[i, j] for i, j in pairwise(path)])


def moments_over_all_paths():
    """Mean and covariance of (x_1 .. x_N, z_1 .. z_N): those of each path of modes, mixed."""
    n, size = 2, 2 * STEPS
    mean, second = np.zeros(size + STEPS), np.zeros((size + STEPS,) * 2)
    for path, weight in paths(LAW, ROWS):
        m, root, means, roots = FAR, np.eye(n, n * (STEPS + 1)), [], []
        for k, j in enumerate(path):
            m, root = MATRICES[j] @ m + INPUTS[j] @ U[k] + SHIFTS[j], MATRICES[j] @ root
            root = root + np.eye(n, root.shape[1], n * (k + 1))
            means, roots = [*means, m], [*roots, root]
        noise = np.zeros((n * (STEPS + 1),) * 2)
        for k, own in enumerate([SPREAD, *(NOISES[j] for j in path)]):
            noise[n * k : n * k + n, n * k : n * k + n] = own
        for seen, share in paths(FIRST, CHAIN):
            read = np.kron(np.eye(STEPS), np.ones((1, n))) * SENSES[list(seen)].ravel()
            both = np.vstack([np.eye(size), read])
            a = both @ np.concatenate(means) + np.append(np.zeros(size), np.take(BIAS, seen))
            P = both @ np.vstack(roots) @ noise @ np.vstack(roots).T @ both.T
            P = P + np.diag(np.append(np.zeros(size), np.take(NOISE, seen)))
            mean, second = mean + weight * share * a, second + weight * share * (P + np.outer(a, a))
    return mean, second - np.outer(mean, mean)


def best_linear(mean, covariance, k, rows):
    """Mean and covariance of x_k given these rows of z, by the joint moments alone."""
    x, z = [2 * k, 2 * k + 1], [2 * STEPS + i for i in rows if i != LOST]
    gain = np.linalg.solve(covariance[np.ix_(z, z)], covariance[np.ix_(z, x)]).T
    given = mean[x] + gain @ (np.concatenate([np.zeros(2 * STEPS), Z[:, 0]]) - mean)[z]
    return given, covariance[np.ix_(x, x)] - gain @ covariance[np.ix_(z, x)]


def judge(result, rows_at):
    """Compare with all paths: means of 50 and second moments of 2,500 leave 1e-13 of themselves."""
    moments = moments_over_all_paths()
    for k in range(STEPS):
        mean, covariance = best_linear(*moments, k, rows_at(k))
        np.testing.assert_allclose(result.means[k], mean, atol=1e-10)
        np.testing.assert_allclose(result.covariances[k], covariance, atol=1e-10)


def test_it_is_the_best_linear_estimate_over_all_paths():
    """Of inputs, means of noise and a mean far off in each mode, chains of plant and sensor, and a row that is lost."""
    filter = hg.linear_filter(*system(), LINK)
    assert filter.claim == "exact"
    judge(filter.run(Z, U), lambda k: range(k + 1))


@pytest.mark.slow
def test_smoothed_it_is_the_best_linear_estimate_over_all_paths():
    smoothed = hg.rts_smoother(hg.linear_filter(*system(), LINK), Z, U)
    assert smoothed.claim == "exact"
    judge(smoothed, lambda k: range(STEPS))


def test_the_claim_of_two_laws_of_motion_is_the_published_one():
    filter = hg.linear_filter(motion(), SENSOR, LINK)
    claimed = np.diagonal(filter.run(np.zeros((60, 1))).covariances[-1])
    np.testing.assert_allclose(claimed, [0.69087, 0.72531], atol=5e-6)  # as it is printed
    assert filter.run(np.zeros((2, 1))).modes is None  # its indicators are no probabilities


def test_an_input_of_one_mode_is_noise_with_memory():
    """An input that acts in the first mode alone: by the modes' law alone the velocity would claim -.57."""
    G = np.array([0.5, 1.0])
    laws = [
        hg.LinearPlant(F, hg.Gaussian(Q, shift), [0.0, 0.0], np.eye(2))
        for F, Q, shift in zip(MATRICES, NOISES, (G, 0 * G), strict=True)
    ]
    filter = hg.linear_filter(hg.markov_plant(laws, ROWS, [0.5, 0.5]), SENSOR, LINK)
    velocity = filter.run(np.zeros((10, 1))).covariances[-1, 1, 1]
    np.testing.assert_allclose(velocity, 1.7286, atol=5e-5)  # as it is printed


def test_where_modes_differ_in_what_acts_on_a_growing_state_its_covariance_grows():
    """A random walk whose sensor gets stuck at 0: E[x^2] grows without bound, and with it the noise of H x."""
    walk = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0)
    sensors = [hg.LinearSensor([[1.0]], 0.5), hg.LinearSensor([[0.0]], 0.5)]
    sensor = hg.markov_sensor(sensors, [[0.97, 0.03], [0.3, 0.7]], [1.0, 0.0])
    variances = hg.linear_filter(walk, sensor, LINK).run(np.zeros((400, 1))).covariances[:, 0, 0]
    np.testing.assert_allclose(variances[[9, 49, 399]], [0.278, 0.442, 1.233], atol=5e-4)  # as they are printed


def test_a_world_of_the_same_chain_keeps_the_claim():
    plant = motion()
    network = hg.Network(plant, {"node": hg.Node(SENSOR, LINK, {"f": hg.linear_filter(plant, SENSOR, LINK)})})
    assert network.claims()["node"] == {"f": "exact"}


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda plant: hg.linear_filter(plant, SENSOR, hg.erasure(LINK, 0.9)), "without losses where plant or sensor"),
        (lambda plant: hg.linear_filter(plant, SENSOR, hg.markov_fading(
            [1.0, 0.5], hg.random_affine.MarkovChain(ROWS, LAW, radius=0.01), noise=0.1)), "a radius of uncertainty"),
        (lambda plant: hg.filters.memoryless_filter(plant, SENSOR, LINK), "of one law .hg.linear_filter"),
        (lambda plant: hg.kalman_filter(plant, SENSOR), "of one law .hg.linear_filter"),
        (lambda plant: hg.linear_filter(
            hg.markov_plant([hg.Plant(lambda x, u: x, 1.0, [0.0], 1.0)] * 2, ROWS),
            hg.LinearSensor([[1.0]], 1.0), LINK), "expected a LinearPlant and a LinearSensor, got Plant"),
    ],
)  # fmt: skip
def test_what_it_cannot_say_is_refused_in_one_line(build, said):
    with pytest.raises(ValueError, match=said) as error:
        build(motion())
    assert "\n" not in str(error.value)


def test_a_plant_of_modes_takes_inputs_and_names_the_law_that_has_no_covariance_for_them():
    laws = [hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, input_matrix=[[1.0]], inputs=["force"])] * 2
    laws[1] = hg.LinearPlant([[1.0]], lambda u: u[:1, None], [0.0], 1.0, input_matrix=[[1.0]], inputs=["force"])
    filter = hg.filters.imm_filter(hg.markov_plant(laws, ROWS), hg.LinearSensor([[1.0]], 1.0), LINK)
    assert np.isfinite(filter.run(np.ones((2, 1)), np.ones((2, 1))).means).all()
    with pytest.raises(ValueError, match=r"process noise covariance\(u\): expected a covariance"):
        filter.run(np.ones((2, 1)), [[1.0], [-1.0]])
