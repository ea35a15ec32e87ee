"""The second example's numbers: levels with and without structure, errors under three disturbances, worst cases."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.filters.wrappers.fed_back import prediction_of
from heliograph_studies.h_infinity_fusion import structured
from heliograph_studies.h_infinity_fusion.example import Mean, mean_and_error
from heliograph_studies.h_infinity_fusion.levels import without_gain
from heliograph_studies.h_infinity_fusion.worst_disturbance import Worst, worst_disturbance

NODE = "1"  # whose worst cases are searched
RUNS = 1_000  # at most: errors here are large and alike
ENERGIES = (1.0, 160.0, 1000.0)  # where phi is its slope, of order one, and saturated
SEARCH_DRAWS, JUDGE_DRAWS = 32, 2_000
Errors = dict[str, Mean]  # by filter


@dataclass(frozen=True)
class Discriminating:
    """Designs by name and node; certificates and the level without structure by node; the rest by filter.

    without_structure_or_gain: of one node, with A unknown and K = 0.

    errors: by scenario, mean norm of the fused error over runs and steps, local_errors of one node's; over_time
    (time,) the mean of the fused one over runs.
    """

    designs: dict[str, dict[str, hg.h_infinity.HInfinityDesign]]
    certificates: dict[str, hg.h_infinity.HInfinityCertificate]
    without_structure: dict[str, float]
    without_structure_or_gain: float
    finding: hg.h_infinity.GrowthFinding
    errors: dict[str, Errors]
    local_errors: dict[str, Errors]
    over_time: dict[str, dict[str, np.ndarray]]
    worst: dict[str, Worst]
    runs: int


def discriminate(runs: int, seed: int) -> Discriminating:
    """Everything of the second example."""
    designs = design()
    side = np.full(2, structured.BOX)
    finding = hg.h_infinity.check_growth(structured.slight, structured.GROWTH, -side, side, "phi")
    certificates = {
        node: hg.h_infinity.certify_level(
            structured.system(node), d.gains, d.weights, d.multipliers, d.level, [finding]
        )
        for node, d in designs["horizon"].items()
    }
    flat = {
        node: hg.h_infinity.horizon_design(structured.system(node, False), True).level for node in structured.OUTPUTS
    }
    count = min(runs, RUNS)
    blind = without_gain(structured.system(NODE, False), True).level
    simulated = simulate(designs, count, seed)
    return Discriminating(designs, certificates, flat, blind, finding, *simulated, worst_cases(designs), count)


def design() -> dict[str, dict[str, hg.h_infinity.HInfinityDesign]]:
    """The horizon and the recursive design of each node at their smallest levels, and what K = 0 proves."""
    results: dict[str, dict[str, hg.h_infinity.HInfinityDesign]] = {"horizon": {}, "recursive": {}, "zero_gain": {}}
    for node in structured.OUTPUTS:
        system = structured.system(node)
        results["horizon"][node] = hg.h_infinity.horizon_design(system, separate=True)
        results["recursive"][node] = hg.h_infinity.recursive_design(system, separate=True)
        results["zero_gain"][node] = without_gain(system, True)
    return results


def filters(
    node: str, designs: dict[str, dict[str, hg.h_infinity.HInfinityDesign]]
) -> dict[str, hg.filters.AbstractFilter]:
    """All filters of a node but the one that knows of losses; each predicts."""
    believed, sensor, system = structured.plant(False), structured.sensor(node), structured.system(node)
    results: dict[str, hg.filters.AbstractFilter] = {
        name: hg.filters.h_infinity_filter(believed, sensor, system, element[node]) for name, element in designs.items()
    }
    results["open_loop"] = hg.filters.open_loop_filter(believed)
    for name, hop in (("ekf_ignoring", structured.lossless), ("ekf_statistics", structured.lossy)):
        results[name] = prediction_of(hg.extended_filter(believed, sensor, structured.channel(hop)))
    return results


def networks(designs: dict[str, dict[str, hg.h_infinity.HInfinityDesign]]) -> list[hg.Network]:
    """Network whose receivers do not know of losses, and one whose do, with other draws."""
    believed, lossless, lossy = structured.plant(False), structured.channel(structured.lossless), structured.channel()
    unaware, informed = {}, {}
    for node in structured.OUTPUTS:
        sensor = structured.sensor(node)
        extended = prediction_of(hg.extended_filter(believed, sensor, lossless))
        unaware[node] = hg.Node(sensor, lossy, filters(node, designs))
        informed[node] = hg.Node(sensor, structured.channel(structured.known), {"ekf_known": extended})
    rule = hg.fusion.WeightedFusion(np.full(len(unaware), 1 / len(unaware)))
    return [
        hg.Network(structured.plant(), nodes, {name: hg.Fusion(name, rule) for name in nodes[NODE].filters})
        for nodes in (unaware, informed)
    ]


def simulate(
    designs: dict[str, dict[str, hg.h_infinity.HInfinityDesign]], runs: int, seed: int
) -> tuple[dict[str, Errors], dict[str, Errors], dict[str, dict[str, np.ndarray]]]:
    """Mean norm of the error by scenario and filter: fused, of one node, and fused over time."""
    errors: dict[str, Errors] = {scenario: {} for scenario in structured.SCENARIOS}
    local: dict[str, Errors] = {scenario: {} for scenario in structured.SCENARIOS}
    over_time: dict[str, dict[str, np.ndarray]] = {scenario: {} for scenario in structured.SCENARIOS}
    for network in networks(designs):
        for scenario in structured.SCENARIOS:
            record = hg.monte_carlo(network, structured.STEPS, runs, seed, inputs=structured.inputs(scenario))
            for name in network.fused:
                norms = np.linalg.norm(record.errors("fused", name), axis=-1)
                errors[scenario][name] = mean_and_error(norms.mean(axis=1))
                over_time[scenario][name] = norms.mean(axis=0)
                separate = np.linalg.norm(record.errors(NODE, name), axis=-1)
                local[scenario][name] = mean_and_error(separate.mean(axis=1))
    return errors, local, over_time


def worst_cases(designs: dict[str, dict[str, hg.h_infinity.HInfinityDesign]]) -> dict[str, Worst]:
    """Lower bounds on the true levels of one node's filters; they run on the channel that does not tell."""
    world, draws = structured.world(NODE), structured.draws(SEARCH_DRAWS, 1)
    judges = structured.draws(JUDGE_DRAWS, 2)
    return {
        name: worst_disturbance(item, world, draws, judges, ENERGIES) for name, item in filters(NODE, designs).items()
    }
