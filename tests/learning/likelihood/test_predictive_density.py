import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

import heliograph as hg
from heliograph.learning.likelihood.predictive_density import approximate_law_by_nodes
from heliograph.random_affine import AbstractLaw

SIGNAL = (np.array([[2.0]]), np.array([[[0.5]]]))
PAIR = (np.array([[2.0, -1.0]]), np.array([[[0.5, 0.2], [0.2, 0.4]]]))
PLANT = hg.Plant(lambda x, u: 3 + 0.9 * (x - 3), 0.2, [3.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.1)


def predicted(signal, channel, z):
    """Density of what comes of a signal with this mean and covariance, at the first step."""
    (mean,), (covariance,) = signal
    n = len(mean)
    plant = hg.LinearPlant(np.eye(n), np.zeros((n, n)), mean, covariance)
    return hg.learning.predictive(plant, hg.LinearSensor(np.eye(n), np.zeros((n, n))), channel, z, nodes=64)


class Uniform(AbstractLaw):
    """A law of one's own, on [0, 2]."""

    def sample(self, key):
        return 2 * jax.random.uniform(key, dtype=float)

    def moment(self, order):
        return 2.0**order / (order + 1)


@pytest.mark.parametrize(
    ("law", "tolerance"),
    [
        (hg.Rayleigh(0.8), 1e-6),  # of the tails beyond 5.5 standard deviations of the normal score
        (hg.random_affine.LogNormal(-0.1, 0.4), 1e-5),
        (hg.random_affine.Rician(1.0, 0.3), 1e-6),
        (hg.random_affine.Nakagami(0.7, 1.3), 1e-6),
        (hg.Discrete([0.8, 1.2], [0.3, 0.7]), 1e-14),
        (Uniform(), 0.05),  # of 16,384 draws
    ],
    ids=lambda item: type(item).__name__,
)
def test_nodes_have_the_laws_moments(law, tolerance):
    nodes = approximate_law_by_nodes(law, 64)
    for order in (1, 2, 3):
        assert nodes.moment(order) == pytest.approx(float(law.moment(order)), rel=tolerance)


def test_density_and_pit_of_one_hop_are_the_mixtures():
    channel, z = hg.hop(hg.Discrete([0.5, 1.0], [0.25, 0.75]), 0.3), np.array([[1.4]])
    result = predicted(SIGNAL, channel, z)
    parts = [(0.25, norm(1.0, np.sqrt(0.25 * 0.5 + 0.3))), (0.75, norm(2.0, np.sqrt(0.5 + 0.3)))]
    assert result.log_likelihood[0] == pytest.approx(np.log(sum(w * item.pdf(1.4) for w, item in parts)), rel=1e-13)
    assert result.pit[0, 0] == pytest.approx(sum(w * item.cdf(1.4) for w, item in parts), rel=1e-13)


def test_a_common_gain_ties_its_outputs():
    """Two outputs of one gain: the joint density by integrating over the gain, pit of the second given the first."""
    channel, z = hg.hop(hg.Discrete([0.5, 1.0], [0.4, 0.6]), 0.3 * np.eye(2)), np.array([[1.4, -0.2]])
    result = predicted(PAIR, channel, z)
    total, first, below = 0.0, 0.0, 0.0
    for w, g in ((0.4, 0.5), (0.6, 1.0)):
        mean, cov = g * PAIR[0][0], g**2 * PAIR[1][0] + 0.3 * np.eye(2)
        item = w * norm(mean[0], np.sqrt(cov[0, 0])).pdf(1.4)
        given = norm(mean[1] + cov[1, 0] / cov[0, 0] * (1.4 - mean[0]), np.sqrt(cov[1, 1] - cov[1, 0] ** 2 / cov[0, 0]))
        total, first, below = total + item * given.pdf(-0.2), first + item, below + item * given.cdf(-0.2)
    assert result.log_likelihood[0] == pytest.approx(np.log(total), rel=1e-12)
    assert result.pit[0, 1] == pytest.approx(below / first, rel=1e-12)


def test_parts_of_a_stack_are_received_one_after_another():
    """With known gains the chain of parts is exact: the density of the pair, whichever is missing."""
    channel = hg.parallel([hg.hop(0.8, 0.1), hg.hop(1.2, 0.2)])
    gain, noise = np.diag([0.8, 1.2]), np.diag([0.1, 0.2])
    cov, error = gain @ PAIR[1][0] @ gain.T + noise, np.array([1.4, -0.2]) - gain @ PAIR[0][0]
    for missing in ([], [0], [1], [0, 1]):
        z, there = np.array([[1.4, -0.2]]), np.setdiff1d([0, 1], missing)
        z[0, missing] = np.nan
        local, e = cov[np.ix_(there, there)], error[there]
        expected = -(e @ np.linalg.solve(local, e) + np.linalg.slogdet(2 * np.pi * local)[1]) / 2 if len(there) else 0.0
        result = predicted(PAIR, channel, z)
        assert result.log_likelihood[0] == pytest.approx(expected, rel=1e-13)
        assert np.isnan(result.pit[0]).tolist() == [i in missing for i in (0, 1)]


def test_with_known_gains_it_is_the_kalman_filters_likelihood():
    z = np.random.default_rng(0).normal(2.7, 1.0, (40, 1))
    z[7] = np.nan
    channel = hg.hop(0.9, 0.2)
    result = hg.learning.predictive(PLANT, SENSOR, hg.erasure(channel, 0.9), z)
    expected = hg.log_likelihood(hg.cubature_filter(PLANT, SENSOR, channel), z)
    assert result.log_likelihood.sum() == pytest.approx(expected, rel=1e-12)


@pytest.fixture(scope="module")
def rayleigh():
    """4,000 steps of a Rayleigh link: what is predicted by its law, and by two points of the same mean and variance."""
    law, node = hg.Rayleigh(0.8), {"open": hg.filters.open_loop_filter(PLANT)}
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.hop(law, 0.1), node)})
    z = hg.monte_carlo(network, horizon=4000, runs=1, key=0).measurements["a"][0]
    mean = law.moment(1)
    spread = np.sqrt(law.moment(2) - mean**2)
    two = hg.Discrete([mean - spread, mean + spread], [0.5, 0.5])
    return [hg.learning.predictive(PLANT, SENSOR, hg.hop(item, 0.1), z) for item in (law, two)]


