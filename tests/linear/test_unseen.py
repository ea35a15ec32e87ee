"""Eigenvectors that losses hide, and what noise reaches."""

import numpy as np
import pytest

from heliograph.linear.known_loss_stability import find_fastest_unobserved_mode, is_excited_by_noise, list_eigenspaces

NONE = np.zeros((0, 2))
INDEPENDENT = np.array([[0.3, 0.7]] * 2)


def test_a_loss_hides_everything():
    result = find_fastest_unobserved_mode(np.diag([1.5, 2.0]), INDEPENDENT, [NONE, np.array([[1.0, 1.0]])])
    np.testing.assert_allclose(result.growth, 0.3 * 4)
    assert result.modes == (0,)
    np.testing.assert_allclose(np.abs(result.vectors.ravel()), (0, 1), atol=1e-12)


def test_an_output_hides_what_it_does_not_see():
    """Mode 1 shows the first state only: the second is hidden in both, the faster first in one."""
    result = find_fastest_unobserved_mode(np.diag([1.5, 1.1]), INDEPENDENT, [NONE, np.array([[1.0, 0.0]])])
    np.testing.assert_allclose(result.growth, 1.1**2)
    assert result.modes == (0, 1)


def test_one_eigenvalue_with_two_vectors_hides_in_each_output():
    """z = x1 or z = x2 arrives, never both: each vector is hidden half of the time, none always."""
    outputs = [np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]])]
    result = find_fastest_unobserved_mode(1.3 * np.eye(2), np.full((2, 2), 0.5), outputs)
    np.testing.assert_allclose(result.growth, 0.5 * 1.69)
    assert len(result.modes) == 1


def test_bursts_hide_by_how_long_they_last():
    chain = np.array([[0.9, 0.1], [0.4, 0.6]])
    result = find_fastest_unobserved_mode(np.array([[2.0]]), chain, [np.ones((1, 1)), np.zeros((0, 1))])
    np.testing.assert_allclose(result.growth, 0.6 * 4)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_units_do_not_decide(scale):
    units = np.diag([scale, 1.0])
    matrix = units @ np.array([[1.2, 1.0], [0.0, 1.1]]) @ np.linalg.inv(units)
    output = np.array([[0.0, 1.0]])
    result = find_fastest_unobserved_mode(matrix, np.ones((1, 1)), [output])
    np.testing.assert_allclose(result.growth, 1.44)


def test_eigenspaces_of_a_rotation_and_of_a_double_eigenvalue():
    ((value, space),) = list_eigenspaces(np.array([[0.0, -2.0], [2.0, 0.0]]))
    assert abs(value - 2j) < 1e-12 and space.shape == (2, 1)
    ((_, whole),) = list_eigenspaces(np.eye(3))
    assert whole.shape == (3, 3)
    ((_, jordan),) = list_eigenspaces(np.array([[1.0, 1.0], [0.0, 1.0]]))
    np.testing.assert_allclose(np.abs(jordan.ravel()), (1, 0), atol=1e-7)


def test_noise_reaches_what_the_plant_carries_it_to():
    matrix, item = np.array([[1.0, 1.0], [0.0, 1.0]]), np.eye(2)
    assert is_excited_by_noise(item, matrix, np.diag([0.0, 1.0]))
    assert not is_excited_by_noise(item, matrix, np.diag([1.0, 0.0]))
    assert is_excited_by_noise(item[:, :1], matrix, np.diag([1e-20, 0.0]))
    assert not is_excited_by_noise(item[:, :1], matrix, np.zeros((2, 2)))
