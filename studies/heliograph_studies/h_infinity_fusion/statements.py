"""What the paper states of its example, beside what is found here; errata are in `errata.py`."""

import numpy as np

from heliograph_studies.h_infinity_fusion.compute import Outcome, Parts
from heliograph_studies.h_infinity_fusion.discriminating import NODE
from heliograph_studies.h_infinity_fusion.errata import errata
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, arrivals
from heliograph_studies.h_infinity_fusion.indices import ZERO
from heliograph_studies.statement import Sampled, Statement, holds, if_met, vacuous

OURS = "not in the paper"
LITTLE = 1e-4  # relative: what bisection and the solver leave open


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """All of them: the example, its figures, errata, and what the second example tells."""
    parts = _designs, _indices, _figures, errata, _second
    return {"paper": [statement for part in parts for statement in part(outcome.parts)]}


def listed(values: object, digits: int = 4) -> str:
    """Numbers one after the other."""
    return ", ".join(f"{v:.{digits}g}" for v in np.ravel(np.asarray(values)))


def _designs(result: Parts) -> list[Statement]:
    nodes = result.nodes
    steps = [n.certificate.steps_certified for n in nodes]
    zero = [n.without_measurements for n in nodes]
    smallest, horizon = [n.smallest["trace"] for n in nodes], [n.horizon.level for n in nodes]
    ratio = [g / h for g, h in zip(result.setting.levels, horizon, strict=True)]
    return [
        Statement("the inequalities can be solved at the paper's levels", "Section IV", "gamma = 1.8, 1.7, 1.8, 1.9",
            f"with the smallest trace of L at each step: {listed(steps)} of {result.setting.steps} steps certified, "
            "for the growth constants as printed",
            {"fewest_steps_certified": min(steps), "steps": result.setting.steps},
            lambda fewest_steps_certified, steps: holds(fewest_steps_certified == steps)),
        Statement("the levels measure how well the filters reject disturbances", "Section IV", "1.7 to 1.9",
            f"K = 0, which receives nothing, has {zero[0]:.6f} at every node; the smallest levels over the horizon are "
            f"{listed(horizon)}, {min(ratio):.0f} to {max(ratio):.0f} times below the paper's (recursive: "
            f"{listed(smallest)}; with P_0 = 10 I, {result.readings.fixed_start:.5f} for all, by (19) alone)",
            {"level_of_receiving_nothing": max(zero), "least_level": min(result.setting.levels)},
            lambda level_of_receiving_nothing, least_level: if_met(level_of_receiving_nothing > least_level)),
        Statement("the smallest level needs the measurements", OURS, "implied",
            f"largest gain over K = 0 {100 * (1 - min(horizon) / zero[0]):.1f} %, all of it through D: with D = 0, "
            f"{result.readings.without_feedthrough[0]:.6f} with the best gains of node 1 and "
            f"{result.readings.without_feedthrough[1]:.6f} without any",
            {"best_gains": result.readings.without_feedthrough[0], "no_gains": result.readings.without_feedthrough[1]},
            lambda best_gains, no_gains: holds(best_gains < no_gains * (1 - LITTLE))),
        Statement("one multiplier for f and f~ costs nothing", "(18)", "implied",
            f"with one for each, {listed([n.separate.level for n in nodes], 5)}; at a = 1.1, "
            f"{listed(result.readings.larger_growth[:, 1], 3)} instead of "
            f"{listed(result.readings.larger_growth[:, 0], 3)}",
            {"largest_ratio": max(n.horizon.level / n.separate.level for n in nodes)},
            lambda largest_ratio: holds(largest_ratio <= 1 + LITTLE)),
    ]  # fmt: skip


def _indices(result: Parts) -> list[Statement]:
    local, fused = result.indices.local, result.indices.fused
    others = ("zero_gain", ZERO)
    blind = max(float(np.max(local[name])) for name in others), max(float(fused[name]) for name in others)
    return [
        Statement("J_1 < 0 at every node", "(9), Theorem 1", "negative",
            f"{listed(local[RECURSIVE])}; with K = 0 {listed(local['zero_gain'])}, with xhat = 0 "
            f"{listed(local[ZERO])}: the weight of the initial state decides",
            {"largest": float(np.max(local[RECURSIVE])), "largest_without_measurements": blind[0]},
            lambda largest, largest_without_measurements: vacuous(largest < 0, largest_without_measurements < 0)),
        Statement("J_2 < 0", "(17), Theorem 3", "negative",
            f"{fused[RECURSIVE]:.1f} where the fused error has energy {result.indices.fused_energy[RECURSIVE]:.2g}; "
            f"with K = 0 {fused['zero_gain']:.1f}, with xhat = 0 {fused[ZERO]:.1f}",
            {"index": float(fused[RECURSIVE]), "without_measurements": blind[1]},
            lambda index, without_measurements: vacuous(index < 0, without_measurements < 0)),
    ]  # fmt: skip


