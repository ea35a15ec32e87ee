"""Time of H-infinity design on the published example: a re-solved recursive inequality, and the whole horizon.

Run: python benchmarks/h_infinity.py. Prints milliseconds; the limits are 8 (median) and 300.
"""

import time
from typing import Any

import numpy as np
from alone import milliseconds, show

import heliograph as hg

REPEATS = 5
STEP_LIMIT, HORIZON_LIMIT = 8, 300  # milliseconds


def system() -> hg.h_infinity.GrowthSystem:
    """Node 1 of the publication."""
    hops = [
        hg.hop(hg.random_affine.bernoulli(p), c**2, power)
        for p, c, power in ((0.8, 0.1, 1.0), (0.75, 0.1, 1.0), (0.7, 0.15, 2.0))
    ]
    channel = hg.model.with_direct_link(hg.amplify_and_forward(hops[:2]), hops[2])
    b = 0.15 * np.sqrt(2)
    return hg.h_infinity.growth_system(
        16, [[-0.15], [0.15]], [[0.3]], [[0.05, 0.05]], channel, 0.7, b, initial_weight=15.0
    )


def recursion() -> tuple[float, float]:
    """First and median solve of the steps of a recursive design."""
    from heliograph.h_infinity.solver import StepProblem

    results: list[float] = []
    solve = StepProblem.solve

    def timed(self: StepProblem, fixed: np.ndarray) -> object:
        start = time.perf_counter()
        result = solve(self, fixed)
        results.append(1e3 * (time.perf_counter() - start))
        return result

    StepProblem.solve = timed
    try:
        for _ in range(REPEATS):
            hg.h_infinity.recursive_design(system(), 1.8, 10 * np.eye(4))
    finally:
        StepProblem.solve = solve
    return results[0], float(np.median([t for i, t in enumerate(results) if i % 16]))


def measure() -> dict[str, Any]:
    """Medians, but for the first solve and the worst horizon."""
    first, median = recursion()
    horizon = [milliseconds(lambda: hg.h_infinity.horizon_design(system())) for _ in range(REPEATS)]
    separate = [milliseconds(lambda: hg.h_infinity.horizon_design(system(), separate=True)) for _ in range(REPEATS)]
    values = {
        "recursive inequality, first": first,
        "recursive inequality, re-solved": median,
        "whole horizon": float(np.median(horizon)),
        "whole horizon, worst": max(horizon),
        "separate multipliers": float(np.median(separate)),
        "separate multipliers, worst": max(separate),
    }
    limits = {"recursive inequality, re-solved": STEP_LIMIT, "whole horizon": HORIZON_LIMIT}
    return {"unit": "ms", "values": values, "at_most": limits}


if __name__ == "__main__":
    show(measure())
