"""Split of a path's power, and the concave envelope of its information."""

import numpy as np
import pytest
from scipy.optimize import minimize

import heliograph as hg
from heliograph.planning import split_power
from heliograph.planning.multihop_paths.power_split_over_hops import SplitPaths, compute_envelope, split_power_over_hops


@pytest.mark.parametrize("alpha", [[1.0, 2.0], [0.3, 2.0, 0.1, 7.0]], ids=["two hops", "four hops"])
def test_the_split_is_that_of_a_descent(alpha):
    total, a = 3.0, np.array(alpha)
    descent = minimize(
        lambda p: np.log1p(a / p).sum(),
        np.full(len(a), total / len(a)),
        bounds=[(1e-6, total)] * len(a),
        constraints={"type": "eq", "fun": lambda p: p.sum() - total},
        options={"ftol": 1e-14},
    )
    p = split_power(a, total)
    np.testing.assert_allclose(p, descent.x, rtol=1e-5)  # flat at the minimum
    assert np.log1p(a / p).sum() <= descent.fun + 1e-14
    assert p.sum() == pytest.approx(total, rel=1e-14)
    np.testing.assert_allclose(p**2 / a + p, (p**2 / a + p)[0], rtol=1e-12)  # the condition of Karush, Kuhn and Tucker


def test_two_hops_share_by_their_closed_form_and_one_gets_all():
    share = np.sqrt([0.9 * (3.0 + 2.1), 2.1 * (3.0 + 0.9)])
    np.testing.assert_allclose(split_power([0.9, 2.1], 3.0), 3.0 * share / share.sum(), rtol=1e-14)
    assert split_power([0.0, 2.0, 0.0], 3.0).tolist() == pytest.approx([0.0, 3.0, 0.0], rel=1e-14)
    assert split_power([0.0, 0.0], 1.0).tolist() == split_power([1.0, 2.0], 0.0).tolist() == [0.0, 0.0]
    np.testing.assert_allclose(split_power([1e-9, 1e9, 1.0], 1e-3).sum(), 1e-3, rtol=1e-13)
    with pytest.raises(hg.InputError, match="alpha of hops: expected numbers of at least 0"):
        split_power([-1.0], 1.0)


def test_the_envelope_is_concave_above_and_touches():
    draws = np.random.default_rng(0)
    alpha, full = draws.uniform(0.2, 5, (1, 4, 3)), draws.uniform(1, 3, (1, 4))
    alpha[0, 0, 1:], alpha[0, 1, 2] = 0.0, 0.0  # one hop, two hops, three and three
    whole = SplitPaths(full, full * draws.uniform(0.3, 0.95, (1, 4)), alpha)
    bound, x = compute_envelope(whole, np.full((1, 4), 200.0)), np.linspace(0, 200, 801)
    exact = np.array([split_power_over_hops(whole, np.full((1, 4), p)).information[0] for p in x])
    above = np.array([bound.information(np.full((1, 4), p))[0][0] for p in x])
    assert np.all(above >= exact * (1 - 1e-12)) and np.all(np.diff(above, 2, axis=0) <= 1e-12)
    steepest = np.max(exact[1:] / x[1:, None], axis=0)[1:]
    np.testing.assert_allclose(bound.ray[0, 1:], steepest, rtol=1e-3)  # the grid misses the point by half a step
    assert bound.touch[0, 0] == 0.0
