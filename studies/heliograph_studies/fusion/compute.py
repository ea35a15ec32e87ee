"""What every rule reaches before any data, in three small networks, a tree of twelve nodes, and a network of many."""

import sys
import time
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import heliograph as hg
from heliograph.linear.lift import lifted_system
from heliograph.linear.recursion import lmmse
from heliograph.numerics.check import fail
from heliograph_studies import Inline, Stages, Unlisted, check_fields, sampled
from heliograph_studies.cubature_fusion import setting as machine

Part = tuple[np.ndarray, float, float, float, float]  # C, variance of v, mean and variance of the gain, variance of n


@dataclass(frozen=True)
class Setting:
    """How much is worked out, and how much is simulated.

    crossed_nodes: nodes of which all cross-covariances are computed over many_steps, as in a tree of tree_nodes and
    degree;
    intervals, thresholds: reports every d-th step and on event, over traffic_steps of which the second half is judged.
    """

    runs: int = 2000
    steps: int = 200
    measured_steps: int = 30
    crossed_nodes: int = 1000
    many_steps: int = 100
    tree_nodes: int = 10_000
    degree: int = 10
    machine_runs: int = 256
    machine_nodes: int = len(machine.NODES)
    intervals: tuple[int, ...] = (1, 2, 3, 4, 6)
    thresholds: tuple[float, ...] = (0.05, 0.15, 0.4)
    traffic_steps: int = 36  # a multiple of all intervals
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, runs=8, degree=2, tree_nodes=self.crossed_nodes, intervals=1)
        check_fields(self, steps=1, measured_steps=1, crossed_nodes=1, many_steps=1, machine_runs=1, traffic_steps=1)
        if not 2 <= self.machine_nodes <= len(machine.NODES):
            raise fail("machine_nodes", f"a number from 2 to {len(machine.NODES)}", self.machine_nodes)
        for d in self.intervals:
            if self.traffic_steps % d:
                raise fail("traffic_steps", f"a multiple of {d}", self.traffic_steps)


def moving_point() -> hg.LinearPlant:
    """Place and damped velocity in two directions."""
    matrix = 0.98 * np.kron(np.eye(2), [[1, 1], [0, 0.97]])
    noise = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))
    return hg.LinearPlant(matrix, noise, np.zeros(4), np.eye(4), states=["x", "vx", "y", "vy"])


def described(name: str) -> tuple[hg.LinearPlant, list[Part]]:
    """Plant and nodes of a case."""
    unit = np.eye(4)
    if name == "three_rooms":
        matrix = np.diag([0.9, 0.8, 0.95]) + 0.1 * np.diag([1, 1], 1)
        rooms = hg.LinearPlant(matrix, 0.1 * np.eye(3), np.zeros(3), np.eye(3))
        return rooms, [(np.eye(3)[[i]], 0.1, 0.8, 0.06, 0.05) for i in range(3)]
    if name == "three_partial":
        outputs = unit[[0]], unit[[2]], (unit[[0]] + unit[[2]]) / np.sqrt(2)
        numbers = (0.8, 0.05), (0.9, 0.1), (0.7, 0.08)
        return moving_point(), [(c, 0.2, *gain, 0.1) for c, gain in zip(outputs, numbers, strict=True)]
    return moving_point(), [(unit[[0, 2]], 0.3, 0.8, 0.1, 0.2)] * 4


def received_by(part: Part) -> tuple[hg.LinearSensor, hg.random_affine.AbstractRandomAffine]:
    """Sensor and channel of a node; only mean and variance of the gain matter."""
    matrix, noise, mean, variance, hop_noise = part
    gain = hg.Discrete([mean - np.sqrt(variance), mean + np.sqrt(variance)], [0.5, 0.5])
    return hg.LinearSensor(matrix, noise * np.eye(len(matrix))), hg.hop(gain, hop_noise * np.eye(len(matrix)))


def node_parts(count: int, seed: int) -> list[Part]:
    """Nodes with random outputs."""
    draw = np.random.default_rng(seed)
    return [(draw.normal(size=(2, 4)), 0.3, 0.75, 1 / 16, 0.2 + 0.2 * draw.random()) for _ in range(count)]


