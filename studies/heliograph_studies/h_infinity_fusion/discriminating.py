"""The second example's numbers: levels with and without structure, errors under three disturbances, worst cases."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.filters.wrappers.fed_back import prediction_of
from heliograph_studies import sampled
from heliograph_studies.h_infinity_fusion.example import Mean
from heliograph_studies.h_infinity_fusion.levels import without_gain
from heliograph_studies.h_infinity_fusion.setting import Setting
from heliograph_studies.h_infinity_fusion.worst_disturbance import World, Worst, worst_disturbance

STEPS = 40
DAMPING, ANGLE = 0.97, 0.5  # of the rotation: its period is 4 pi steps
ROTATION = DAMPING * np.array([[np.cos(ANGLE), np.sin(ANGLE)], [-np.sin(ANGLE), np.cos(ANGLE)]])
GROWTH = 0.05
DISTURBANCE = np.array([[0.0], [1.0]])
TARGET = np.eye(2)
WEIGHT = 1.0
OUTPUTS = {"1": [[1.0, 0.0]], "2": [[0.0, 1.0]], "3": [[0.7, 0.7]]}
LINKS = Setting(steps=STEPS, arrival=(0.95, 0.95, 0.9), powers=(1.0, 1.0, 1.0), noise_gain=(3.0, 3.0, 9.0))
INPUTS = ("v", "moving", "white")
SCENARIOS = ("white", "bias", "resonant")
BOX = 100.0  # half the side of the box over which phi is searched


def slight(x: jax.Array) -> jax.Array:
    """phi: its slope is GROWTH at zero and less elsewhere."""
    return jnp.stack([jnp.zeros_like(x[0]), 10 * GROWTH * jnp.sin(x[0] / 10)])


def dynamics(x: jax.Array, k: object = 0) -> jax.Array:
    """A x + phi(x)."""
    return jnp.asarray(ROTATION @ x + slight(x))


def plant(disturbed: bool = True) -> hg.Plant:
    """The plant; not `disturbed`: what filters believe, v white of variance one."""

    def transition(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.where(u[1] > 0, dynamics(x) + (DISTURBANCE[:, 0] * u[0] if disturbed else 0.0), x)

    def noise(u: jax.Array) -> jax.Array:
        return jnp.asarray(u[1] * (u[2] if disturbed else 1.0) * (DISTURBANCE @ DISTURBANCE.T))

    return hg.Plant(transition, noise, np.zeros(2), np.eye(2) / WEIGHT, inputs=INPUTS)


def inputs(scenario: str) -> np.ndarray:
    """(v, moving, white) of each step; v of mean square one whatever it is."""
    k = np.arange(STEPS)
    v = {"white": 0 * k, "bias": 1 + 0 * k, "resonant": np.sqrt(2) * np.sin(ANGLE * k)}[scenario]
    return np.stack([v, np.minimum(k, 1), np.full(STEPS, scenario == "white")], axis=1).astype(float)


def sensor(node: str) -> hg.LinearSensor:
    """y = C_i x."""
    return hg.LinearSensor(OUTPUTS[node], 0.0)


def system(node: str, structured: bool = True) -> hg.h_infinity.GrowthSystem:
    """What designs read; not `structured`: all of A x + phi(x) known by its growth |A| + |phi| alone."""
    shape = {"growth": GROWTH, "transition": ROTATION} if structured else {"growth": DAMPING + GROWTH}
    return hg.h_infinity.growth_system(
        STEPS, DISTURBANCE, [[0.0]], TARGET, LINKS.unit_channel(), output=OUTPUTS[node], initial_weight=WEIGHT, **shape
    )


def world(node: str) -> World:
    """The same for a search for the worst disturbance."""
    matrix = np.array(OUTPUTS[node])
    return World(
        dynamics,
        lambda x: jnp.asarray(matrix @ x),
        DISTURBANCE,
        np.zeros((1, 1)),
        TARGET,
        WEIGHT * np.eye(4),
        inputs("bias"),
    )


NODE = "1"  # whose worst cases are searched
RUNS = 1_000  # at most: errors here are large and alike
ENERGIES = (1.0, 160.0, 1000.0)  # where phi is its slope, of order one, and saturated
SEARCH_DRAWS, JUDGE_DRAWS = 32, 2_000
Errors = dict[str, Mean]  # by filter
Designs = dict[str, dict[str, hg.h_infinity.HInfinityDesign]]  # by name and node


@dataclass(frozen=True)
class Discriminating:
    """Designs by name and node; certificates and the level without structure by node; the rest by filter.

    without_structure_or_gain: of one node, with A unknown and K = 0.

    errors: by scenario, mean norm of the fused error over runs and steps, local_errors of one node's; over_time
    (time,) the mean of the fused one over runs.
    """

    designs: Designs
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
    side = np.full(2, BOX)
    finding = hg.h_infinity.check_growth(slight, GROWTH, -side, side, "phi")
    certificates = {
        node: hg.h_infinity.certify_level(system(node), d.gains, d.weights, d.multipliers, d.level, [finding])
        for node, d in designs["horizon"].items()
    }
    flat = {node: hg.h_infinity.horizon_design(system(node, False), True).level for node in OUTPUTS}
    count = min(runs, RUNS)
    blind = without_gain(system(NODE, False), True).level
    simulated = simulate(designs, count, seed)
    return Discriminating(designs, certificates, flat, blind, finding, *simulated, worst_cases(designs), count)


def design() -> Designs:
    """The horizon and the recursive design of each node at their smallest levels, and what K = 0 proves."""
    results: Designs = {"horizon": {}, "recursive": {}, "zero_gain": {}}
    for node in OUTPUTS:
        growing = system(node)
        results["horizon"][node] = hg.h_infinity.horizon_design(growing, separate=True)
        results["recursive"][node] = hg.h_infinity.recursive_design(growing, separate=True)
        results["zero_gain"][node] = without_gain(growing, True)
    return results


def filters(node: str, designs: Designs) -> dict[str, hg.filters.AbstractFilter]:
    """All filters of a node but the one that knows of losses; each predicts."""
    believed, seen, growing = plant(False), sensor(node), system(node)
    results: dict[str, hg.filters.AbstractFilter] = {
        name: hg.h_infinity.h_infinity_filter(believed, seen, growing, element[node])
        for name, element in designs.items()
    }
    results["open_loop"] = hg.filters.open_loop_filter(believed)
    for name, hop in (("ekf_ignoring", LINKS.lossless), ("ekf_statistics", LINKS.lossy)):
        results[name] = prediction_of(hg.extended_filter(believed, seen, LINKS.unit_channel(hop)))
    return results


def networks(designs: Designs) -> list[hg.Network]:
    """Network whose receivers do not know of losses, and one whose do, with other draws."""
    believed, certain, losing = plant(False), LINKS.unit_channel(LINKS.lossless), LINKS.unit_channel()
    unaware, informed = {}, {}
    for node in OUTPUTS:
        seen = sensor(node)
        extended = prediction_of(hg.extended_filter(believed, seen, certain))
        unaware[node] = hg.Node(seen, losing, filters(node, designs))
        informed[node] = hg.Node(seen, LINKS.unit_channel(LINKS.known), {"ekf_known": extended})
    rule = hg.fusion.WeightedFusion(np.full(len(unaware), 1 / len(unaware)))
    return [
        hg.Network(plant(), nodes, {name: hg.Fusion(name, rule) for name in nodes[NODE].filters})
        for nodes in (unaware, informed)
    ]


def simulate(
    designs: Designs, runs: int, seed: int
) -> tuple[dict[str, Errors], dict[str, Errors], dict[str, dict[str, np.ndarray]]]:
    """Mean norm of the error by scenario and filter: fused, of one node, and fused over time."""
    errors: dict[str, Errors] = {scenario: {} for scenario in SCENARIOS}
    local: dict[str, Errors] = {scenario: {} for scenario in SCENARIOS}
    over_time: dict[str, dict[str, np.ndarray]] = {scenario: {} for scenario in SCENARIOS}
    for network in networks(designs):
        for scenario in SCENARIOS:
            record = hg.monte_carlo(network, STEPS, runs, seed, inputs=inputs(scenario))
            for name in network.fused:
                norms = np.linalg.norm(record.errors("fused", name), axis=-1)
                errors[scenario][name] = Mean(*sampled(norms.mean(axis=1)))
                over_time[scenario][name] = norms.mean(axis=0)
                separate = np.linalg.norm(record.errors(NODE, name), axis=-1)
                local[scenario][name] = Mean(*sampled(separate.mean(axis=1)))
    return errors, local, over_time


def worst_cases(designs: Designs) -> dict[str, Worst]:
    """Lower bounds on the true levels of one node's filters; they run on the channel that does not tell."""
    searched = world(NODE), LINKS.draws(SEARCH_DRAWS, 1), LINKS.draws(JUDGE_DRAWS, 2)
    return {name: worst_disturbance(item, *searched, ENERGIES) for name, item in filters(NODE, designs).items()}
