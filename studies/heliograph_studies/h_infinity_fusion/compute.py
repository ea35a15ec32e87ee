"""All numbers of the reproduction, in order."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion import setting
from heliograph_studies.h_infinity_fusion.discriminating import Discriminating, discriminate
from heliograph_studies.h_infinity_fusion.example import (
    RECURSIVE,
    Outcome,
    fused_name,
    mean_and_error,
    simulate,
    simulate_told,
)
from heliograph_studies.h_infinity_fusion.growth import Growth, growth
from heliograph_studies.h_infinity_fusion.indices import Indices, Replayed, indices, replay
from heliograph_studies.h_infinity_fusion.levels import (
    NodeDesigns,
    Readings,
    TrueGrowth,
    node_designs,
    readings,
    true_growth,
)
from heliograph_studies.h_infinity_fusion.one_step import enumeration_gap
from heliograph_studies.h_infinity_fusion.published_level import published_fused_level
from heliograph_studies.h_infinity_fusion.violation import violation
from heliograph_studies.h_infinity_fusion.worst_disturbance import Worst

RUNS = 4_000
STAGES = 6  # as `reproduction` tells them


@dataclass(frozen=True)
class Reproduction:
    """Everything that report and summary tell."""

    nodes: list[NodeDesigns]
    readings: Readings
    enumeration: float
    broken: Worst
    outcome: Outcome
    told: Outcome
    replayed: Replayed
    indices: Indices
    growth: Growth
    true_growth: TrueGrowth
    discriminating: Discriminating
    seed: int

    @property
    def fused_level(self) -> float:
        """The smallest level that Theorem 4 can give, in closed form."""
        return published_fused_level(setting.LEVELS, hg.fusion.level_weights(setting.LEVELS))

    @property
    def minkowski(self) -> float:
        """What the triangle inequality gives for the same weights, without quantization."""
        return hg.fusion.fused_level(setting.LEVELS, hg.fusion.level_weights(setting.LEVELS))

    def level_of_paper_weights(self, normalised: bool = True) -> float:
        """sqrt(2 N sum c^2 gamma^2) for the printed weights, which sum to 0.9999."""
        c = np.array(setting.PAPER_WEIGHTS)
        scale = float(c.sum())
        return published_fused_level(setting.LEVELS, c / scale) * (1.0 if normalised else scale)

    def difference(self, quantizer: str, other: str) -> tuple[float, float, float]:
        """Mean over runs of the difference of fused errors, its standard error, and the share of runs below 0."""
        gap = (self.outcome.errors(RECURSIVE, quantizer) - self.outcome.errors(RECURSIVE, other)).mean(axis=1)
        return *mean_and_error(gap), float((gap < 0).mean())

    def saturated(self, quantizer: str, first: int = 0) -> float:
        """Share of samples out of reach from step `first` on."""
        uplink = self.outcome.record.uplinks[fused_name(RECURSIVE, quantizer)]
        return float(uplink.saturated[:, first:].mean())


def reproduction(runs: int, seed: int, advance: Callable[[str], None] = lambda what: None) -> Reproduction:
    """Design, simulate, search and judge; `advance` is told what begins."""
    advance("designs")
    nodes = [node_designs(i) for i in range(len(setting.NODES))]
    more, gap = readings(), max(map(enumeration_gap, range(len(nodes))))
    advance("worst disturbance of the example")
    broken = violation(0, nodes[0].horizon)
    advance(f"example: {runs:,} runs")
    designs = {
        RECURSIVE: [node.paper for node in nodes],
        "horizon": [node.horizon for node in nodes],
        "zero_gain": [node.zero_gain for node in nodes],
    }
    outcome, told = simulate(designs, runs, seed), simulate_told(runs, seed)
    advance("growth constants")
    replayed, found = replay(outcome), growth(outcome)
    true = true_growth(found.visited)
    advance("second example")
    second = discriminate(runs, seed)
    advance("indices")
    judged = indices(outcome, replayed)
    return Reproduction(
        nodes, more, gap, broken, outcome, told, replayed, judged, found, true, second, seed
    )  # fmt: skip
