"""A network without a centre: what every node's error is, what it claims, and what no rule could do better."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.fusion import DiffusionWeights, MatrixWeights, TraceIntersection
from heliograph.report.figures import BLUE, GREEN, INK, VERMILION
from heliograph.simulation import best_possible, mesh_arrivals, mesh_errors
from heliograph_studies import Stages, Study, Unlisted, check_fields
from heliograph_studies.curves import Curve, Panel, curves_over_time, graph_map

FILTER = "alone"  # of a node that receives nobody
MOTION = 0.98 * np.kron(np.eye(2), [[1.0, 1.0], [0.0, 0.97]])  # position and speed along two axes
NOISE = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
PLANT = hg.LinearPlant(MOTION, NOISE, np.zeros(4), np.eye(4), states=["x", "vx", "y", "vy"])
RULES: dict[str, hg.fusion.AbstractFusion] = {
    "best": MatrixWeights(),
    "intersection": TraceIntersection(),
    "diffusion": DiffusionWeights(),
}


@dataclass(frozen=True)
class Setting:
    """A graph of nodes within `radius` of each other in the unit square, and how much of it is simulated."""

    nodes: int = 40
    radius: float = 0.26
    loss: float = 0.2
    steps: int = 60
    runs: int = 192
    seed: int = 1

    def __post_init__(self) -> None:
        check_fields(self, nodes=4, steps=4, runs=2, radius=(0.01,), loss=(0.0, 0.9))


def positions(setting: Setting) -> dict[str, np.ndarray]:
    """Places of the nodes in the unit square, drawn until every node can be reached from every other."""
    generator = np.random.default_rng(setting.seed)
    while True:
        places = {f"n{i}": generator.random(2) for i in range(setting.nodes)}
        near = hg.fusion.neighbours_within(places, setting.radius)
        seen, ahead = {"n0"}, ["n0"]
        while ahead:
            new = set(near[ahead.pop()]) - seen
            seen |= new
            ahead += new
        if len(seen) == setting.nodes:
            return places


def network(setting: Setting) -> hg.Network:
    """Every other node measures x or y, the rest nothing; a fusion between neighbours by each rule."""
    generator = np.random.default_rng(setting.seed + 1)
    places = positions(setting)
    nodes: dict[str, hg.Node | None] = {}
    for i, name in enumerate(places):
        sensor = hg.LinearSensor([[1.0, 0, 0, 0] if i % 4 else [0, 0, 1.0, 0]], 0.2 * (1 + 2 * generator.random()))
        nodes[name] = hg.Node(sensor, hg.perfect(), {FILTER: hg.kalman_filter(PLANT, sensor)}) if i % 2 == 0 else None
    near, link = hg.fusion.neighbours_within(places, setting.radius), hg.erasure(hg.perfect(), 1 - setting.loss)
    return hg.Network(PLANT, nodes, {k: hg.Fusion(FILTER, r, neighbours=near, link=link) for k, r in RULES.items()})


@dataclass(frozen=True)
class Score:
    """One rule: mean over nodes and the second half of the steps of the error's trace, over that of a centre.

    claimed: the same of what the nodes claim. over_best: error over the least possible, at the same steps. nees: the
    smallest and largest of the nodes, simulated. over_time: the error at each step.
    """

    claim: str
    error: float
    claimed: float
    over_best: float
    nees: tuple[float, float]
    over_time: Unlisted[np.ndarray]
    nees_by_node: Unlisted[dict[str, float]]


@dataclass(frozen=True)
class Outcome:
    """Errors of the rules in units of a centre's that receives everything, and the graph.

    bound: the least possible over the second half of the steps; best_possible: its mean.
    """

    nodes: int
    neighbours: float
    centre: float
    best_possible: float
    rules: dict[str, Score]
    bound: Unlisted[np.ndarray]
    positions: Unlisted[dict[str, np.ndarray]]
    edges: Unlisted[dict[str, tuple[str, ...]]]
    sensors: Unlisted[tuple[str, ...]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    net, places = network(setting), positions(setting)
    near = hg.fusion.neighbours_within(places, setting.radius)
    scale = centre(net, setting.steps)
    # Exact errors given what arrives, the least possible, and simulated errors over claims.
    exact = stages("errors before any data", lambda: before_data(net, setting))
    bound = stages("the bound", lambda: least(net, setting))
    nees = stages("simulated runs", lambda: simulated(net, setting))
    # Means over the second half, in units of a centre's.
    half, rules = slice(setting.steps // 2, None), {}
    for name, (error, claimed) in exact.items():
        means = float(error[half].mean() / scale), float(claimed[half].mean() / scale)
        ends = min(nees[name].values()), max(nees[name].values())
        claim = net.claims()["n0"][name]
        rules[name] = Score(claim, *means, float(error[half].mean() / bound.mean()), ends, error / scale, nees[name])
    mean = float(np.mean([len(mine) for mine in near.values()]))
    measuring = tuple(name for name, node in net.nodes.items() if isinstance(node, hg.Node))
    return Outcome(setting.nodes, mean, scale, float(bound.mean() / scale), rules, bound / scale, places, near,
                   measuring)  # fmt: skip


def centre(net: hg.Network, steps: int) -> float:
    """Trace of the error covariance of a filter that receives every measurement, after so many steps."""
    sensors = [n.sensor for n in net.nodes.values() if isinstance(n, hg.Node) and isinstance(n.sensor, hg.LinearSensor)]
    rows = [(np.asarray(s.matrix), np.asarray(s.noise.covariance)) for s in sensors]
    information = sum(h.T @ np.linalg.solve(r, h) for h, r in rows)
    a, p = np.asarray(PLANT.matrix), np.asarray(PLANT.initial_covariance)
    q = np.asarray(PLANT.noise_covariance(jnp.zeros(0)))
    for _ in range(steps):
        p = a @ p @ a.T + q
        p = np.linalg.inv(np.linalg.inv(p) + information)
    return float(np.trace(p))


def before_data(net: hg.Network, setting: Setting) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Mean over the nodes of the trace of the error, and of what is claimed, at each step, for drawn arrivals."""
    result = {}
    for name in RULES:
        errors = mesh_errors(net, name, mesh_arrivals(net, name, setting.steps, setting.seed))
        result[name] = errors.mean_trace(), np.trace(errors.claimed, axis1=-2, axis2=-1).mean(axis=-1)
    return result


