"""What is free is learned: likelihoods by an oracle, derivatives by differences, estimates with honest intervals."""

import numpy as np
import pytest

import heliograph as hg
from tests.oracles.learning_links import likelihood

STEPS = 400
INPUTS = np.where(np.arange(STEPS) // 30 % 2, 0.4, -0.4)[:, None]
TRUTH = {"plant noise": 0.2, "mean gain": 0.8, "gain variance": 0.16, "hop noise": 0.3}


def world(law, plant_noise, hop_noise):
    """x+ = .95 x + u + w; a relayed measurement that is lost now and then, and a direct one."""
    plant = hg.LinearPlant([[0.95]], plant_noise, [0.0], [[1.0]], [[1.0]])
    sensor = hg.LinearSensor([[1.0], [1.0]], np.diag([0.3, 0.2]))
    channel = hg.parallel([hg.erasure(hg.hop(law, hop_noise), 0.8), hg.perfect()])
    return hg.Network(plant, {"node": hg.Node(sensor, channel, {})})


def network():
    mean, variance = hg.free(0.7, "mean gain"), hg.free(0.1, "gain variance", "positive")
    law = hg.random_affine.GivenMoments([mean, mean**2 + variance])
    return world(law, hg.free(0.3, "plant noise"), hg.free(0.2))


@pytest.fixture(scope="module")
def recording():
    return hg.monte_carlo(world(hg.Discrete([0.4, 1.2], [0.5, 0.5]), 0.2, 0.3), STEPS, 1, 0, inputs=INPUTS)


@pytest.fixture(scope="module")
def found(recording):
    return hg.fit(network, recording, INPUTS, starts=3)


def oracle(values, z, form):
    mean, variance, noise = values["mean gain"], values["gain variance"], values["hop noise"]
    m, one = np.diag([mean, 1.0]), np.eye(1)

    def spread(w):
        return np.diag([variance * w[0, 0] + noise, 0.0])

    c, r = np.ones((2, 1)), np.diag([0.3, 0.2])
    model = (0.95 * one, one, values["plant noise"] * one, c, r, 0.0, m, np.zeros(2), spread, np.zeros(1), one)
    return likelihood(model, z, INPUTS, form)


@pytest.mark.parametrize("form", ["linear", "conditional"])
def test_the_likelihood_is_that_of_the_recursion(found, recording, form):
    solution = next(one for one in found.solutions if one.form == form)
    values = found.description.parameters.known(solution.x)
    assert set(values) == {"plant noise", "mean gain", "gain variance", "hop noise"}
    expected = oracle(values, recording.measurements["node"][0], form)
    assert found.log_likelihood[form] == pytest.approx(expected, rel=1e-12)


def test_what_is_learned_covers_the_truth(found):
    assert found.converged
    for row in found.rows():
        assert row.low < row.estimate < row.high and row.identified and not row.boundary
        assert abs(row.estimate - TRUTH[row.name]) < 4 * row.standard_error


def test_the_network_runs(found, recording):
    record = hg.run(found.network, {"node": recording.measurements["node"][0]}, INPUTS)
    assert record.measurements["node"].shape == (STEPS, 2)
    assert found.network.plant.noise.covariance[0, 0] == found.values["plant noise"]
