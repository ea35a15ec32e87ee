"""All numbers of the reproduction, in order."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import heliograph as hg
from heliograph_studies import Inline, Stages, Unlisted, sampled
from heliograph_studies.h_infinity_fusion.discriminating import NODE, Discriminating, discriminate
from heliograph_studies.h_infinity_fusion.example import (
    MORE_QUANTIZERS,
    QUANTIZERS,
    RECURSIVE,
    Growth,
    Indices,
    Replayed,
    Runs,
    fused_name,
    growth,
    indices,
    replay,
    simulate,
    simulate_known,
    violation,
)
from heliograph_studies.h_infinity_fusion.levels import (
    NodeDesigns,
    Readings,
    TrueGrowth,
    enumeration_gap,
    node_designs,
    published_fused_level,
    readings,
    true_growth,
)
from heliograph_studies.h_infinity_fusion.setting import NODES, PAPER_WEIGHTS, STATES, Setting
from heliograph_studies.h_infinity_fusion.worst_disturbance import Worst

GAP = ("mean", "se", "share_of_runs_better")  # of a difference of fused errors


@dataclass(frozen=True)
class Parts:
    """Everything that is worked out; `runs` are those of the paper's network, `known` of one that tells its losses."""

    setting: Setting
    nodes: list[NodeDesigns]
    readings: Readings
    enumeration: float
    broken: Worst
    runs: Runs
    known: Runs
    replayed: Replayed
    indices: Indices
    growth: Growth
    true_growth: TrueGrowth
    discriminating: Discriminating

    @property
    def fused_level(self) -> float:
        """The smallest level that Theorem 4 can give, in closed form."""
        return published_fused_level(self.setting.levels, hg.fusion.level_weights(self.setting.levels))

    @property
    def minkowski(self) -> float:
        """What the triangle inequality gives for the same weights, without quantization."""
        return hg.fusion.fused_level(self.setting.levels, hg.fusion.level_weights(self.setting.levels))

    def level_of_paper_weights(self, normalised: bool = True) -> float:
        """sqrt(2 N sum c^2 gamma^2) for the printed weights, which sum to 0.9999."""
        c = np.array(PAPER_WEIGHTS)
        scale = float(c.sum())
        return published_fused_level(self.setting.levels, c / scale) * (1.0 if normalised else scale)

    def difference(self, quantizer: str, other: str) -> tuple[float, float, float]:
        """Mean over runs of the difference of fused errors, its standard error, and the share of runs below 0."""
        gap = (self.runs.errors(RECURSIVE, quantizer) - self.runs.errors(RECURSIVE, other)).mean(axis=1)
        return *sampled(gap), float((gap < 0).mean())

    def saturated(self, quantizer: str, first: int = 0) -> float:
        """Share of samples out of reach from step `first` on."""
        uplink = self.runs.record.uplinks[fused_name(RECURSIVE, quantizer)]
        return float(uplink.saturated[:, first:].mean())


def numbers(result: Parts) -> dict[str, Any]:
    """What the summary lists."""
    runs, levels = result.runs, result.setting.levels
    gaps = {other: result.difference("dynamic", other) for other in ("static", "static_odd")}
    return {
        "nodes": [_node(node, level, result) for node, level in zip(result.nodes, levels, strict=True)],
        "fusion": {
            "weights": hg.fusion.level_weights(levels),
            "gamma": result.fused_level,
            "gamma_of_paper_weights": result.level_of_paper_weights(),
            "gamma_of_paper_weights_as_printed": result.level_of_paper_weights(normalised=False),
            "minkowski": {"gamma": result.minkowski, "best_node": min(levels)},
        },
        "mean_fused_error_is": "mean over runs and s = 0 ... 15 of the norm of x - fused, of one-step predictions",
        "mean_fused_error": {
            **_errors(runs, RECURSIVE, (*QUANTIZERS, *MORE_QUANTIZERS)),
            **{f"dynamic_minus_{other}": dict(zip(GAP, gap, strict=True)) for other, gap in gaps.items()},
        },
        "saturated_fraction": result.saturated("dynamic"),
        "saturation": _saturation(result),
        "contexts": {
            **{name: _context(runs, name) for name in runs.filters if name != RECURSIVE},
            "ekf_known": {**_context(result.known, "ekf_known"), "note": "a second network, other draws"},
        },
        "growth": _growth(result),
        "index": {"J1": result.indices.local, "J2": result.indices.fused},
        "broken_guarantee": {"node": NODES[0], "guaranteed": result.nodes[0].horizon.level, **_worst(result.broken)},
        "discriminating": _second(result.discriminating),
    }  # fmt: skip


def _saturation(result: Parts) -> dict[str, Any]:
    """Shares of samples that quantizers could not reach, and the symbols of one that can be decoded."""
    decodable = result.runs.record.uplinks[fused_name(RECURSIVE, "dynamic_decodable")]
    return {
        "dynamic": result.saturated("dynamic"),
        "dynamic_from_s_7": result.saturated("dynamic", 7),
        "dynamic_decodable": result.saturated("dynamic_decodable"),
        "dynamic_decodable_symbols": decodable.symbols_per_value(),
        "largest_excess_over_13": result.replayed.excess,
    }


def _growth(result: Parts) -> dict[str, Any]:
    """Growth constants that the paper's example refutes, and the levels that true ones allow."""
    growth, true = result.growth, result.true_growth
    return {
        "visited": [_finding(f) for f in growth.visited],
        "whole_range": _finding(growth.whole),
        "size": _finding(growth.size),
        "secant": growth.secant,
        "certified": true.certified,
        "levels": {"one": true.constant, "differences": true.differences, "each_step": true.each_step},
        "levels_are": "by node; one multiplier for f and f~, then separate ones",
        "larger_growth": result.readings.larger_growth,
    }