CASES = {
    "three_partial": "three sensors that each see a part of a moving point",
    "three_rooms": "three rooms that share their warmth, a thermometer in each",
    "four_equal": "four equal sensors of a moving point",
}
RULES = {
    "scalar": hg.fusion.ScalarWeights(),
    "matrix": hg.fusion.MatrixWeights(),
    "matrix_with_mean": hg.fusion.MatrixWeights(with_mean=True),
    "all_reports": hg.fusion.AllReports(),
}
LOCAL = "local"  # the filter of each node


@dataclass(frozen=True)
class Outcome:
    """Traces by case and rule, the tree, the scale, and what simulation says; levels: covariances in the tree."""

    cases: Inline[dict[str, dict[str, float | list[float]]]]
    tree: dict[str, float]
    scale: dict[str, float | None]
    measured: dict[str, dict[str, float]]
    strong: dict[str, Any]
    traffic: dict[str, list[dict[str, float]]]
    levels: Unlisted[list[np.ndarray]]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Everything."""
    # First: what memory the process has had at most is of all that came before.
    of_many = stages(f"{setting.tree_nodes} nodes in a tree, {setting.crossed_nodes} nodes", lambda: scale(setting))
    cases = {name: stages(what, partial(one_case, name, setting.steps)) for name, what in CASES.items()}
    simulated = stages("simulating three rooms", lambda: measured(setting))
    of_tree, levels, root = stages("a tree of relays", lambda: tree(setting))
    sent = stages("choosing what is sent", lambda: traffic(setting))
    errors = stages("an induction machine", lambda: strong(setting))
    return Outcome(cases, of_tree, of_many, {**simulated, "root": root}, errors, sent, levels)


def network(plant: hg.LinearPlant, parts: list[Part]) -> hg.Network:
    """Each node with its best linear filter, and every rule."""
    nodes = {}
    for i, part in enumerate(parts):
        sensor, channel = received_by(part)
        nodes[f"node {i + 1}"] = hg.Node(sensor, channel, {LOCAL: hg.linear_filter(plant, sensor, channel)})
    return hg.Network(plant, nodes, {name: hg.Fusion(LOCAL, rule) for name, rule in RULES.items()})


def central(plant: hg.LinearPlant, parts: list[Part], steps: int) -> np.ndarray:
    """Covariances of the filter that receives everything."""
    sensors, channels = zip(*map(received_by, parts), strict=True)
    noise = np.diag(np.concatenate([np.diag(s.noise.covariance) for s in sensors]))
    sensor = hg.LinearSensor(np.concatenate([s.matrix for s in sensors]), noise)
    return lmmse(lifted_system(plant, sensor, hg.parallel(channels), 1, steps)).gains.covariance


def equal_intersection(joint: np.ndarray) -> tuple[float, float]:
    """What intersection with equal weights claims, and what its error is: traces."""
    count, n = joint.shape[:2]
    information = [np.linalg.inv(joint[i, :, i]) for i in range(count)]
    claimed = np.linalg.inv(sum(information) / count)
    weights = np.concatenate([claimed @ j / count for j in information], axis=1)
    return float(np.trace(claimed)), float(np.trace(weights @ joint.reshape(count * n, -1) @ weights.T))


def one_case(name: str, steps: int) -> dict[str, float | list[float]]:
    """Traces at the end."""
    plant, parts = described(name)
    net = network(plant, parts)
    sums = hg.simulation.fused_covariances(net, steps) | {"central": central(plant, parts, steps)}
    joint = hg.simulation.cross_covariances(net, LOCAL, steps).joint
    claimed, true = equal_intersection(joint)
    local = [float(np.trace(joint[i, :, i])) for i in range(len(parts))]
    head: dict[str, float | list[float]] = {
        "local": local, "equal_intersection_claimed": claimed, "equal_intersection_true": true,
    }  # fmt: skip
    return head | {rule: float(np.trace(covariances[-1])) for rule, covariances in sums.items()}


def measured(setting: Setting) -> dict[str, dict[str, float]]:
    """Three rooms simulated: E |x - xhat|^2 at the last step with its standard error, beside the claim."""
    record = hg.monte_carlo(network(*described("three_rooms")), setting.measured_steps, setting.runs, setting.seed)
    claims = {name: np.asarray(estimate.covariance)[0, -1] for name, estimate in record.estimates["fused"].items()}
    return {name: against_peers(np.trace(claim), record.errors("fused", name)[:, -1]) for name, claim in claims.items()}


def against_peers(claimed: float, errors: np.ndarray) -> dict[str, float]:
    """The mean of squared errors (runs, n) with its standard error, beside what is claimed of it."""
    measured, error = sampled(np.sum(errors**2, axis=-1))
    return {"claimed": float(claimed), "measured": measured, "standard_error": error}


def tree(setting: Setting) -> tuple[dict[str, float], list[np.ndarray], dict[str, float]]:
    """Twelve nodes received by four relays, these by two, these by the root.

    Its error, that without the relays, and the central filter's; covariances at every place; what simulation says of
    the root's claim.
    """
    plant, parts, steps = moving_point(), node_parts(12, setting.seed), setting.steps
    net = network(plant, parts)
    leaves = hg.simulation.cross_covariances(net, LOCAL, steps)
    levels = _levels(leaves)
    traces = [float(np.trace(level.matrix_weights()[1])) for level in (levels[-1], leaves)]
    best = float(np.trace(central(plant, parts, steps)[-1]))
    covariances = [np.einsum("iaib->iab", level.joint) for level in levels]
    known = [*covariances, levels[-1].matrix_weights()[1][None]]
    return {"root": traces[0], "flat": traces[1], "central": best}, known, _root_simulated(net, setting)


def _levels(leaves: hg.simulation.CrossCovariances) -> list[hg.simulation.CrossCovariances]:
    relays = leaves.fused({f"relay {i}": leaves.nodes[3 * i : 3 * i + 3] for i in range(4)})
    return [leaves, relays, relays.fused({"left": relays.nodes[:2], "right": relays.nodes[2:]})]


def _root_simulated(net: hg.Network, setting: Setting) -> dict[str, float]:
    """E |x - xhat|^2 at the root after some steps, beside its claim: weights of each level on the estimates below."""
    alone = hg.Network(net.plant, net.nodes)
    record = hg.monte_carlo(alone, setting.measured_steps, setting.runs, setting.seed)
    levels = _levels(hg.simulation.cross_covariances(alone, LOCAL, setting.measured_steps))
    errors = np.stack([record.errors(name, LOCAL)[:, -1] for name in alone.names], axis=1)
    for level, size in zip(levels, (3, 2, 2), strict=True):
        groups = [slice(i, i + size) for i in range(0, len(level.nodes), size)]
        weights = [hg.fusion.MatrixWeights().weights(level.joint[g][:, :, g]) for g in groups]
        pairs = zip(groups, weights, strict=True)
        errors = np.stack([np.einsum("aib,kib->ka", w, errors[:, g]) for g, w in pairs], axis=1)
    return against_peers(np.trace(levels[-1].matrix_weights()[1]), errors[:, 0])


def scale(setting: Setting) -> dict[str, float | None]:
    """All cross-covariances and matrix weights of many nodes, and a tree of many more, with compilation."""
    plant, parts = moving_point(), node_parts(setting.tree_nodes, setting.seed)
    numbers = {"output": np.array([part[0] for part in parts]), "noise": np.array([part[4] for part in parts])}

    # A tree of relays over many leaves.
    def leaf(part: dict[str, Any]) -> hg.Node:
        sensor, gain = hg.LinearSensor(part["output"], 0.3 * np.eye(2)), hg.Discrete([0.5, 1.0], [0.5, 0.5])
        channel = hg.hop(gain, part["noise"] * np.eye(2))
        return hg.Node(sensor, channel, {LOCAL: hg.linear_filter(plant, sensor, channel)})

    begin = time.perf_counter(), time.process_time()
    grown = hg.simulation.relay_tree(plant, leaf, numbers, setting.degree, setting.many_steps)
    tree_took, tree_peak = _since(begin), peak_gb()
    begin = time.perf_counter(), time.process_time()
    # All cross-covariances of fewer nodes, and their matrix weights.
    crossed = hg.simulation.cross_covariances(network(plant, parts[: setting.crossed_nodes]), LOCAL, setting.many_steps)
    pairs, (_, covariance) = crossed.joint, crossed.matrix_weights()
    took = _since(begin)
    return {
        "nodes": setting.crossed_nodes,
        "steps": setting.many_steps,
        "seconds": took[0],
        "processor_seconds": took[1],
        "peak_gb": peak_gb(),
        "local": float(np.einsum("iaia->", pairs) / setting.crossed_nodes),
        "matrix": float(np.trace(covariance)),
        "tree_nodes": setting.tree_nodes,
        "tree_degree": setting.degree,
        "tree_seconds": tree_took[0],
        "tree_processor_seconds": tree_took[1],
        "tree_peak_gb": tree_peak,
        "tree_root": float(np.trace(grown.root)),
    }


def _since(begin: tuple[float, float]) -> tuple[float, float]:
    """Seconds of the clock, and of the processor."""
    return time.perf_counter() - begin[0], time.process_time() - begin[1]


def peak_gb() -> float | None:
    """Gigabytes of memory that the process has had at most; None on systems that do not say."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows has none
        return None
    unit = 1e9 if sys.platform == "darwin" else 1e6
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)


