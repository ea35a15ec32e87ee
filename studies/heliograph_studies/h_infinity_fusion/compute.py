"""All numbers of the reproduction, in order."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import heliograph as hg
from heliograph_studies import Inline, Stages, Unlisted
from heliograph_studies.h_infinity_fusion.discriminating import NODE, Discriminating, discriminate
from heliograph_studies.h_infinity_fusion.example import (
    MORE_QUANTIZERS,
    QUANTIZERS,
    RECURSIVE,
    Runs,
    fused_name,
    mean_and_error,
    simulate,
    simulate_known,
)
from heliograph_studies.h_infinity_fusion.growth import Growth, growth, violation
from heliograph_studies.h_infinity_fusion.indices import Indices, Replayed, indices, replay
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
        return *mean_and_error(gap), float((gap < 0).mean())

    def saturated(self, quantizer: str, first: int = 0) -> float:
        """Share of samples out of reach from step `first` on."""
        uplink = self.runs.record.uplinks[fused_name(RECURSIVE, quantizer)]
        return float(uplink.saturated[:, first:].mean())


if TYPE_CHECKING:
    import xarray


def numbers(result: Parts) -> dict[str, Any]:
    """All numbers."""
    outcome = result.runs
    decodable = outcome.record.uplinks[fused_name(RECURSIVE, "dynamic_decodable")]
    return {
        "nodes": [
            node_numbers(node, level, result) for node, level in zip(result.nodes, result.setting.levels, strict=True)
        ],
        "fusion": fusion_numbers(result),
        "mean_fused_error_is": "mean over runs and s = 0 ... 15 of the norm of x - fused, of one-step predictions",
        "mean_fused_error": error_numbers(result),
        "saturated_fraction": result.saturated("dynamic"),
        "saturation": {
            "dynamic": result.saturated("dynamic"),
            "dynamic_from_s_7": result.saturated("dynamic", 7),
            "dynamic_decodable": result.saturated("dynamic_decodable"),
            "dynamic_decodable_symbols": decodable.symbols_per_value(),
            "largest_excess_over_13": result.replayed.excess,
        },
        "contexts": {
            **{name: context(outcome, name) for name in outcome.filters if name != RECURSIVE},
            "ekf_known": {**context(result.known, "ekf_known"), "note": "a second network, other draws"},
        },
        "growth": growth_numbers(result),
        "index": {
            "J1": result.indices.local, "J2": result.indices.fused,
        },
        "broken_guarantee": {
            "node": NODES[0], "guaranteed": result.nodes[0].horizon.level, **worst_level(result.broken)
        },
        "discriminating": second_numbers(result.discriminating),
    }  # fmt: skip


def node_numbers(node: NodeDesigns, level: float, result: Parts) -> dict[str, Any]:
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
    """Everything that Theorem 1 needs at each step; states in the order (x, e)."""
    design = node.paper
    return [
        {
            "P": design.weights[s],
            "K": design.gains[s],
            "L_next": np.linalg.inv(design.weights[s + 1]),
            "lambda1": float(design.multipliers[s, 0]),
            "lambda2": float(design.multipliers[s, 1]),
            "gamma": design.level,
        }
        for s in range(len(design.gains))
    ]


def fusion_numbers(result: Parts) -> dict[str, Any]:
    """Weights and levels of the fused estimate."""
    return {
        "weights": hg.fusion.level_weights(result.setting.levels),
        "gamma": result.fused_level,
        "gamma_of_paper_weights": result.level_of_paper_weights(),
        "gamma_of_paper_weights_as_printed": result.level_of_paper_weights(normalised=False),
        "minkowski": {"gamma": result.minkowski, "best_node": min(result.setting.levels)},
    }


def error_numbers(result: Parts) -> dict[str, Any]:
    """Mean fused errors of the paper's filters by quantizer, and their differences on the same runs."""
    numbers: dict[str, Any] = {}
    for name in (*QUANTIZERS, *MORE_QUANTIZERS):
        numbers[name], numbers[f"{name}_se"] = result.runs.mean_error(RECURSIVE, name)
    for other in ("static", "static_p41"):
        mean, error, better = result.difference("dynamic", other)
        numbers[f"dynamic_minus_{other}"] = {"mean": mean, "se": error, "share_of_runs_better": better}
    return numbers