def _node(node: NodeDesigns, level: float, result: Parts) -> dict[str, Any]:
    """Levels of a node, and the certificate of the recursive design at the paper's level."""
    smallest = {f"recursive_{name}": value for name, value in node.smallest.items()}
    return {
        "gamma_paper": level,
        "steps_certified": node.certificate.steps_certified,
        "max_eig": float(node.certificate.largest_eigenvalues.max()),
        "gamma_min": {**smallest, "horizon": node.horizon.level, "horizon_split": node.separate.level},
        "gamma_min_fixed_start": result.readings.fixed_start,
        "gamma_without_measurements": node.without_measurements,
        "failed_step_without_objective": node.failed["none"],
        "certificate": certificate(node),
    }


def certificate(node: NodeDesigns) -> list[dict[str, Any]]:
    """Everything that Theorem 1 needs at each step, for the design at the paper's level; states in the order (x, e)."""
    design = node.paper
    steps = zip(design.weights, design.gains, design.weights[1:], design.multipliers, strict=False)
    return [
        {"P": p, "K": k, "L_next": np.linalg.inv(after), "lambda1": x, "lambda2": y, "gamma": design.level}
        for p, k, after, (x, y) in steps
    ]


def _errors(runs: Runs, name: str, quantizers: Sequence[str]) -> dict[str, float]:
    """Mean fused errors of a filter by quantizer, each with its standard error."""
    means = {q: runs.mean_error(name, q) for q in quantizers}
    return {f"{q}{end}": value for q, pair in means.items() for end, value in zip(("", "_se"), pair, strict=True)}


def _context(runs: Runs, name: str) -> dict[str, Any]:
    return {key.replace("none", "mean_fused_error"): value for key, value in _errors(runs, name, QUANTIZERS).items()}


def _finding(finding: hg.h_infinity.GrowthFinding) -> dict[str, Any]:
    return {**finding._asdict(), "refuted": bool(finding.refuted)}


def _worst(worst: Worst) -> dict[str, float]:
    return {"found": worst.level, "found_se": worst.standard_error}


def _second(second: Discriminating) -> dict[str, Any]:
    """The second example: by filter, levels of each node and errors; by node, certificates."""
    return {
        "runs": second.runs,
        "levels": {name: {n: d.level for n, d in design.items()} for name, design in second.designs.items()},
        "certified": {n: c.certified for n, c in second.certificates.items()},
        "without_structure": second.without_structure,
        "without_structure_or_gain": {NODE: second.without_structure_or_gain},
        "growth": _finding(second.finding),
        "worst": {"node": NODE, **{name: _worst(worst) for name, worst in second.worst.items()}},
        "mean_fused_error": second.errors,
        f"mean_error_of_node_{NODE}": second.local_errors,
    }


@dataclass(frozen=True)
class Outcome:
    """The numbers of the summary, and the parts that they, figures and statements are made of."""

    numbers: Inline[dict[str, Any]]
    parts: Unlisted[Parts]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Design, simulate, search and judge."""
    every = range(len(NODES))
    nodes = stages("designs", lambda: [node_designs(setting, i) for i in every])
    more, gap = stages("readings", lambda: (readings(setting), max(enumeration_gap(setting, i) for i in every)))
    broken = stages("worst disturbance of the example", lambda: violation(setting, 0, nodes[0].horizon))
    by_name = {
        RECURSIVE: [node.paper for node in nodes],
        "horizon": [node.horizon for node in nodes],
        "zero_gain": [node.zero_gain for node in nodes],
    }
    runs, known = stages(
        f"example: {setting.runs:,} runs", lambda: (simulate(setting, by_name), simulate_known(setting))
    )
    constants = stages("growth constants", lambda: growth(runs))
    true = stages("levels that they allow", lambda: true_growth(setting, constants.visited))
    second = stages("second example", lambda: discriminate(setting.runs, setting.seed))
    replayed = replay(runs)
    judged = stages("indices", lambda: indices(runs, replayed))
    parts = Parts(setting, nodes, more, gap, broken, runs, known, replayed, judged, constants, true, second)
    return Outcome(numbers(parts), parts)


def write_record(outcome: Outcome, folder: Path) -> None:
    """Truth, one run, means over the runs and the gains as NetCDF."""
    import xarray

    result, runs, second = outcome.parts, outcome.parts.runs, outcome.parts.discriminating
    quantizers = [*QUANTIZERS, *MORE_QUANTIZERS]
    errors = {q: runs.errors(RECURSIVE, q) for q in quantizers}
    filters = list(second.over_time["white"])
    data = {
        "truth": (("s", "state"), runs.truth),
        "estimate": (("node", "s", "state"), runs.estimates(RECURSIVE)[0]),
        "mean_fused_error": (("quantizer", "s"), np.array([errors[q].mean(axis=0) for q in quantizers])),
        "fused_error_of_run_0": (("quantizer", "s"), np.array([errors[q][0] for q in quantizers])),
        "gain": (("node", "s", "state", "received"), np.array([n.paper.gains for n in result.nodes])),
        "mean_amplitude": (("node", "s", "state"), result.replayed.amplitude.mean(axis=0)),
        "second_mean_fused_error": (
            ("scenario", "filter", "step"),
            np.array([[item[name] for name in filters] for item in second.over_time.values()]),
        ),
    }
    coordinates = {"s": np.arange(result.setting.steps), "state": list(STATES), "node": list(NODES),
                   "quantizer": quantizers, "received": ["relay", "direct"], "scenario": list(second.over_time),
                   "filter": filters}  # fmt: skip
    about = {"seed": result.setting.seed, "runs": runs.runs}
    xarray.Dataset(data, coordinates, about).to_netcdf(folder / "record.nc", engine="h5netcdf")
