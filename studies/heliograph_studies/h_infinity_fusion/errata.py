"""Errata, and theorems judged: each statement is one that the paper makes or needs."""

import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion.compute import Parts
from heliograph_studies.h_infinity_fusion.example import RECURSIVE
from heliograph_studies.h_infinity_fusion.levels import published_fused_level
from heliograph_studies.h_infinity_fusion.setting import PAPER_FUSED_LEVEL, PAPER_WEIGHTS
from heliograph_studies.statement import Sampled, Statement, holds

ROUNDING = 1e-12
ATTAINED = 1 + 1e-9  # but for the rounding of a ratio that attains it


def errata(result: Parts) -> list[Statement]:
    """In the order of the paper."""
    return [*_growth(result), *_theorems(result), *_fusion(result), *_quantizer(result)]


def _growth(result: Parts) -> list[Statement]:
    outcome, true = result.growth, result.true_growth
    false = [s for s, finding in enumerate(outcome.visited) if finding.refuted]
    happened = np.flatnonzero(outcome.secant > result.setting.growth).tolist()
    local, worst = result.nodes[0].horizon.level, result.broken
    return [
        Statement("v_s = 0.4 cos(0.8 s) / sqrt(s) from s = 0", "Section IV", "a disturbance of finite energy",
            "v_0 = inf; sqrt(s + 1) is used here, as in the other noises", {"first_divisor": float(np.sqrt(0.0))},
            lambda first_divisor: holds(first_divisor > 0)),
        Statement("|f(x)| <= 0.7 |x|", "(2) at xhat = 0", "a = 0.7", outcome.size.text,
            {"largest_ratio": outcome.size.ratio, "constant": result.setting.growth},
            lambda largest_ratio, constant: holds(largest_ratio <= constant * ATTAINED)),
        Statement("|f(x) - f(xhat)| <= 0.7 |x - xhat|", "(2), Section IV", "a = 0.7",
            f"false: {outcome.whole.text}. Around what the runs visited, slopes reach {outcome.slopes.max():.4f} and a "
            f"pair breaks 0.7 at {len(false)} of {result.setting.steps} steps; estimates of the runs themselves break "
            f"it at s = {happened}, with {outcome.secant.max():.3f}",
            {"largest_slope": max(outcome.whole.ratio, outcome.whole.slope), "steps_that_break_it": len(false),
             "constant": result.setting.growth},
            lambda largest_slope, steps_that_break_it, constant: holds(
                largest_slope <= constant * ATTAINED and steps_that_break_it == 0)),
        Statement("the guarantee of Theorem 1 in the example", "Section IV", "from a = 0.7",
            f"node 1, best gains: guaranteed {local:.5f}, but a disturbance exists with {worst.level:.5f} ± "
            f"{worst.standard_error:.1g}", {"guaranteed": local, "outcome": Sampled(worst.level, worst.standard_error)},
            lambda guaranteed, outcome: holds(outcome.at_most(guaranteed))),
        Statement("levels can be guaranteed where state and estimates go", "not in the paper", "",
            f"with slopes that the search did not refute there: one constant {true.constant.min():.4f} to "
            f"{true.constant.max():.4f}; a slope for each step {true.each_step[:, 0].min():.4f} to "
            f"{true.each_step[:, 0].max():.4f}, with separate multipliers {true.each_step[:, 1].min():.4f} to "
            f"{true.each_step[:, 1].max():.4f}; below the paper's levels by far",
            {"largest_level": float(true.constant.max()), "certified": int(true.certified),
             "least_level": min(result.setting.levels)},
            lambda largest_level, certified, least_level: holds(certified and largest_level < least_level)),
    ]  # fmt: skip


def _theorems(result: Parts) -> list[Statement]:
    dead = [n.failed["none"] for n in result.nodes]
    known = [n.failed[o] for n in result.nodes for o in n.failed if o != "none"]
    spreads = _spreads(1.0, 1.0, 1.0)
    return [
        Statement("(18) is E V(next) - V plus the terms of growth and level", "Theorem 1", "exact",
            "with random gains and weights it agrees with the eight outcomes of the losses, counted, to "
            f"{result.enumeration:.1g}",
            {"gap": result.enumeration}, lambda gap: holds(gap < ROUNDING)),
        Statement("any solution of (32) lets the recursion go on", "Theorem 2", "solvable step by step",
            f"a solver asked for any solution finds none at s = {dead} of 0 ... 15; the smallest trace or largest "
            "eigenvalue of L, or the largest det P, gets through at every node",
            {"nodes_stuck": sum(d is not None for d in dead),
             "nodes_stuck_with_an_objective": sum(k is not None for k in known)},
            lambda nodes_stuck, nodes_stuck_with_an_objective: holds(
                nodes_stuck == nodes_stuck_with_an_objective == 0)),
        Statement("(32) serves every arrival probability", "(32), (4)", "divides by variances",
            f"with certain arrivals the divisors are {', '.join(f'{s:g}' for s in spreads)}; written with the factors "
            f"beside the gains it has no division, and node 1 then has the level {result.readings.lossless:.5f}",
            {"least_divisor": min(spreads)}, lambda least_divisor: holds(least_divisor > 0)),
    ]  # fmt: skip


