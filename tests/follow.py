"""Filters over rows of data: means and covariances after each step, in double precision."""

import jax
import jax.numpy as jnp
import numpy as np


def follow(item, z, u):
    """Means (steps, n) and covariances (steps, n, n) of a filter's estimates."""

    def step(state, row):
        k, measurement, inputs = row
        state, estimate = item.step(state, measurement, inputs, k)
        return state, (estimate.mean, estimate.covariance)

    with jax.enable_x64(True):
        rows = jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u)
        return jax.tree.map(np.asarray, jax.lax.scan(step, item.init(), rows)[1])


def apart(estimates, reference):
    """Largest distance of means and of covariances from a reference, in its claimed deviations."""
    (mean, covariance), (other, claimed) = estimates, reference
    deviation = np.sqrt(np.diagonal(claimed, axis1=1, axis2=2))
    of_covariance = np.abs(covariance - claimed) / (deviation[:, :, None] * deviation[:, None])
    return np.max(np.abs(mean - other) / deviation), np.max(of_covariance)
