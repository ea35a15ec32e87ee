"""What the paper states of its example, beside what is found here; errata are in `errata.py`."""

import numpy as np

from heliograph.papers.h_infinity_fusion import setting
from heliograph.papers.h_infinity_fusion.compute import Reproduction
from heliograph.papers.h_infinity_fusion.discriminating import NODE
from heliograph.papers.h_infinity_fusion.errata import errata
from heliograph.papers.h_infinity_fusion.example import RECURSIVE
from heliograph.papers.h_infinity_fusion.indices import ZERO
from heliograph.papers.h_infinity_fusion.losses import arrivals
from heliograph.papers.statement import Statement, holds, if_met

OURS = "not in the paper"
SIGNIFICANT = 3.0  # standard errors


def statements(result: Reproduction) -> list[Statement]:
    """All of them: the example, its figures, errata, and what the second example tells."""
    return [*_designs(result), *_indices(result), *_figures(result), *errata(result), *_second(result)]


def listed(values: object, digits: int = 4) -> str:
    """Numbers one after the other."""
    return ", ".join(f"{v:.{digits}g}" for v in np.ravel(np.asarray(values)))


def _designs(result: Reproduction) -> list[Statement]:
    nodes = result.nodes
    steps = [n.certificate.steps_certified for n in nodes]
    zero = [n.without_measurements for n in nodes]
    smallest, horizon = [n.smallest["trace"] for n in nodes], [n.horizon.level for n in nodes]
    ratio = [g / h for g, h in zip(setting.LEVELS, horizon, strict=True)]
    certified = all(n.certificate.certified for n in nodes)
    return [
        Statement("the inequalities can be solved at the paper's levels", "Section IV", "gamma = 1.8, 1.7, 1.8, 1.9",
            f"with the smallest trace of L at each step: {listed(steps)} of {setting.STEPS} steps certified, for the "
            "growth constants as printed", holds(certified)),
        Statement("the levels measure how well the filters reject disturbances", "Section IV", "1.7 to 1.9",
            f"K = 0, which hears nothing, has {zero[0]:.6f} at every node; the smallest levels over the horizon are "
            f"{listed(horizon)}, {min(ratio):.0f} to {max(ratio):.0f} times below the paper's (recursive: "
            f"{listed(smallest)}; with P_0 = 10 I, {result.readings.fixed_start:.5f} for all, by (19) alone)",
            if_met(max(zero) > min(setting.LEVELS))),
        Statement("the smallest level needs the measurements", OURS, "implied",
            f"largest gain over K = 0 {100 * (1 - min(horizon) / zero[0]):.1f} %, all of it through D: with D = 0, "
            f"{result.readings.without_feedthrough[0]:.6f} with the best gains of node 1 and "
            f"{result.readings.without_feedthrough[1]:.6f} without any",
            holds(result.readings.without_feedthrough[0] < result.readings.without_feedthrough[1] * (1 - 1e-4))),
        Statement("one multiplier for f and f~ costs nothing", "(18)", "implied",
            f"with one for each, {listed([n.separate.level for n in nodes], 5)}; at a = 1.1, "
            f"{listed(result.readings.larger_growth[:, 1], 3)} instead of "
            f"{listed(result.readings.larger_growth[:, 0], 3)}",
            holds(all(n.horizon.level <= n.separate.level * (1 + 1e-4) for n in nodes))),
    ]  # fmt: skip


def _indices(result: Reproduction) -> list[Statement]:
    local, fused = result.indices.local, result.indices.fused
    both = [RECURSIVE, "zero_gain", ZERO]
    below = all(np.all(local[name] < 0) for name in both), all(fused[name] < 0 for name in both)
    return [
        Statement("J_1 < 0 at every node", "(9), Theorem 1", "negative",
            f"{listed(local[RECURSIVE])}; with K = 0 {listed(local['zero_gain'])}, with xhat = 0 "
            f"{listed(local[ZERO])}: the weight of the initial state decides",
            if_met(not below[0]) if np.all(local[RECURSIVE] < 0) else "fails"),
        Statement("J_2 < 0", "(17), Theorem 3", "negative",
            f"{fused[RECURSIVE]:.1f} where the fused error has energy {result.indices.fused_energy[RECURSIVE]:.2g}; "
            f"with K = 0 {fused['zero_gain']:.1f}, with xhat = 0 {fused[ZERO]:.1f}",
            if_met(not below[1]) if fused[RECURSIVE] < 0 else "fails"),
    ]  # fmt: skip