def _spreads(p1: float, p2: float, p3: float) -> tuple[float, ...]:
    """Theta, theta* - Theta, beta_3*, beta_2* - Theta of (32)."""
    both = p1 * p2
    cross = both * (1 - p2)
    return cross, both * (1 - both) - cross, p3 * (1 - p3), p2 * (1 - p2) - cross


def _fusion(result: Parts) -> list[Statement]:
    gamma = np.array(result.setting.levels)
    c = hg.fusion.level_weights(gamma)
    best, paper, minkowski = result.fused_level, result.level_of_paper_weights(), result.minkowski
    edge = np.block(
        [[np.full((1, 1), -(best**2) / (2 * len(c))), (c * gamma)[None]], [(c * gamma)[:, None], -np.eye(4)]]
    )
    top = float(np.linalg.eigvalsh(edge)[-1])
    item = published_fused_level([gamma[0]], [1.0]) / gamma[0]
    return [
        Statement("the fused level is 2.5419", "Section IV", f"{PAPER_FUSED_LEVEL}",
            f"{paper:.5f} with the printed weights, once they sum to 1 ({result.level_of_paper_weights(False):.5f} "
            "as printed)", {"level": paper},
            lambda level: holds(abs(level - PAPER_FUSED_LEVEL) < 5e-5)),
        Statement("the printed weights are optimal", "Theorem 4, Section IV",
            ", ".join(map(str, PAPER_WEIGHTS)),
            f"c proportional to 1 / gamma^2, {', '.join(f'{w:.6f}' for w in c)}, gives {best:.6f}; the printed ones "
            f"differ at nodes 1 and 3, whose levels are equal", {"printed": paper, "best": best},
            lambda printed, best: holds(printed <= best * (1 + ROUNDING))),
        Statement("the minimum of (38) is attained", "Theorem 4", "solvable",
            f"at the optimum (33) has the largest eigenvalue {top:.1g}, not a negative one: an infimum; no solver is "
            "needed, since it is known in closed form", {"largest_eigenvalue": top},
            lambda largest_eigenvalue: holds(largest_eigenvalue < -ROUNDING)),
        Statement("fusing improves the guarantee", "Theorem 3", "2.5419",
            f"{best:.4f} is above every local level (at most {gamma.max():g}), and for a single node the bound is "
            f"{item:.4f} times its own level; the triangle inequality gives {minkowski:.4f} without quantization, and "
            f"the best node alone {gamma.min():g}", {"fused": best, "best_node": float(gamma.min())},
            lambda fused, best_node: holds(fused < best_node)),
    ]  # fmt: skip


def _quantizer(result: Parts) -> list[Statement]:
    sent, outcome = result.replayed, result.runs
    share, late = 100 * result.saturated("dynamic"), 100 * result.saturated("dynamic", 7)
    away = [int(s) for s in np.flatnonzero(sent.broken_local > 0)]
    printed, ours = (outcome.mean_error(RECURSIVE, q)[0] for q in ("dynamic", "dynamic_decodable"))
    symbols = outcome.record.uplinks[f"{RECURSIVE}.dynamic_decodable"].symbols_per_value()
    return [
        Statement("|mu| <= u d / p", "(13)", "always",
            f"not where it saturates: {share:.1f} % of samples, {late:.1f} % from s = 7 on, where |mu| is up to "
            f"{sent.excess:.0f} times that; d follows x^2 and x tends to zero", {"largest_ratio": float(sent.excess)},
            lambda largest_ratio: holds(largest_ratio <= 1 + 1e-9)),
        Statement("the quantization terms are below Lambda", "(35)", "always",
            f"false at some node at s = {away}; there in {100 * sent.broken_local[away].min():.0f} to "
            f"{100 * sent.broken_local.max():.0f} % of runs", {"largest_share_of_runs": float(sent.broken_local.max())},
            lambda largest_share_of_runs: holds(largest_share_of_runs == 0)),
        Statement("the fused error obeys (36)", "(36)", "always",
            f"false in up to {100 * sent.broken_fused.max():.0f} % of runs at a step",
            {"largest_share_of_runs": float(sent.broken_fused.max())},
            lambda largest_share_of_runs: holds(largest_share_of_runs == 0)),
        Statement("the fusion centre can decode", "(12)", "implied",
            "d is driven by the unquantized estimate; a receiver that drives it by what it gets is off by up to "
            f"{100 * sent.astray:.0f} %. Driven by what was sent, with an escape symbol: mean fused error {ours:.4f} "
            f"({printed:.4f} as printed), saturated {100 * result.saturated('dynamic_decodable'):.0f} %, "
            f"{symbols:.4f} symbols a value", {"receiver_off_by": float(sent.astray)},
            lambda receiver_off_by: holds(receiver_off_by < ROUNDING)),
    ]  # fmt: skip