def least(net: hg.Network, setting: Setting) -> np.ndarray:
    """Mean over the nodes of the trace of the least error possible, for the same arrivals, after each later step."""
    name = next(iter(RULES))
    arrived = mesh_arrivals(net, name, setting.steps, setting.seed)
    bounds = [best_possible(net, name, arrived[:k]) for k in range(setting.steps // 2 + 1, setting.steps + 1)]
    return np.asarray(np.trace(bounds, axis1=2, axis2=3).mean(axis=1))


def simulated(net: hg.Network, setting: Setting) -> Mapping[str, dict[str, float]]:
    """NEES per state of each rule and node, over all runs and steps."""
    statistics = hg.monte_carlo(net, setting.steps, setting.runs, setting.seed, hg.Statistics())
    return {rule: {name: statistics[name][rule].nees_per_dimension()[0] for name in net.names} for rule in RULES}


NAMES = {"best": ("best weights", GREEN), "intersection": ("intersection", BLUE), "diffusion": ("diffusion", VERMILION)}

BEGUN = 4  # steps that are left out: before them every node is as ignorant as the plant's prior


def figures(outcome: Outcome) -> dict[str, Figure]:
    """A map of the graph by error over claim, and errors over time."""
    curves = [Curve(label, colour, outcome.rules[name].over_time[BEGUN:]) for name, (label, colour) in NAMES.items()]
    steps = np.arange(1.0, len(curves[0].values) + 1) + BEGUN
    earlier = np.full(len(steps) - len(outcome.bound), np.nan)
    bound = Curve("least possible", INK, np.concatenate([earlier, outcome.bound]))
    values = outcome.rules["intersection"].nees_by_node
    return {
        "map": graph_map(outcome.positions, outcome.edges, values, "error over claim (NEES)", outcome.sensors),
        "errors": curves_over_time(steps, [Panel("error in units of a centre's", [*curves, bound])]),
    }


example = Study("without-centre", Setting, compute, 3, figures)
run = example.run