def _figures(result: Reproduction) -> list[Statement]:
    outcome = result.outcome
    error = {name: outcome.mean_error(name, "none") for name in outcome.filters}
    own, none = error[RECURSIVE][0], error["zero_gain"][0]
    largest = [float(np.max(np.abs(node.paper.gains))) for node in result.nodes]
    seen = arrivals(outcome)
    shares = np.nanmean(seen, axis=(0, 1, 2))
    count = np.sum(np.isfinite(seen), axis=(0, 1, 2))
    off = np.abs(shares - setting.ARRIVAL) / np.sqrt(
        np.array(setting.ARRIVAL) * (1 - np.array(setting.ARRIVAL)) / count
    )
    gap, gap_error, better = result.difference("dynamic", "static")
    odd, odd_error, _ = result.difference("dynamic", "static_p41")
    by_step = (outcome.errors(RECURSIVE, "dynamic") - outcome.errors(RECURSIVE, "static")).mean(axis=0)
    worse = np.flatnonzero(by_step > 0).tolist()
    even, second = outcome.mean_error(RECURSIVE, "static")[0], outcome.mean_error(RECURSIVE, "static_p41")[0]
    return [
        Statement("the estimates track the state", "Figs 2 to 6", "well",
            f"mean fused error {own:.4f}; but {none:.4f} with K = 0: the plant forgets by itself, and the levels say "
            f"nothing about it (horizon design, guaranteed lower: {error['horizon'][0]:.4f}). Largest entries of the "
            f"gains by node: {listed(largest, 2)}",
            if_met(own < none / 2)),
        Statement("losses as stated", "Figs 7 to 9", "arrival 0.8, 0.75, 0.7",
            f"{listed(shares)}, at most {off.max():.1f} standard errors off", holds(off.max() < 4)),
        Statement("the fused error stays small behind the dynamic quantizer", "Fig. 10", "works well",
            f"mean {outcome.mean_error(RECURSIVE, 'dynamic')[0]:.4f}, unquantized {own:.4f}",
            holds(outcome.mean_error(RECURSIVE, "dynamic")[0] < 1.2 * own)),
        Statement("dynamic quantization beats static", "Figs 10 and 11", "better",
            f"difference of mean fused errors {gap:.5f} ± {gap_error:.5f}, better in {100 * better:.1f} % of runs, "
            f"worse at s = {worse}", holds(gap < -SIGNIFICANT * gap_error)),
        Statement("it does so because the amplitude adapts", "Remark 3", "flexibility",
            f"mostly not: p = 40 is even, so zero is no level and the static quantizer cannot say that x is small; "
            f"with p = 41 it has {second:.4f} in place of {even:.4f}, and the gap shrinks to {odd:.5f} ± "
            f"{odd_error:.5f}", holds(abs(odd) > abs(gap) / 2)),
    ]  # fmt: skip


def _second(result: Reproduction) -> list[Statement]:
    second = result.discriminating
    guaranteed, worst = second.designs["horizon"][NODE].level, second.worst
    kalman = min(worst[name].level - SIGNIFICANT * worst[name].standard_error
                 for name in ("ekf_statistics", "ekf_ignoring"))  # fmt: skip
    white, bias, resonant = (second.errors[s] for s in ("white", "bias", "resonant"))
    alone = second.local_errors["white"]
    flat = second.without_structure[NODE]
    return [
        Statement("the second example's levels are certified", OURS, "", "at " + listed([
            c.level for c in second.certificates.values()]) + f"; {second.finding.text}",
              holds(all(c.certified for c in second.certificates.values()))),
        Statement("H-infinity design guarantees what extended Kalman filters do not reach", OURS, "",
            f"node {NODE}: guaranteed {guaranteed:.3f} (found at worst {worst['horizon'].level:.3f}); disturbances "
            f"exist for which Kalman filters have {worst['ekf_statistics'].level:.3f} (statistics) and "
            f"{worst['ekf_ignoring'].level:.3f} (ignoring)", holds(kalman > guaranteed)),
        Statement("it errs less under a resonant disturbance", OURS, "",
            f"mean fused error {_pair(resonant['horizon'])}; Kalman filters {_pair(resonant['ekf_statistics'])} "
            f"(statistics), {_pair(resonant['ekf_told'])} (told)",
            holds(_below(resonant["horizon"], resonant["ekf_told"]))),
        Statement("it errs less under white noise", OURS, "",
            f"{_pair(white['horizon'])} against {_pair(white['ekf_statistics'])}; the recursive design "
            f"{_pair(white['recursive'])}. Node {NODE} alone: {_pair(alone['horizon'])}, Kalman "
            f"filter {_pair(alone['ekf_statistics'])}, nothing heard {_pair(alone['zero_gain'])}",
            holds(_below(white["horizon"], white["ekf_statistics"]))),
        Statement("it errs less under a constant bias", OURS, "",
            f"{_pair(bias['horizon'])} against {_pair(bias['ekf_statistics'])}",
            holds(_below(bias["horizon"], bias["ekf_statistics"]))),
        Statement("knowing A buys a level", OURS, "",
            f"node {NODE}: {guaranteed:.3f} with A known, {flat:.3f} with |A| + |phi| as one growth constant, where "
            f"K = 0 has {second.without_structure_or_gain:.3f}", holds(guaranteed < flat / 2)),
    ]  # fmt: skip


def _pair(value: tuple[float, float]) -> str:
    return f"{value[0]:.3f} ± {value[1]:.3f}"


def _below(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] - other[0] < -SIGNIFICANT * float(np.hypot(one[1], other[1]))
