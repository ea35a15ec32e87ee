"""Everything that the reproduction works out, and what follows of it at once."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion.discriminating import Discriminating
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Runs, fused_name, mean_and_error
from heliograph_studies.h_infinity_fusion.growth import Growth
from heliograph_studies.h_infinity_fusion.indices import Indices, Replayed
from heliograph_studies.h_infinity_fusion.levels import NodeDesigns, Readings, TrueGrowth, published_fused_level
from heliograph_studies.h_infinity_fusion.setting import PAPER_WEIGHTS, Setting
from heliograph_studies.h_infinity_fusion.worst_disturbance import Worst


@dataclass(frozen=True)
class Parts:
    """Everything that is worked out; `runs` are those of the paper's network, `told` of one that tells its losses."""

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
