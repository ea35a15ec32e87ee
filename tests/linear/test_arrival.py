"""Critical arrival probabilities, against those that are known in closed form."""

import numpy as np
import pytest

import heliograph as hg


def plant(matrix, process=1.0):
    n = len(matrix)
    return hg.LinearPlant(matrix, process * np.eye(n), np.zeros(n), np.eye(n))


def sensor(matrix, noise=2.5):
    return hg.LinearSensor(matrix, noise * np.eye(len(matrix)))


@pytest.mark.parametrize(
    ("matrix", "output", "lower", "upper"),
    [
        ([[-1.25]], [[1.0]], 0.36, 0.36),
        ([[1.25, 0], [1, 1.1]], [[1.0, 1.0]], 0.36, 0.471074),
        ([[1.25, 1, 0], [0, 0.9, 7], [0, 0, 0.6]], [[1.0, 0, 2]], 0.36, 0.36),
        ([[2.5, 0], [0, 1.5]], np.eye(2), 0.84, 0.84),
    ],
    ids=["scalar", "coupled", "three states", "all seen"],
)
def test_published_examples(matrix, output, lower, upper):
    result = hg.linear.critical_arrival(plant(np.array(matrix, dtype=float)), sensor(output))
    np.testing.assert_allclose(result[:2], (lower, upper), atol=5e-7)


@pytest.mark.parametrize("seed", range(4))
def test_one_output_needs_the_product_of_all_unstable_eigenvalues(seed):
    """With one output the certificate's threshold is 1 - prod |unstable eigenvalues|^-2."""
    generator = np.random.default_rng(seed)
    matrix = generator.normal(size=(3, 3))
    matrix *= 1.4 / np.abs(np.linalg.eigvals(matrix)).max()
    sizes = np.abs(np.linalg.eigvals(matrix))
    result = hg.linear.critical_arrival(plant(matrix), sensor(generator.normal(size=(1, 3))))
    np.testing.assert_allclose(result.upper, 1 - np.prod(sizes[sizes > 1]) ** -2, atol=1e-7)
    np.testing.assert_allclose(result.lower, 1 - 1.4**-2, atol=1e-12)


def test_a_gain_that_is_held():
    """(1 - arrival) a^2 + arrival (a - k)^2 = 1."""
    k = -0.70078691  # the Kalman gain where everything arrives
    result = hg.linear.critical_arrival(plant([[-1.25]]), sensor([[1.0]]), gain=[[k]])
    expected = (1.25**2 - 1) / (1.25**2 - (-1.25 - k) ** 2)
    np.testing.assert_allclose(result[:2], (expected, expected), atol=1e-8)
    assert round(result.upper, 4) == 0.4461


def test_a_stable_plant_needs_nothing():
    result = hg.linear.critical_arrival(plant([[0.9]]), sensor([[1.0]]))
    assert result[:2] == (0.0, 0.0)


def test_no_process_or_sensor_noise_changes_no_threshold():
    quiet = hg.LinearPlant([[1.25, 0.0], [1.0, 1.1]], np.zeros((2, 2)), np.zeros(2), np.eye(2))
    result = hg.linear.critical_arrival(quiet, sensor([[1.0, 1.0]], 0.0))
    np.testing.assert_allclose(result.upper, 1 - 1.375**-2, atol=1e-7)


def test_bad_input_is_one_line():
    with pytest.raises(ValueError, match="sensor: expected one that keeps the error bounded where everything arrives"):
        hg.linear.critical_arrival(plant([[1.2]]), sensor([[0.0]]))
    with pytest.raises(ValueError, match="gain: expected one that keeps"):
        hg.linear.critical_arrival(plant([[1.2]]), sensor([[1.0]]), gain=[[5.0]])
    with pytest.raises(ValueError, match="gain: expected shape"):
        hg.linear.critical_arrival(plant([[1.2]]), sensor([[1.0]]), gain=[1.0])
    with pytest.raises(ValueError, match="plant: expected a LinearPlant that does not vary, got Plant"):
        hg.linear.critical_arrival(hg.Plant(lambda x, u: x, 1.0, [0.0], 1.0), sensor([[1.0]]))
    with pytest.raises(ValueError, match="sensor: expected a LinearSensor that does not vary, got one that varies"):
        hg.linear.critical_arrival(plant([[1.2]]), hg.model.over_time([sensor([[1.0]])]))
