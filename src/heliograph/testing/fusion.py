"""Contract test of a fusion rule: identical estimates, claims, and the bound on the fused covariance."""

import numpy as np

from heliograph.fusion.rules import AbstractFusion, fuse
from heliograph.model.estimate import STRENGTH, Claim, Estimate
from heliograph.numerics.types import Array
from heliograph.testing.filters import ROUNDING

SEARCHED = 1e-6  # relative: a flat minimum fixes weights that are searched for to the root of rounding, 1e-8


def check_fusion(rule: AbstractFusion, count: int = 3, n: int = 2, seed: int = 0) -> None:
    """Check a fusion rule on random estimates.

    Identical estimates are returned unchanged; a claim is no stronger than the weakest input's; fusion inside vmap
    equals fusion alone; and where "upper" is claimed, the fused covariance dominates that of the fused error for random
    joint covariances of the inputs' errors.

    Args:
        rule: the rule to test.
        count: number of estimates (default 3).
        n: number of states (default 2).
        seed: seed of the covariances (default 0).

    Raises:
        AssertionError: naming the rule that is broken.
    """
    generator = np.random.default_rng(seed)
    claims: list[Claim] = ["exact", "upper", "nominal"]
    for claim in claims:
        fused = rule.claim([claim, *claims[:1] * (count - 1)])
        assert STRENGTH[fused] <= STRENGTH[claim], f"claim: expected at most {claim!r}, got {fused!r}"
    for _ in range(10):
        root = generator.normal(size=(count * n, count * n))
        joint = (root @ root.T).reshape(count, n, count, n)
        bounds = np.stack([joint[i, :, i] for i in range(count)])
        alike = _fused(rule, np.ones((count, n)), np.broadcast_to(bounds[0], bounds.shape))
        _close("identical estimates", alike.mean, np.ones(n))
        _close("identical bounds", alike.covariance, bounds[0])
        # The mean is linear in the means, so unit means give the gain of each input.
        units = np.moveaxis(np.eye(count * n).reshape(count * n, count, n), 1, 0)
        together = _fused(rule, units, np.broadcast_to(bounds[:, None], (count, count * n, n, n)))
        _close("fusing inside vmap", together.mean[0], _fused(rule, units[:, 0], bounds).mean)
        gains = np.asarray(together.mean).T
        if rule.claim(["upper"] * count) == "upper":
            excess = gains @ joint.reshape(count * n, count * n) @ gains.T - together.covariance[0]
            worst = np.linalg.eigvalsh(excess)[-1]
            limit = ROUNDING * np.trace(together.covariance[0])
            assert worst <= limit, f"bound: expected an upper one, exceeded by {worst:g}"


def _fused(rule: AbstractFusion, means: np.ndarray, bounds: np.ndarray) -> Estimate:
    return fuse(rule, [Estimate(m, b, "upper") for m, b in zip(means, bounds, strict=True)])


def _close(what: str, result: Array, expected: Array) -> None:
    gap = np.abs(np.asarray(result) - expected).max()
    assert gap <= SEARCHED * np.abs(expected).max(), f"{what}: expected the same back, off by {gap:g}"