def context(outcome: Runs, name: str) -> dict[str, Any]:
    """Mean fused errors of another filter."""
    (mean, error), dynamic, static = (outcome.mean_error(name, q) for q in QUANTIZERS)
    return {
        "mean_fused_error": mean,
        "mean_fused_error_se": error,
        "dynamic": dynamic[0], "dynamic_se": dynamic[1],
        "static": static[0], "static_se": static[1],
    }  # fmt: skip


def growth_numbers(result: Parts) -> dict[str, Any]:
    """What was found about a = 0.7, and levels with constants that were not refuted."""
    constants, true = result.growth, result.true_growth
    return {
        "visited": [finding_numbers(f) for f in constants.visited],
        "whole_range": finding_numbers(constants.whole),
        "size": finding_numbers(constants.size),
        "secant": constants.secant,
        "levels": {"one": true.constant, "differences": true.differences, "each_step": true.each_step},
        "levels_are": "by node; one multiplier for f and f~, then separate ones",
        "certified": true.certified,
        "larger_growth": result.readings.larger_growth,
    }


def finding_numbers(finding: hg.h_infinity.GrowthFinding) -> dict[str, Any]:
    """A finding as numbers."""
    return {**finding._asdict(), "refuted": bool(finding.refuted)}


def worst_level(worst: Worst) -> dict[str, float]:
    """A level found by search."""
    return {"found": worst.level, "found_se": worst.standard_error}


def second_numbers(second: Discriminating) -> dict[str, Any]:
    """The second example: by filter, levels of each node and errors; by node, certificates."""
    return {
        "runs": second.runs,
        "levels": {name: {n: d.level for n, d in design.items()} for name, design in second.designs.items()},
        "certified": {n: c.certified for n, c in second.certificates.items()},
        "without_structure": second.without_structure,
        "without_structure_or_gain": {NODE: second.without_structure_or_gain},
        "growth": finding_numbers(second.finding),
        "worst": {"node": NODE, **{name: worst_level(worst) for name, worst in second.worst.items()}},
        "mean_fused_error": second.errors,
        f"mean_error_of_node_{NODE}": second.local_errors,
    }


def record(result: Parts) -> "xarray.Dataset":
    """Truth, one run, means over the runs and the gains as NetCDF."""
    import xarray

    outcome, second = result.runs, result.discriminating
    quantizers = [*QUANTIZERS, *MORE_QUANTIZERS]
    errors = {q: outcome.errors(RECURSIVE, q) for q in quantizers}
    filters = list(second.over_time["white"])
    data = {
        "truth": (("s", "state"), outcome.truth),
        "estimate": (("node", "s", "state"), outcome.estimates(RECURSIVE)[0]),
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
    about = {"seed": result.setting.seed, "runs": outcome.runs}
    return xarray.Dataset(data, coordinates, about)


@dataclass(frozen=True)
class Outcome:
    """The numbers of the summary, and the parts that they, figures and statements are made of."""

    numbers: Inline[dict[str, Any]]
    parts: Unlisted[Parts]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Design, simulate, search and judge."""
    nodes, more, gap = stages("designs", lambda: designs(setting))
    broken = stages("worst disturbance of the example", lambda: violation(setting, 0, nodes[0].horizon))
    by_name = {
        RECURSIVE: [node.paper for node in nodes],
        "horizon": [node.horizon for node in nodes],
        "zero_gain": [node.zero_gain for node in nodes],
    }
    runs, known = stages(
        f"example: {setting.runs:,} runs", lambda: (simulate(setting, by_name), simulate_known(setting))
    )
    constants, true = stages("growth constants", lambda: _growth(runs))
    second = stages("second example", lambda: discriminate(setting.runs, setting.seed))
    replayed = replay(runs)
    judged = stages("indices", lambda: indices(runs, replayed))
    parts = Parts(setting, nodes, more, gap, broken, runs, known, replayed, judged, constants, true, second)
    return Outcome(numbers(parts), parts)


def designs(setting: Setting) -> tuple[list[NodeDesigns], Readings, float]:
    """Of each node, of other readings, and how far Theorem 1 is from an enumeration."""
    nodes = [node_designs(setting, i) for i in range(len(NODES))]
    return nodes, readings(setting), max(enumeration_gap(setting, i) for i in range(len(NODES)))


def _growth(runs: Runs) -> tuple[Growth, TrueGrowth]:
    findings = growth(runs)
    return findings, true_growth(runs.setting, findings.visited)


def write_record(outcome: Outcome, folder: Path) -> None:
    """Truth, one run, means over the runs and the gains as NetCDF."""
    record(outcome.parts).to_netcdf(folder / "record.nc", engine="h5netcdf")