def strong(setting: Setting) -> dict[str, Any]:
    """An induction machine behind strong relays: root mean squared error of each rule, and what it claims."""
    rules = {"ci_equal": hg.fusion.EqualIntersection(), "matrix": RULES["matrix"], "all_reports": RULES["all_reports"]}
    fused = {name: hg.Fusion(LOCAL, rule) for name, rule in rules.items()}
    # The filters trust that their errors have mean zero; "central" is given what all nodes are.
    scenario, count = machine.STRONG, range(setting.machine_nodes)
    filters = [machine.cubature(scenario, i, hg.filters.ZeroMean()) for i in count]
    nodes = {
        f"node {i + 1}": hg.Node(machine.sensor(scenario, i), machine.channel(scenario), {LOCAL: filters[i]})
        for i in count
    }
    net = hg.Network(machine.plant(scenario), nodes, {**fused, "central": hg.filters.sequential_filter(filters)})
    sums = hg.monte_carlo(net, scenario.horizon, setting.machine_runs, setting.seed, hg.Statistics())["fused"]
    traces = {name: np.trace(item.claimed(), axis1=1, axis2=2).mean() for name, item in sums.items()}
    errors: dict[str, Any] = {name: float(item.rmse()[0]) for name, item in sums.items()}
    return {**errors, "claimed": {name: float(np.sqrt(trace)) for name, trace in traces.items()}}