def test_the_right_law_is_uniform_and_the_wrong_one_is_not(rayleigh):
    right, wrong = (item.uniform() for item in rayleigh)
    assert right[0] < 1.63 / np.sqrt(4000)  # Kolmogorov's 1 % point
    assert right[1] > 0.01 > wrong[1]


def test_the_data_speak_for_the_right_law(rayleigh):
    result = hg.learning.compare_laws(*rayleigh)
    assert result.decided and result.z > 5
    back = hg.learning.compare_laws(*rayleigh[::-1])
    assert back.difference == -result.difference and back.p_value == result.p_value
    assert not hg.learning.compare_laws(rayleigh[0], rayleigh[0]).decided


def test_only_one_recording_is_compared(rayleigh):
    shorter = hg.learning.Predictive(rayleigh[0].log_likelihood[:9], rayleigh[0].pit[:9])
    with pytest.raises(ValueError, match="second law: expected the same recording"):
        hg.learning.compare_laws(rayleigh[0], shorter)
    with pytest.raises(ValueError, match="recording: expected at least 10 steps"):
        hg.learning.compare_laws(shorter, shorter)


def test_of_no_measurements_there_is_no_density():
    result = hg.learning.predictive(PLANT, SENSOR, hg.perfect(), np.zeros((0, 1)))
    assert len(result.log_likelihood) == 0 and len(result.pit) == 0


