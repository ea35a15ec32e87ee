"""Filters of functions behind wide priors and precise sensors, against the recursion in fractions."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.factors.exact import after, congruence, exactly, total

WIDE, PRECISE = 10.0 ** np.arange(0, 15, 2), 10.0 ** np.arange(-14, 1, 2)
CASES = [(wide, precise) for wide in WIDE for precise in PRECISE]
STEPS = 4
A, H, Q, N = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]), np.eye(1, 3), 1e-9, 3


@cache
def exact_variances():
    """Return the variances of each case after each step, (cases, steps, states): the same for all filters."""
    variances = np.zeros((len(CASES), STEPS, N))
    for case, (wide, precise) in enumerate(CASES):
        p, r = exactly(wide * np.eye(N)), exactly([[precise]])
        for k in range(STEPS):
            p, _ = after(total(congruence(exactly(A), p), exactly(Q * np.eye(N))), exactly(H), r)
            variances[case, k] = [float(p[i][i]) for i in range(N)]
    return variances


@pytest.mark.parametrize("filter_of", [hg.cubature_filter, hg.unscented_filter, hg.extended_filter])
def test_functions_of_a_wide_prior_keep_their_digits_too(filter_of):
    """Position, velocity and acceleration as functions of which a filter knows points or slopes: the linear ones' 2 %.

    Summed as a matrix, the prediction would lose what lies below 1e-16 of the prior: .85 of the exact variance were
    claimed, and 1e7 times it.
    """

    def claimed(wide, precise):
        plant = hg.Plant(lambda x, u: A @ x, Q * jnp.eye(N), np.zeros(N), wide * jnp.eye(N))
        item = filter_of(plant, hg.Sensor(lambda x: H @ x, precise, outputs=["position"]))

        def body(state, k):
            state, _ = item.correct(item.predict(state, (), k), np.zeros(1), k)
            return state, jnp.diagonal(item.estimate(state).covariance)

        return jax.lax.scan(body, item.init(), jnp.arange(STEPS))[1]

    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(claimed))(*np.array(CASES).T)
    for case, variances, expected in zip(CASES, found, exact_variances(), strict=True):
        np.testing.assert_allclose(variances, expected, rtol=0.02, err_msg=f"{case}")