def traffic(setting: Setting) -> dict[str, list[dict[str, float]]]:
    """Three rooms whose nodes report every d-th step, or on event: reports per step and node, error, and claim."""
    plant, parts = described("three_rooms")
    # Reports every d-th step, or where the estimate has moved by a threshold.
    every = {f"every {d}": hg.fusion.ReportLink(every=d) for d in setting.intervals}
    fused = {name: hg.Fusion(LOCAL, hg.fusion.AllReports(), uplink=link) for name, link in every.items()}
    for informed in (True, False):
        for level in setting.thresholds:
            sends = hg.fusion.EventSending(level, informed)
            name = f"{'informed' if informed else 'uninformed'} {level}"
            fused[name] = hg.Fusion(LOCAL, hg.fusion.AllReports(), quantizer=sends)
    # One after another on the same draws: centres that differ in numbers alone are one program.
    nodes, judged = network(plant, parts).nodes, (setting.traffic_steps, setting.runs // 4, setting.seed)
    result: dict[str, list[dict[str, float]]] = {"every": [], "informed": [], "uninformed": []}
    # Averages over the second half of the steps.
    late = slice(setting.traffic_steps // 2, None)
    for name, fusion in fused.items():
        item = hg.monte_carlo(hg.Network(plant, nodes, {"centre": fusion}), *judged, hg.Statistics())["fused"]["centre"]
        kind, number = name.split()
        sent = 1 / int(number) if item.uplink is None else float(item.uplink.symbols[late].mean())
        claimed = float(np.trace(item.claimed(), axis1=1, axis2=2)[late].mean())
        square = float(np.mean(item.rmse_over_time()[late] ** 2))
        result[kind].append({"level": float(number), "reports": sent, "error": square, "claimed": claimed})
    return result
