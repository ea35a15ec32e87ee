"""Random covariances, and estimates that claim them, for tests of fusion."""

import numpy as np

import heliograph as hg


def covariances(seed, count, n, spread=1.0):
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(count, n, n)) * 10 ** rng.uniform(-spread, spread, size=(count, 1, n))
    return factors @ factors.swapaxes(-1, -2) + 1e-3 * np.eye(n)


def estimates(bounds, claim="upper", seed=0):
    means = np.random.default_rng(seed).normal(size=bounds.shape[:-1])
    return [hg.model.Estimate(m, b, claim) for m, b in zip(means, bounds, strict=True)]