def _figures(result: Parts) -> list[Statement]:
    outcome = result.runs
    error = {name: outcome.mean_error(name, "none") for name in outcome.filters}
    local, none = error[RECURSIVE][0], error["zero_gain"][0]
    dynamic = outcome.mean_error(RECURSIVE, "dynamic")
    largest = [float(np.max(np.abs(node.paper.gains))) for node in result.nodes]
    seen = arrivals(outcome)
    shares = np.nanmean(seen, axis=(0, 1, 2))
    count = np.sum(np.isfinite(seen), axis=(0, 1, 2))
    off = np.abs(shares - result.setting.arrival) / np.sqrt(
        np.array(result.setting.arrival) * (1 - np.array(result.setting.arrival)) / count
    )
    gap, gap_error, better = result.difference("dynamic", "static")
    odd, odd_error, _ = result.difference("dynamic", "static_p41")
    by_step = (outcome.errors(RECURSIVE, "dynamic") - outcome.errors(RECURSIVE, "static")).mean(axis=0)
    worse = np.flatnonzero(by_step > 0).tolist()
    even, second = outcome.mean_error(RECURSIVE, "static")[0], outcome.mean_error(RECURSIVE, "static_p41")[0]
    return [
        Statement("the estimates track the state", "Figs 2 to 6", "well",
            f"mean fused error {local:.4f}; but {none:.4f} with K = 0: the plant forgets by itself, and the levels say "
            f"nothing about it (horizon design, guaranteed lower: {error['horizon'][0]:.4f}). Largest entries of the "
            f"gains by node: {listed(largest, 2)}",
            {"local": Sampled(*error[RECURSIVE]), "without_measurements": Sampled(*error["zero_gain"])},
            lambda local, without_measurements: if_met(local.value < without_measurements.value / 2)),
        Statement("losses as stated", "Figs 7 to 9", "arrival 0.8, 0.75, 0.7",
            f"{listed(shares)}, at most {off.max():.1f} standard errors off",
            {"standard_errors_off": float(off.max())}, lambda standard_errors_off: holds(standard_errors_off < 4)),
        Statement("the fused error stays small behind the dynamic quantizer", "Fig. 10", "works well",
            f"mean {dynamic[0]:.4f}, unquantized {local:.4f}",
            {"dynamic": Sampled(*dynamic), "unquantized": Sampled(*error[RECURSIVE])},
            lambda dynamic, unquantized: holds(dynamic.value < 1.2 * unquantized.value)),
        Statement("dynamic quantization beats static", "Figs 10 and 11", "better",
            f"difference of mean fused errors {gap:.5f} ± {gap_error:.5f}, better in {100 * better:.1f} % of runs, "
            f"worse at s = {worse}", {"difference": Sampled(gap, gap_error)},
            lambda difference: holds(difference.below(0))),
        Statement("it does so because the amplitude adapts", "Remark 3", "flexibility",
            "mostly not: p = 40 is even, so zero is no level and the static quantizer cannot say that x is small; "
            f"with p = 41 it has {second:.4f} in place of {even:.4f}, and the gap shrinks to {odd:.5f} ± "
            f"{odd_error:.5f}", {"even": Sampled(gap, gap_error), "odd": Sampled(odd, odd_error)},
            lambda even, odd: holds(abs(odd.value) > abs(even.value) / 2)),
    ]  # fmt: skip


def _second(result: Parts) -> list[Statement]:
    second = result.discriminating
    guaranteed, worst = second.designs["horizon"][NODE].level, second.worst
    kalman = {name: Sampled(worst[f"ekf_{name}"].level, worst[f"ekf_{name}"].standard_error)
              for name in ("statistics", "ignoring")}  # fmt: skip
    white, bias, resonant = (second.errors[s] for s in ("white", "bias", "resonant"))
    alone = second.local_errors["white"]
    flat = second.without_structure[NODE]
    return [
        Statement("the second example's levels are certified", OURS, "", "at " + listed([
            c.level for c in second.certificates.values()]) + f"; {second.finding.text}",
              {"not_certified": sum(not c.certified for c in second.certificates.values())},
              lambda not_certified: holds(not_certified == 0)),
        Statement("H-infinity design guarantees what extended Kalman filters do not reach", OURS, "",
            f"node {NODE}: guaranteed {guaranteed:.3f} (found at worst {worst['horizon'].level:.3f}); disturbances "
            f"exist for which Kalman filters have {worst['ekf_statistics'].level:.3f} (statistics) and "
            f"{worst['ekf_ignoring'].level:.3f} (ignoring)", {"guaranteed": guaranteed, **kalman},
            lambda guaranteed, statistics, ignoring: holds(
                not statistics.at_most(guaranteed) and not ignoring.at_most(guaranteed))),
        Statement("it errs less under a resonant disturbance", OURS, "",
            f"mean fused error {_pair(resonant['horizon'])}; Kalman filters {_pair(resonant['ekf_statistics'])} "
            f"(statistics), {_pair(resonant['ekf_known'])} (informed)",
            {"difference": _difference(resonant["horizon"], resonant["ekf_known"])},
            lambda difference: holds(difference.below(0))),
        Statement("it errs less under white noise", OURS, "",
            f"{_pair(white['horizon'])} against {_pair(white['ekf_statistics'])}; the recursive design "
            f"{_pair(white['recursive'])}. Node {NODE} alone: {_pair(alone['horizon'])}, Kalman filter "
            f"{_pair(alone['ekf_statistics'])}, nothing received {_pair(alone['zero_gain'])}",
            {"difference": _difference(white["horizon"], white["ekf_statistics"])},
            lambda difference: holds(difference.below(0))),
        Statement("it errs less under a constant bias", OURS, "",
            f"{_pair(bias['horizon'])} against {_pair(bias['ekf_statistics'])}",
            {"difference": _difference(bias["horizon"], bias["ekf_statistics"])},
            lambda difference: holds(difference.below(0))),
        Statement("knowing A buys a level", OURS, "",
            f"node {NODE}: {guaranteed:.3f} with A known, {flat:.3f} with |A| + |phi| as one growth constant, where "
            f"K = 0 has {second.without_structure_or_gain:.3f}", {"known": guaranteed, "by_growth": flat},
            lambda known, by_growth: holds(known < by_growth / 2)),
    ]  # fmt: skip


def _pair(value: tuple[float, float]) -> str:
    return f"{value[0]:.3f} ± {value[1]:.3f}"


def _difference(item: tuple[float, float], other: tuple[float, float]) -> Sampled:
    return Sampled(item[0] - other[0], float(np.hypot(item[1], other[1])))