def test_what_remembers_or_is_too_much_is_refused():
    with pytest.raises(ValueError, match="channel of a predictive likelihood: expected one that forgets"):
        link = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.2, 0.1), 0.1, 0.2)
        hg.learning.predictive(PLANT, SENSOR, link, np.zeros((3, 1)))
    hops = hg.amplify_and_forward([hg.hop(hg.Rayleigh(1.0), 0.1)] * 3)
    with pytest.raises(ValueError, match="at most 4,096 combinations"):
        hg.learning.predictive(PLANT, SENSOR, hops, np.zeros((3, 1)))


def test_samples_needed_are_of_the_right_size():
    """Two points whose noise hides little: I and V by quadrature over z of a signal that is all but known."""
    values = [0.6, 1.0, 1.4], [0.2, 1.0, 1.8]  # of one structure: what is compiled for one law serves the other
    a, b, noise = hg.Discrete(values[0], [0.5, 0.0, 0.5]), hg.Discrete(values[1], [0.125, 0.75, 0.125]), 0.5
    still = hg.LinearPlant([[0.0]], 1e-9, [2.0], 1e-9)
    sensor = hg.Sensor(lambda x: jnp.stack([2.0 + x[0]]), 1e-9)
    local = {"open": hg.filters.open_loop_filter(still)}
    network = hg.Network(still, {"a": hg.Node(sensor, hg.hop(a, noise), local)})
    result = hg.learning.samples_to_tell(a, b, network)
    z = np.linspace(-6, 12, 20001)
    p, q = (
        sum(w * norm.pdf(z, 2 * g, np.sqrt(noise)) for g, w in zip(c.values, c.probabilities, strict=True))
        for c in (a, b)
    )
    ratio, step = np.log(p / q), z[1] - z[0]
    means = [np.sum(p * ratio) * step, -np.sum(q * ratio) * step]
    deviations = [np.sqrt(np.sum(w * ratio**2) * step - m**2) for w, m in ((p, means[0]), (q, means[1]))]
    np.testing.assert_allclose(result.information, means, atol=4 * max(deviations) / np.sqrt(16000))  # four errors
    expected = (norm.isf(0.05) * sum(deviations) / sum(means)) ** 2
    assert result.samples == pytest.approx(expected, rel=0.15)
    assert hg.learning.samples_to_tell(a, a, network).samples == np.inf


def test_a_network_must_have_a_place_for_the_laws():
    local = {"open": hg.filters.open_loop_filter(PLANT)}
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.hop(1.0, 0.1), local)})
    with pytest.raises(ValueError, match="network: expected gains of one law, or some whose law is one of the two"):
        hg.learning.samples_to_tell(hg.Rayleigh(1.0), hg.random_affine.LogNormal(0.0, 0.1), network)


def test_a_channel_that_delivers_a_number_without_noise_has_no_density():
    """A lost packet reads as 0 exactly: LAPACK's error was raised."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 0.5), hg.LinearSensor([[1.0]], 0.2)
    with pytest.raises(hg.InputError, match="expected one behind which every measurement has a density"):
        hg.learning.predictive(plant, sensor, hg.dropout(hg.perfect(), 0.7), [[1.3]])


@pytest.mark.parametrize("rows", [10, 40])
def test_the_standard_error_of_few_rows_is_not_too_small(rows):
    """Of independent differences it is 1 / sqrt(n); 2,000 recordings tell its root mean square to 3 %.

    About the mean of the recording itself it was 0.81 of that for ten rows, 0.94 for forty.
    """
    draws, zeros = np.random.default_rng(0).normal(size=(2000, rows)), np.zeros((rows, 1))
    nothing = hg.learning.Predictive(np.zeros(rows), zeros)
    compared = [hg.learning.compare_laws(hg.learning.Predictive(row, zeros), nothing) for row in draws]
    said = np.sqrt(np.mean([result.standard_error**2 for result in compared]))
    assert said == pytest.approx(1 / np.sqrt(rows), rel=0.05)
