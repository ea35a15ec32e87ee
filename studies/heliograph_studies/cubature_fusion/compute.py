"""The Monte Carlo runs behind every number of the reproduction."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

import heliograph as hg
from heliograph.filters.update import AbstractUpdate
from heliograph.report.progress import Advance
from heliograph_studies.cubature_fusion.setting import (
    NODES,
    PRINTED,
    STRONG,
    Setting,
    channel,
    cubature,
    filters,
    plant,
    sensor,
)
from heliograph_studies.cubature_fusion.variants import variants

RUNS = 5_000  # what the judgement of the worst direction needs
STAGES = 5  # as `reproduction` tells them
EARLY, EARLY_FACTOR = 3, 20  # first steps, where fused bounds overstate themselves by little, with 20 times the runs

Statistics = dict[str, dict[str, hg.simulation.ErrorStatistics]]


@dataclass(frozen=True)
class Outcome:
    """One scenario: error statistics by node ("fused" last) and filter, and one run in full."""

    setting: Setting
    statistics: Statistics
    shown: hg.Record

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.shown.time)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return next(iter(self.statistics[NODES[0]].values())).runs

    def pooled(self, name: str) -> hg.simulation.ErrorStatistics:
        """A filter's statistics over all nodes, steps of node 1 first; a fused one's as they are."""
        if name in self.statistics["fused"]:
            return self.statistics["fused"][name]
        return hg.simulation.pool([self.statistics[node][name] for node in NODES])

    def rmse(self, name: str) -> np.ndarray:
        """Root mean squared error over time, (node, time)."""
        return np.array([self.statistics[node][name].rmse_over_time() for node in NODES])

    def claimed_trace(self, name: str) -> np.ndarray:
        """Mean claimed trace over time, (node, time)."""
        claimed = np.array([self.statistics[node][name].claimed() for node in NODES])
        return np.asarray(np.trace(claimed, axis1=-2, axis2=-1))


@dataclass(frozen=True)
class Reproduction:
    """Both scenarios, the first steps of the strong one with many more runs, and what they were run with."""

    printed: Outcome
    strong: Outcome
    early: Outcome
    runs: int
    seed: int

    @property
    def outcomes(self) -> tuple[Outcome, Outcome]:
        """Both scenarios, in order."""
        return self.printed, self.strong


def network(s: Setting) -> hg.Network:
    """Four nodes with all filters, and what is made of them together."""
    optimal = hg.CovarianceIntersection()
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        "ci_printed": hg.Fusion("cubature_printed_fixed", optimal),
        "ci_open_loop": hg.Fusion("open_loop", optimal),
        "central_polytope": central(s, hg.filters.Polytope()),
    }
    return _assemble(s, [filters(s, i) for i in range(len(NODES))], {**zero_mean_fusion(s), **fused})


def early_network(s: Setting) -> hg.Network:
    """The zero-mean filter alone, and what is made of it."""
    return _assemble(s, _only(s, "cubature_zero_mean"), zero_mean_fusion(s))


def shown_network(s: Setting) -> hg.Network:
    """The paper's filter and its fusion."""
    fused = {"ci_printed": hg.Fusion("cubature_printed_fixed", hg.CovarianceIntersection())}
    return _assemble(s, _only(s, "cubature_printed_fixed"), fused)


def literal_network(s: Setting) -> hg.Network:
    """The same nodes, which hear the same, with the literal readings of Algorithm 1."""
    return _assemble(s, [variants(s, i) for i in range(len(NODES))], {})


def zero_mean_fusion(s: Setting) -> dict[str, hg.Fusion | hg.filters.AbstractFilter]:
    """What is made of the zero-mean filter's estimates, and the central filter with its update."""
    return {
        "ci_optimal": hg.Fusion("cubature_zero_mean", hg.CovarianceIntersection()),
        "ci_equal": hg.Fusion("cubature_zero_mean", hg.fusion.EqualIntersection()),
        "central": central(s, hg.filters.ZeroMean()),
    }


def central(s: Setting, update: AbstractUpdate) -> hg.filters.AbstractFilter:
    """All nodes' measurements in turn, each used as that node's filter would."""
    return hg.filters.sequential_filter([cubature(s, i, update) for i in range(len(NODES))])


def _only(s: Setting, name: str) -> list[dict[str, hg.filters.AbstractFilter]]:
    return [{name: filters(s, i)[name]} for i in range(len(NODES))]


def _assemble(
    s: Setting,
    parts: list[dict[str, hg.filters.AbstractFilter]],
    fused: Mapping[str, hg.Fusion | hg.filters.AbstractFilter],
) -> hg.Network:
    nodes = {name: hg.Node(sensor(s, i), channel(s), parts[i]) for i, name in enumerate(NODES)}
    return hg.Network(plant(s), nodes, fused)


def reproduction(runs: int, seed: int, tell: Advance) -> Reproduction:
    """Run everything; `tell` hears how many runs of what are done."""
    printed, strong = (
        outcome(s, {"filters": network(s), "literal readings": literal_network(s)}, s.horizon, runs, seed, tell)
        for s in (PRINTED, STRONG)
    )
    first = {"first steps": early_network(STRONG)}
    return Reproduction(printed, strong, outcome(STRONG, first, EARLY, EARLY_FACTOR * runs, seed, tell), runs, seed)


def outcome(s: Setting, networks: dict[str, hg.Network], horizon: int, runs: int, seed: int, tell: Advance) -> Outcome:
    """Run a scenario's networks on the same data, and one run in full."""
    statistics: Statistics = {}
    for what, item in networks.items():
        told = partial(tell, f"{s.name}: {what}")
        told(0, runs)
        found = hg.monte_carlo(item, horizon, runs, seed, hg.Statistics(), progress=told)
        for node, by_name in found.items():
            statistics.setdefault(node, {}).update(by_name)
    return Outcome(s, statistics, hg.monte_carlo(shown_network(s), horizon, 1, seed))
