"""All numbers of the reproduction, in order."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from heliograph_studies.h_infinity_fusion.discriminating import discriminate
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Runs, simulate, simulate_known
from heliograph_studies.h_infinity_fusion.growth import Growth, growth, violation
from heliograph_studies.h_infinity_fusion.indices import indices, replay
from heliograph_studies.h_infinity_fusion.levels import (
    NodeDesigns,
    Readings,
    TrueGrowth,
    node_designs,
    readings,
    true_growth,
)
from heliograph_studies.h_infinity_fusion.numbers import numbers, record
from heliograph_studies.h_infinity_fusion.one_step import enumeration_gap
from heliograph_studies.h_infinity_fusion.parts import Parts
from heliograph_studies.h_infinity_fusion.setting import NODES, Setting
from heliograph_studies.outcome import Inline, Unlisted
from heliograph_studies.stages import Stages


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
