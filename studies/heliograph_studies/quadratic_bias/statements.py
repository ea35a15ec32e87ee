"""What the paper states, beside what is found here."""

from collections.abc import Callable

import numpy as np

from heliograph.random_affine.moment_noise import NoiseMoments
from heliograph_studies.quadratic_bias import setting
from heliograph_studies.quadratic_bias.bounds import Bound
from heliograph_studies.quadratic_bias.compute import (
    CLAIMED,
    TRUE,
    Reproduction,
    gain_percent,
    settled_mean,
    simulated_mean,
)
from heliograph_studies.statement import Evidence, Sampled, Statement, Verdict, holds, if_met

ROUNDING = 1e-12  # relative, of covariances computed in two ways
HALF_A_DIGIT = 5.5e-5  # four digits are printed; the laws are given exactly


def statements(result: Reproduction) -> list[Statement]:
    """All statements that the example and the scenario speak to."""
    return [_better(result), *_optimal(result), _moments(), _table(), *_bounds(result)]


def _better(result: Reproduction) -> Statement:
    gain = gain_percent(result.example, TRUE)
    covariance = result.example.designs.covariance
    ratio = [np.diagonal(covariance[name][1:, :2, :2], axis1=1, axis2=2) for name in (TRUE, "linear")]
    worst = float((1 - ratio[0] / ratio[1]).min() * 100)
    ours = f"{gain[0]:.1f} % (x1) and {gain[1]:.1f} % (x2) less variance; at every step, at least {worst:.1f} %"
    return Statement(
        "The quadratic filter beats the linear one in the example", "Figs 3-6", "no numbers", ours,
        {"least_gain_percent": worst},
        lambda least_gain_percent: holds(least_gain_percent > 0),
    )  # fmt: skip


def _optimal(result: Reproduction) -> list[Statement]:
    example, outage = result.example, result.outage
    claimed, true, best = (settled_mean(example, n)[0] for n in (CLAIMED, TRUE, "quadratic"))
    exact = f"x1: claims {claimed:.6f}, has {true:.6f}; V_t is correlated with the state once powers are random"
    loss = 100 * (true / best - 1)
    out = -gain_percent(outage, CLAIMED)[0], -gain_percent(outage, TRUE)[0], -gain_percent(outage, "quadratic")[0]
    difference, error = simulated_mean(outage, TRUE, "linear")
    scenario = (
        f"with outages and rare shocks it claims {out[0]:+.1f} % against linear and has {out[1]:+.1f} % (simulated "
        f"difference {difference[0]:.2f} ± {error[0]:.2f}); repaired: {out[2]:+.1f} %"
    )
    ours = f"example: {loss:.1e} % above the best quadratic filter; {scenario}"
    return [
        Statement("(31), (36) are the error covariance", "Theorems 1 and 2", "exact", exact,
                  {"claimed": claimed, "true": true},
                  lambda claimed, true: holds(abs(true - claimed) <= ROUNDING * claimed)),
        Statement("(35) minimises it", "Theorem 2", "optimal among quadratic filters", ours,
                  {"true": true, "best": best, "excess_over_linear_with_outages": Sampled(difference[0], error[0])},
                  lambda true, best, excess_over_linear_with_outages: holds(
                      true <= best * (1 + ROUNDING) and excess_over_linear_with_outages.at_most(0))),
    ]  # fmt: skip


def _moments() -> Statement:
    ours = [[noise.moment((k,)) for k in (2, 3, 4)] for noise in setting.NOISES.values()]
    gap = float(np.max(np.abs(np.array(ours) - np.array([setting.TABLE_1[name] for name in setting.NOISES]))))
    return Statement(
        "The noises have the moments of Table 1", "Table 1", "four digits", f"largest gap {gap:.1e}",
        {"largest_gap": gap},
        lambda largest_gap: holds(largest_gap < HALF_A_DIGIT),
    )  # fmt: skip


def _table() -> Statement:
    refused = []
    for name, moments in setting.TABLE_1.items():
        try:
            NoiseMoments([0.0, *moments])
        except ValueError:
            refused.append(name)
    names = ", ".join(refused)
    ours = f"rounded to four digits, those of {names} belong to no distribution; the laws themselves are used"
    return Statement("Table 1 can stand in for the laws", "Table 1", "implied", ours,
                     {"belong_to_no_distribution": len(refused)},
                     lambda belong_to_no_distribution: holds(belong_to_no_distribution == 0))  # fmt: skip


def _bounds(result: Reproduction) -> list[Statement]:
    b = result.bounds
    ours = f"does not apply to the example: {b.lower.reason}"
    end = f"{b.growth.value:.2g} at t = {result.example.model.horizon}, where P has {b.growth.actual:.3f}"
    grows = f"{end}; {b.growth.reason}"
    instead = f"P_t <= Cov(X_t): {b.covariance.value:.4f}, reached to {b.covariance.actual:.4f}; {b.covariance.reason}"
    return [
        Statement("P_t >= beta I", "Theorem 3", "under Assumptions 1 and 2", ours, *_bound(b.lower, -1)),
        Statement("P_t is bounded from above", "Theorem 4", "if q_a < 1", f"{grows}. What holds: {instead}",
                  *_bound(b.growth, 1)),
        Statement("P_t is bounded from above", "Theorem 5", "by a window", b.window.reason, *_bound(b.window, 1)),
    ]  # fmt: skip


def _bound(found: Bound, side: int) -> tuple[Evidence, Callable[..., Verdict]]:
    """Whether its assumptions are met, and by how much it is kept, relative to itself: from above (1) or below (-1)."""
    evidence: dict[str, float | Sampled] = {"applies": int(found.applies)}
    if found.applies:
        evidence["slack"] = side * (found.value - found.actual) / found.value
    return evidence, lambda applies, slack=0.0: if_met(applies) if slack >= -ROUNDING else "fails"
