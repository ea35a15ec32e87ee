"""Split intersection: above every joint covariance that its parts allow, and its two limits."""

import numpy as np
import pytest

import heliograph as hg


def parts(seed, nodes=3, n=2):
    """Joint covariance of the known parts, covariances of the unknown ones."""
    draw = np.random.default_rng(seed)
    root, local = draw.normal(size=(nodes * n, nodes * n)), draw.normal(size=(nodes, n, n))
    return (root @ root.T).reshape(nodes, n, nodes, n) / n, local @ np.swapaxes(local, 1, 2)


def estimates(known, unknown):
    blocks = np.einsum("iaib->iab", known) + unknown
    return [hg.model.Estimate(np.zeros(blocks.shape[1]), block, "exact") for block in blocks]


def gain(rule, given):
    """The weights that a rule uses, read off its answers to unit means."""
    nodes, n = len(given), given[0].mean.shape[0]
    values = np.zeros((n, nodes, n))
    for i in range(nodes):
        unit = [
            hg.model.Estimate(np.eye(n) * (j == i), np.tile(e.covariance, (n, 1, 1)), e.claim)
            for j, e in enumerate(given)
        ]
        values[:, i] = hg.fusion.fuse(rule, unit).mean.T
    return values


def test_it_is_above_whatever_the_unknown_parts_have_in_common():
    """Unknown parts that are all one source, turned at random, and independent ones: 200 ways, none above the claim."""
    known, unknown = parts(0)
    rule, given = hg.fusion.SplitIntersection(known), estimates(known, unknown)
    fused, weights = hg.fusion.fuse(rule, given), gain(rule, given)
    assert fused.claim == "upper"
    np.testing.assert_allclose(weights.sum(axis=1), np.eye(2), atol=1e-9)
    roots, draw, closest = np.linalg.cholesky(unknown), np.random.default_rng(1), np.inf
    for _ in range(200):
        turned = np.stack([root @ np.linalg.qr(draw.normal(size=(2, 2)))[0] for root in roots])
        common = np.einsum("iab,jcb->iajc", turned, turned)
        true = np.einsum("aib,ibjc,djc->ad", weights, known + common, weights)
        least = np.linalg.eigvalsh(fused.covariance - true)[0]
        assert least > -1e-9
        closest = min(closest, least)
    assert closest < 0.2 * np.trace(fused.covariance)  # it is not above by being far above
    whole = hg.fusion.fuse(hg.CovarianceIntersection(), given)
    assert np.trace(fused.covariance) < np.trace(whole.covariance)


def test_with_all_known_it_is_matrix_weights_and_with_nothing_known_intersection():
    known, unknown = parts(2)
    all_known = hg.fusion.fuse(hg.fusion.SplitIntersection(known), estimates(known, 0 * unknown))
    weights = hg.fusion.MatrixWeights().weights(known)
    expected = np.einsum("aib,ibjc,djc->ad", weights, known, weights)
    np.testing.assert_allclose(all_known.covariance, expected, rtol=1e-6)
    nothing = hg.fusion.fuse(hg.fusion.SplitIntersection(np.zeros((3, 2, 2))), estimates(0 * known, unknown))
    intersected = hg.fusion.fuse(hg.CovarianceIntersection(), estimates(0 * known, unknown))
    assert np.trace(nothing.covariance) == pytest.approx(np.trace(intersected.covariance), rel=1e-3)


def test_an_unknown_part_that_is_rounding_of_a_known_one_leaves_a_bound():
    """Known parts of 10^21 and unknown ones of 10^5, their rounding, which small shares divide: no claim below 0.

    W (P^a + P^b) W' of independent unknown parts is below what is claimed, to 1e-9 of it.
    """
    draw, shared = np.random.default_rng(0), np.array([[1e21, 3e20], [3e20, 2e21]])
    for _ in range(20):
        known = np.tile(shared[None, :, None, :], (3, 1, 3, 1)) + 0.0
        known = known + 1e16 * np.eye(6).reshape(3, 2, 3, 2)
        root = draw.normal(size=(3, 2, 2)) * np.exp(draw.uniform(2, 8, size=(3, 1, 1)))
        unknown = root @ np.swapaxes(root, 1, 2)
        given = estimates(known, unknown)
        fused = hg.fusion.fuse(hg.fusion.SplitIntersection(known), given)
        weights = gain(hg.fusion.SplitIntersection(known), given)
        joint = known + np.einsum("ij,iab->iajb", np.eye(3), unknown)
        true = np.einsum("aib,ibjc,djc->ad", weights, joint, weights)
        claimed = np.asarray(fused.covariance)
        unit = np.sqrt(np.diagonal(claimed))
        assert np.linalg.eigvalsh((claimed - true) / np.outer(unit, unit))[0] > -1e-9


def test_what_is_no_split_is_refused():
    known, unknown = parts(3)
    rule = hg.fusion.SplitIntersection(known)
    with pytest.raises(ValueError, match="a covariance of all parts together"):
        hg.fusion.SplitIntersection(-known)
    with pytest.raises(ValueError, match="that of 2 estimates, got that of 3"):
        hg.fusion.fuse(rule, estimates(known, unknown)[:2])
    assert np.isnan(hg.fusion.fuse(rule, estimates(known * 0.5, 0 * unknown)).covariance).all()
