"""What the example computes: errors before any data given what arrives, the bound, and simulated errors over claims."""

from collections.abc import Mapping
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.simulation import best_possible, mesh_arrivals, mesh_errors
from heliograph_studies.outcome import Unlisted
from heliograph_studies.stages import Stages
from heliograph_studies.without_centre.setting import PLANT, RULES, Setting, network, positions


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
    exact = stages("errors before any data", lambda: before_data(net, setting))
    bound = stages("the bound", lambda: least(net, setting))
    nees = stages("simulated runs", lambda: simulated(net, setting))
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
