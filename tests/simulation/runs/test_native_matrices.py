"""Plants that solve, invert and factor matrices: a Monte Carlo by native code has the numbers of XLA."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

pytestmark = pytest.mark.slow


def matrix(x):
    return jnp.eye(2) * 3 + jnp.outer(jnp.tanh(x), jnp.tanh(x))


MOTIONS = {
    "solve": lambda x, u: 0.9 * jnp.linalg.solve(matrix(x), 3 * x),
    "inv": lambda x, u: 0.9 * jnp.linalg.inv(matrix(x)) @ x * 3,
    "cholesky": lambda x, u: 0.4 * jnp.linalg.cholesky(matrix(x)) @ x,
}


@pytest.mark.parametrize("name", MOTIONS)
def test_a_monte_carlo_by_native_code_is_that_of_xla(name, monkeypatch):
    """To rounding: 20 steps of a stable plant multiply a unit in the last place by less than 1e4."""
    plant = hg.Plant(MOTIONS[name], 0.1 * np.eye(2), [1.0, 2.0], 0.1 * np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    filters = {"ekf": hg.extended_filter(plant, sensor)}
    if name == "cholesky":  # others factor the matrices of all points together, which XLA computes
        filters["ckf"] = hg.cubature_filter(plant, sensor)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), filters)})
    results = {}
    for engine in ("native", "xla"):
        monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
        results[engine] = hg.monte_carlo(network, 20, 50, 0, keep=hg.Statistics())
    for filter in filters:
        native, xla = (results[engine]["a"][filter] for engine in ("native", "xla"))
        np.testing.assert_allclose(native.outer, xla.outer, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(native.covariance, xla.covariance, rtol=1e-10, atol=1e-12)
