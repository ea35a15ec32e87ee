"""What the paper states, beside what is found here."""

from collections.abc import Callable, Mapping

import numpy as np

from heliograph.random_affine.moments.moment_noise import NoiseMoments
from heliograph_studies.quadratic_bias.bounds import Bound
from heliograph_studies.quadratic_bias.compute import CLAIMED, TRUE, Outcome
from heliograph_studies.quadratic_bias.setting import TABLE_1, Noises
from heliograph_studies.statement import Evidence, Sampled, Statement, Verdict, holds, if_met

ROUNDING = 1e-12  # relative, of covariances computed in two ways
HALF_A_DIGIT = 5.5e-5  # four digits are printed; the laws are given exactly


def statements(outcome: Outcome) -> Mapping[str, list[Statement]]:
    """All statements that the example and the scenario speak to."""
    return {"paper": [_better(outcome), *_optimal(outcome), _moments(), _table(), *_bounds(outcome)]}


def _better(outcome: Outcome) -> Statement:
    example = outcome.example
    states = example.model.states[:2]
    gain = [example.gain_percent[TRUE][state] for state in states]
    ratio = [example.covariance[TRUE][state][1:] / example.covariance["linear"][state][1:] for state in states]
    worst = float((1 - np.array(ratio)).min() * 100)
    ours = f"{gain[0]:.1f} % (x1) and {gain[1]:.1f} % (x2) less variance; at every step, at least {worst:.1f} %"
    return Statement(
        "The quadratic filter beats the linear one in the example", "Figs 3-6", "no numbers", ours,
        {"least_gain_percent": worst},
        lambda least_gain_percent: holds(least_gain_percent > 0),
    )  # fmt: skip


def _optimal(outcome: Outcome) -> list[Statement]:
    example, outage, names = outcome.example, outcome.outage, (CLAIMED, TRUE, "quadratic")
    claimed, true, best = (example.mean_covariance[name][example.model.states[0]] for name in names)
    exact = f"x1: claims {claimed:.6f}, has {true:.6f}; V_t is correlated with the state once powers are random"
    loss = 100 * (true / best - 1)
    out = [-outage.gain_percent[name]["x"] for name in names]
    beyond = outage.monte_carlo[TRUE]["minus_linear"]
    excess = Sampled(beyond["x"], beyond["x_se"])
    scenario = (
        f"with outages and rare shocks it claims {out[0]:+.1f} % against linear and has {out[1]:+.1f} % (simulated "
        f"difference {excess.value:.2f} ± {excess.error:.2f}); repaired: {out[2]:+.1f} %"
    )
    ours = f"example: {loss:.1e} % above the best quadratic filter; {scenario}"
    return [
        Statement("(31), (36) are the error covariance", "Theorems 1 and 2", "exact", exact,
                  {"claimed": claimed, "true": true},
                  lambda claimed, true: holds(abs(true - claimed) <= ROUNDING * claimed)),
        Statement("(35) minimises it", "Theorem 2", "optimal among quadratic filters", ours,
                  {"true": true, "best": best, "excess_over_linear_with_outages": excess},
                  lambda true, best, excess_over_linear_with_outages: holds(
                      true <= best * (1 + ROUNDING) and excess_over_linear_with_outages.at_most(0))),
    ]  # fmt: skip


def _moments() -> Statement:
    ours = [[getattr(Noises(), name).law().moment((k,)) for k in (2, 3, 4)] for name in TABLE_1]
    gap = float(np.max(np.abs(np.array(ours) - np.array(list(TABLE_1.values())))))
    return Statement(
        "The noises have the moments of Table 1", "Table 1", "four digits", f"largest gap {gap:.1e}",
        {"largest_gap": gap},
        lambda largest_gap: holds(largest_gap < HALF_A_DIGIT),
    )  # fmt: skip


def _table() -> Statement:
    refused = []
    for name, moments in TABLE_1.items():
        try:
            NoiseMoments([0.0, *moments])
        except ValueError:
            refused.append(name)
    names = ", ".join(refused)
    ours = f"rounded to four digits, those of {names} belong to no distribution; the laws themselves are used"
    return Statement("Table 1 can stand in for the laws", "Table 1", "implied", ours,
                     {"belong_to_no_distribution": len(refused)},
                     lambda belong_to_no_distribution: holds(belong_to_no_distribution == 0))  # fmt: skip


def _bounds(outcome: Outcome) -> list[Statement]:
    b = outcome.bounds
    ours = f"does not apply to the example: {b.lower.reason}"
    end = f"{b.growth.value:.2g} at t = {outcome.example.model.horizon}, where P has {b.growth.actual:.3f}"
    grows = f"{end}; {b.growth.reason}"
    instead = f"P_t <= Cov(X_t): {b.covariance.value:.4f}, reached to {b.covariance.actual:.4f}; {b.covariance.reason}"
    return [
        Statement("P_t >= beta I", "Theorem 3", "under Assumptions 1 and 2", ours, *_bound(b.lower, -1)),
        Statement("P_t is bounded from above", "Theorem 4", "if q_a < 1", f"{grows}. What holds: {instead}",
                  *_bound(b.growth, 1)),
        Statement("P_t is bounded from above", "Theorem 5", "by a window", b.window.reason, *_bound(b.window, 1)),
    ]  # fmt: skip


def _bound(bound: Bound, side: int) -> tuple[Evidence, Callable[..., Verdict]]:
    """Whether its assumptions are met, and by how much it is kept, relative to itself: from above (1) or below (-1)."""
    evidence: dict[str, float | Sampled] = {"applies": int(bound.applies)}
    if bound.applies:
        evidence["slack"] = side * (bound.value - bound.actual) / bound.value
    return evidence, lambda applies, slack=0.0: if_met(applies) if slack >= -ROUNDING else "fails"
