"""The level that Theorems 3 and 4 give a weighted fusion."""

from collections.abc import Sequence

import numpy as np


def published_fused_level(levels: Sequence[float], weights: Sequence[float] | np.ndarray) -> float:
    """sqrt(2 N sum c_i^2 gamma_i^2) for N filters; it exceeds every local level where those are alike.

    `hg.fusion.level_weights` are its minimum on the simplex. A strict matrix inequality has that minimum as its infimum
    only, so solvers approach it without reaching it.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equation (33).
    """
    c, gamma = np.asarray(weights), np.asarray(levels)
    return float(np.sqrt(2 * len(gamma) * np.sum((c * gamma) ** 2)))
