"""Innovations tell whether a link remembers what a filter assumes it forgets."""

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modal_problems import PLANT, SENSOR, bursts

STEPS = 20_000


@pytest.fixture(scope="module")
def received():
    channel = bursts()
    filters = {
        "memoryless": hg.linear_filter(PLANT, SENSOR, hg.model.without_memory(channel)),
        "exact": hg.linear_filter(PLANT, SENSOR, channel),
    }
    record = hg.monte_carlo(hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, filters)}), STEPS, 1, 5)
    return record.measurements["node"][0], filters


def test_memory_is_found_where_a_filter_assumes_none(received):
    """Lag 1 is .30 and lag 2 .20; within four standard errors."""
    z, filters = received
    memory = hg.simulation.memory_test(z, filters["memoryless"])
    assert memory.significant and memory.p_value < 1e-6
    assert np.all(np.abs(memory.correlation[:2] - [0.30, 0.20]) < 4 * memory.standard_error[:2])
    assert 0.05 < memory.predictable < 0.2


def test_the_exact_filter_leaves_nothing_behind(received):
    z, filters = received
    memory = hg.simulation.memory_test(z, filters["exact"])
    assert not memory.significant and memory.predictable < 0.02
    assert abs(memory.power - 1) < 4 * memory.power_error


def test_innovations_alone_and_gaps():
    generator = np.random.default_rng(0)
    white = generator.normal(size=(5000, 2)) * [1.0, 30.0]
    white[generator.random(5000) < 0.2] = np.nan
    assert not hg.simulation.memory_test(white).significant and np.isnan(hg.simulation.memory_test(white).power)
    moved = white[1:] + 0.4 * white[:-1]  # a moving average: lag 1 is .4 / 1.16
    assert hg.simulation.memory_test(moved).correlation[0] == pytest.approx(0.4 / 1.16, abs=0.05)
    assert hg.simulation.memory_test(moved[:, 0]).significant


@pytest.mark.parametrize("seed", range(3))
def test_loud_bursts_alone_are_no_memory(seed):
    """Variance that comes in bursts widens the standard error, and finds nothing."""
    generator = np.random.default_rng(seed)
    loud = np.repeat(generator.choice([0.2, 3.0], 500), 20)
    memory = hg.simulation.memory_test(loud * generator.normal(size=10_000))
    assert memory.p_value > 0.001 and memory.standard_error[0] > 1 / np.sqrt(10_000)


def test_one_pair_is_no_evidence_of_memory():
    """Every third row, and one more: its one product had the error 0, and was significant with p = 0."""
    z = np.full((300, 1), np.nan)
    z[::3, 0] = np.random.default_rng(0).normal(size=100)
    z[1, 0] = 0.5
    found = hg.simulation.memory_test(z, lags=3)
    assert np.isnan(found.standard_error[:2]).all() and found.standard_error[2] > 0
    assert found.p_value == 1.0 and not found.significant
    assert found.p_value_of_all > 0.1


def test_bad_input():
    with pytest.raises(ValueError, match=r"^data: expected at least 100 steps for 10 lags, got 50"):
        hg.simulation.memory_test(np.zeros(50))
    with pytest.raises(ValueError, match=r"^measurements"):
        hg.simulation.memory_test(np.zeros((200, 3)), hg.linear_filter(PLANT, SENSOR, bursts()))


def test_what_an_output_says_again_adds_nothing_to_the_innovations():
    """A sensor that reads the state twice without noise: the second reading has nothing new to say."""
    plant = hg.LinearPlant([[0.8]], noise=hg.Gaussian([[1.0]]), initial_mean=[0.0], initial_covariance=[[1.0]])
    twice = hg.LinearSensor([[1.0], [2.0]], noise=hg.Gaussian(np.zeros((2, 2))))
    x = np.random.default_rng(3).normal(size=(400, 1)).cumsum(axis=0)
    white = hg.simulation.whitened_innovations(x * [1.0, 2.0], hg.kalman_filter(plant, twice))
    alone = hg.simulation.whitened_innovations(x, hg.kalman_filter(plant, hg.LinearSensor([[1.0]], [[0.0]])))
    np.testing.assert_allclose(white[:, :1], alone, rtol=1e-12)
    assert np.all(np.isnan(white[:, 1]))
