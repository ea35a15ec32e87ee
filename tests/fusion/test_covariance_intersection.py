"""The weights of covariance intersection: certified, and as good as those of general-purpose solvers."""

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from tests.bounds import covariances, estimates
from tests.oracles import covariance_intersection as oracle

CERTIFIED = 1e-9  # the method stops at 1e-10


def relative_gap(information, weights):
    """max_k tr(P J_k P) / tr P - 1 certifies how far tr P may be above its minimum, relative to itself."""
    covariance = jnp.linalg.inv(jnp.tensordot(weights, information, axes=1))
    square = covariance @ covariance
    return jnp.max(jnp.einsum("kij,ij->k", information, square)) / jnp.trace(covariance) - 1


@jax.jit
def certified(information):
    weights = hg.CovarianceIntersection().weights_of(jnp.linalg.inv(information), information)
    return weights, relative_gap(information, weights)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), shape=st.sampled_from([(2, 2), (4, 1), (6, 5)]))
def test_the_gap_of_the_weights_is_certified(seed, shape):
    with jax.enable_x64(True):
        information = jnp.asarray(np.linalg.inv(covariances(seed, *shape)))
        weights, gap = certified(information)
        assert float(gap) <= CERTIFIED
    weights = np.asarray(weights)
    assert np.all(weights >= 0) and weights.sum() == pytest.approx(1, abs=1e-12)


def test_weights_agree_with_slsqp():
    bounds = np.stack([covariances(seed, 4, 5) for seed in range(20)])
    reference = oracle.trace_weights(bounds)
    for b, w in zip(bounds, reference, strict=True):
        fused = hg.fusion.fuse(hg.CovarianceIntersection(), estimates(b))
        at_theirs, means = hg.fusion.fuse(hg.fusion.FixedIntersection(w), estimates(b)), [e.mean for e in estimates(b)]
        mean, theirs = oracle.intersect(np.stack(means), b, w)
        np.testing.assert_allclose(at_theirs.mean, mean, rtol=0, atol=1e-9)  # roundings by the information's condition
        np.testing.assert_allclose(at_theirs.covariance, theirs, rtol=0, atol=1e-9 * np.trace(theirs))
        # Two minima of one convex function: ours is certified to 1e-10, SLSQP's is no better than its own tolerance.
        assert np.trace(fused.covariance) <= np.trace(theirs) * (1 + 1e-10)
        assert np.trace(fused.covariance) >= np.trace(theirs) * (1 - 1e-6)


def test_weights_agree_with_a_semidefinite_programme():
    bounds = covariances(3, 3, 3, spread=0.3)
    w, p = cp.Variable(3, nonneg=True), cp.Variable((3, 3), symmetric=True)
    information = sum(w[k] * np.linalg.inv(bounds[k]) for k in range(3))
    lifted = cp.bmat([[p, np.eye(3)], [np.eye(3), information]])
    problem = cp.Problem(cp.Minimize(cp.trace(p)), [lifted >> 0, cp.sum(w) == 1])
    problem.solve(solver=cp.CLARABEL)
    fused = hg.fusion.fuse(hg.CovarianceIntersection(), estimates(bounds))
    assert np.trace(fused.covariance) == pytest.approx(problem.value, rel=1e-6)  # the solver's tolerance
