"""Rotation vectors against SciPy's rotations, at all sizes of a turn, by arrays and by traced numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import heliograph as hg

models = hg.models


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.009, 0.0101, 0.5, 3.0])
def test_turns_are_scipy_s(size):
    """To 1e-15 of the turn, on both sides of where the series begin; by JAX the same."""
    draw = np.random.default_rng(0)
    r, by = draw.normal(size=(2, 100, 3))
    r *= size / np.linalg.norm(r, axis=1, keepdims=True)
    by *= size
    expected = (Rotation.from_rotvec(r) * Rotation.from_rotvec(by)).as_rotvec()
    np.testing.assert_allclose(models.turn_attitude(r, by), expected, rtol=0, atol=5e-15 * max(size, 1e-9))
    np.testing.assert_allclose(models.rotation_matrix(r), Rotation.from_rotvec(r).as_matrix(), atol=1e-15)
    quaternion = models.to_quaternion(r)
    np.testing.assert_allclose(quaternion[:, 1:], Rotation.from_rotvec(r).as_quat()[:, :3], atol=1e-15)
    np.testing.assert_allclose(models.from_quaternion(-3.0 * quaternion), r, atol=5e-15 * max(size, 1e-9))
    with jax.enable_x64(True):
        traced = jax.jit(models.turn_attitude)(jnp.asarray(r), jnp.asarray(by))
    np.testing.assert_allclose(traced, expected, rtol=0, atol=5e-15 * max(size, 1e-9))


def test_derivatives_exist_where_nothing_turns():
    """d turn / d by at 0 is the inverse of Jr(r), I at r = 0: no NaN of a square root."""
    with jax.enable_x64(True):
        zero = jnp.zeros(3)
        turns = jax.jit(jax.jacfwd(models.turn_attitude, (0, 1)))(zero, zero)
        matrix = jax.jit(jax.jacrev(models.rotation_matrix))(zero)
    np.testing.assert_array_equal(turns, [np.eye(3)] * 2)
    np.testing.assert_array_equal(matrix[2, 1], [1.0, 0.0, 0.0])  # [r]x


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: models.turn_attitude([0.0, 1.0], [0.0, 0.0, 1.0]), r"attitude: expected shape \(\.\.\., 3\)"),
        (lambda: models.rotation_matrix("north"), "attitude: expected"),
        (lambda: models.from_quaternion([0.0, 0.0, 0.0]), r"quaternion: expected shape \(\.\.\., 4\)"),
        (lambda: models.from_quaternion(np.zeros(4)), "quaternion: expected four numbers of which one is not 0"),
    ],
)
def test_other_shapes_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()


@pytest.mark.parametrize("length", [1e-320, 1e-170, 1.0, 1e170])
def test_a_quaternion_may_have_any_length(length):
    """Its square is 0 or infinite for three of these; XLA may take what is below 1e-300 for 0."""
    quaternion = length * np.array([1.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(models.from_quaternion(quaternion), [np.pi / 2, 0, 0], rtol=1e-15)
    with jax.enable_x64(True):
        traced = jax.jit(models.from_quaternion)(jnp.asarray(max(quaternion[0], 1e-300) * np.sign(quaternion)))
    np.testing.assert_allclose(traced, [np.pi / 2, 0, 0], rtol=1e-15)
