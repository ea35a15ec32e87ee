"""Digits of fused estimates: states far from zero, and components that determine each other up to rounding."""

import numpy as np
import pytest

import heliograph as hg

RULES_THAT_INTERSECT = [
    hg.fusion.EqualIntersection(),
    hg.CovarianceIntersection(),
    hg.fusion.FixedIntersection([0.25, 0.75]),
    hg.fusion.InverseCovarianceIntersection(),
]


@pytest.mark.parametrize("rule", RULES_THAT_INTERSECT, ids=lambda rule: type(rule).__name__)
def test_how_far_the_means_are_from_zero_makes_no_difference(rule):
    """Millions of deviations off, with components that nearly determine each other: P^-1 x has lost eight digits of x.

    All numbers are multiples of 2^-20, so that only the last sum rounds: by 2^22 units of 2.2e-16, 1e-9.
    """
    near = 1 - 2.0**-26
    covariances = np.array([[[1.0, near], [near, 1.0]], [[2.0, 0.5], [0.5, 1.0]]])
    means, far = np.array([[0.25, 0.25 + 2.0**-14], [-0.5, 0.125]]), np.array([2.0**22, -(2.0**21)])

    def fused(shift):
        return hg.fusion.fuse(
            rule, [hg.model.Estimate(m + shift, p, "exact") for m, p in zip(means, covariances, strict=True)]
        )

    assert np.allclose(fused(far).mean - far, fused(0.0).mean, rtol=0, atol=2e-9)


@pytest.mark.parametrize("rule", RULES_THAT_INTERSECT[:3], ids=lambda rule: type(rule).__name__)
def test_what_is_left_by_rounding_is_known(rule):
    """Two estimates that know one combination to rounding: the limit is the intersection along the other direction.

    1e-6: what stands for none is 1e-8 of a variance, and counts against what rounding of P leaves of it.
    """
    direction, sizes, means = np.array([1.0, 0.9, -2.0]), np.array([1.0, 3.0]), np.array([0.3, -1.1])
    rounded = np.diag([0.0, 5e-14, 3e-14])
    fused = hg.fusion.fuse(
        rule, [hg.model.Estimate(m * direction, s * np.outer(direction, direction) + rounded, "exact")
               for m, s in zip(means, sizes, strict=True)]
    )  # fmt: skip
    weights = {"FixedIntersection": [0.25, 0.75], "EqualIntersection": [0.5, 0.5]}.get(type(rule).__name__, [1.0, 0.0])
    variance = 1 / np.sum(weights / sizes)
    assert np.allclose(fused.covariance, variance * np.outer(direction, direction), rtol=0, atol=1e-6)
    assert np.allclose(fused.mean, variance * np.sum(weights * means / sizes) * direction, rtol=0, atol=1e-6)


@pytest.mark.parametrize("rule", RULES_THAT_INTERSECT, ids=lambda rule: type(rule).__name__)
def test_what_an_estimate_knows_exactly_is_kept_to_the_bit(rule):
    """A claim of 0 is that of the number itself, not of it and 1e-8 of what the other says."""
    known = hg.model.Estimate(np.array([3.1, 1.0]), np.diag([0.0, 2.0]), "exact")
    other = hg.model.Estimate(np.array([10.0, 0.0]), np.array([[1.0, 0.5], [0.5, 1.0]]), "exact")
    for estimates in ([known, other], [other, known]):
        fused = hg.fusion.fuse(rule, estimates)
        assert fused.mean[0] == 3.1
        assert np.array_equal(fused.covariance[0], [0.0, 0.0]) and fused.covariance[1, 1] > 0.5
