import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.filters.gaussian.moment_transforms import Cubature, Linearization

MEAN = np.array([0.3, -0.2, 0.5])
COVARIANCE = np.array([[0.5, 0.1, 0.0], [0.1, 0.4, -0.1], [0.0, -0.1, 0.3]])


@pytest.mark.parametrize("rule", [Cubature(), Linearization()])
def test_affine_functions_are_exact(rule):
    a, b = np.random.default_rng(0).normal(size=(2, 3)), np.array([1.0, -2.0])
    with jax.enable_x64(True):
        result = rule.apply(lambda x: a @ x + b, jnp.asarray(MEAN), jnp.asarray(COVARIANCE))
    np.testing.assert_allclose(result.mean, a @ MEAN + b, rtol=1e-13)
    np.testing.assert_allclose(result.covariance, a @ COVARIANCE @ a.T, rtol=1e-12)
    np.testing.assert_allclose(result.cross, COVARIANCE @ a.T, rtol=1e-12)


def test_cubature_mean_is_exact_to_degree_three():
    with jax.enable_x64(True):
        result = Cubature().apply(
            lambda x: jnp.stack([x[0] * x[1] * x[2], x[0] ** 3]), jnp.asarray(MEAN), jnp.asarray(COVARIANCE)
        )
    m, p = MEAN, COVARIANCE
    triple = m[0] * m[1] * m[2] + p[0, 1] * m[2] + p[0, 2] * m[1] + p[1, 2] * m[0]
    np.testing.assert_allclose(result.mean, [triple, m[0] ** 3 + 3 * m[0] * p[0, 0]], rtol=1e-12)
