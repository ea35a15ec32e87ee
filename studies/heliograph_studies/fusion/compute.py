"""What every rule reaches before any data, in three small networks, a tree of twelve nodes, and a network of many."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import heliograph as hg
from heliograph_studies.fusion import machine
from heliograph_studies.fusion.memory import peak_gb

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
OWN = "own"
STEPS = 200
MANY, MANY_STEPS = 1000, 100
TREE_NODES, DEGREE = 10_000, 10
RUNS, MEASURED_STEPS = 2000, 30
STRONG_RUNS = 256
INTERVALS, THRESHOLDS = (1, 2, 3, 4, 6), (0.05, 0.15, 0.4)
TRAFFIC_STEPS = 36  # a multiple of all intervals; the second half is judged
STAGES = len(CASES) + 5

Part = tuple[np.ndarray, float, float, float, float]  # C, variance of v, mean and variance of the gain, variance of n


@dataclass(frozen=True)
class Outcome:
    """Traces by case and rule, the tree, the scale, and what simulation says."""

    cases: dict[str, dict[str, float | list[float]]]
    measured: dict[str, dict[str, float]]
    tree: dict[str, float]
    levels: list[np.ndarray]
    scale: dict[str, float]
    strong: dict[str, float]
    strong_claimed: dict[str, float]
    traffic: dict[str, list[dict[str, float]]]


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


def heard(part: Part) -> tuple[hg.LinearSensor, hg.random_affine.AbstractRandomAffine]:
    """Sensor and channel of a node; only mean and variance of the gain matter."""
    matrix, noise, mean, variance, hop_noise = part
    gain = hg.Discrete([mean - np.sqrt(variance), mean + np.sqrt(variance)], [0.5, 0.5])
    return hg.LinearSensor(matrix, noise * np.eye(len(matrix))), hg.hop(gain, hop_noise * np.eye(len(matrix)))


def network(plant: hg.LinearPlant, parts: list[Part]) -> hg.Network:
    """Each node with its best linear filter, and every rule."""
    nodes = {}
    for i, part in enumerate(parts):
        sensor, channel = heard(part)
        nodes[f"node {i + 1}"] = hg.Node(sensor, channel, {OWN: hg.linear_filter(plant, sensor, channel)})
    return hg.Network(plant, nodes, {name: hg.Fusion(OWN, rule) for name, rule in RULES.items()})


def central(plant: hg.LinearPlant, parts: list[Part], steps: int) -> np.ndarray:
    """Covariances of the filter that hears everything."""
    sensors, channels = zip(*map(heard, parts), strict=True)
    noise = np.diag(np.concatenate([np.diag(s.noise.covariance) for s in sensors]))
    sensor = hg.LinearSensor(np.concatenate([s.matrix for s in sensors]), noise)
    channel = hg.parallel(channels)
    everything = hg.linear_filter(plant, sensor, channel)
    return np.asarray(hg.filters.true_error(everything, plant, sensor, channel, steps).true)


def equal_intersection(joint: np.ndarray) -> tuple[float, float]:
    """What intersection with equal weights claims, and what its error is: traces."""
    count, n = joint.shape[:2]
    information = [np.linalg.inv(joint[i, :, i]) for i in range(count)]
    claimed = np.linalg.inv(sum(information) / count)
    weights = np.concatenate([claimed @ j / count for j in information], axis=1)
    return float(np.trace(claimed)), float(np.trace(weights @ joint.reshape(count * n, -1) @ weights.T))


def one_case(name: str) -> dict[str, float | list[float]]:
    """Traces at the end."""
    plant, parts = described(name)
    net = network(plant, parts)
    found = hg.simulation.fused_covariances(net, STEPS) | {"central": central(plant, parts, STEPS)}
    joint = hg.simulation.cross_covariances(net, OWN, STEPS).joint
    claimed, true = equal_intersection(joint)
    local = [float(np.trace(joint[i, :, i])) for i in range(len(parts))]
    head: dict[str, float | list[float]] = {
        "local": local, "equal_intersection_claimed": claimed, "equal_intersection_true": true,
    }  # fmt: skip
    return head | {rule: float(np.trace(covariances[-1])) for rule, covariances in found.items()}


def measured(seed: int) -> dict[str, dict[str, float]]:
    """Three rooms simulated: E |x - xhat|^2 at the last step with its standard error, beside the claim."""
    record = hg.monte_carlo(network(*described("three_rooms")), MEASURED_STEPS, RUNS, seed)
    result = {}
    for rule, estimate in record.estimates["fused"].items():
        square = np.sum(record.errors("fused", rule)[:, -1] ** 2, axis=-1)
        claimed = float(np.trace(np.asarray(estimate.covariance)[0, -1]))
        error = float(square.std(ddof=1) / np.sqrt(RUNS))
        result[rule] = {"claimed": claimed, "measured": float(square.mean()), "standard_error": error}
    return result


def drawn_parts(count: int, seed: int) -> list[Part]:
    """Nodes with random outputs."""
    draw = np.random.default_rng(seed)
    return [(draw.normal(size=(2, 4)), 0.3, 0.75, 1 / 16, 0.2 + 0.2 * draw.random()) for _ in range(count)]


def tree(seed: int) -> tuple[dict[str, float], list[np.ndarray], dict[str, float]]:
    """Twelve nodes heard by four relays, these by two, these by the root.

    Its error, that without the relays, and the central filter's; covariances at every place; what simulation says of
    the root's claim.
    """
    plant, parts = moving_point(), drawn_parts(12, seed)
    net = network(plant, parts)
    leaves = hg.simulation.cross_covariances(net, OWN, STEPS)
    levels = _levels(leaves)
    traces = [float(np.trace(level.matrix_weights()[1])) for level in (levels[-1], leaves)]
    best = float(np.trace(central(plant, parts, STEPS)[-1]))
    covariances = [np.einsum("iaib->iab", level.joint) for level in levels]
    known = [*covariances, levels[-1].matrix_weights()[1][None]]
    return {"root": traces[0], "flat": traces[1], "central": best}, known, _root_simulated(net, seed)


def _levels(leaves: hg.simulation.CrossCovariances) -> list[hg.simulation.CrossCovariances]:
    relays = leaves.fused({f"relay {i}": leaves.nodes[3 * i : 3 * i + 3] for i in range(4)})
    return [leaves, relays, relays.fused({"left": relays.nodes[:2], "right": relays.nodes[2:]})]


def _root_simulated(net: hg.Network, seed: int) -> dict[str, float]:
    """E |x - xhat|^2 at the root after some steps, beside its claim: weights of each level on the estimates below."""
    alone = hg.Network(net.plant, net.nodes)
    record = hg.monte_carlo(alone, MEASURED_STEPS, RUNS, seed)
    levels = _levels(hg.simulation.cross_covariances(alone, OWN, MEASURED_STEPS))
    told = np.stack([record.errors(name, OWN)[:, -1] for name in alone.names], axis=1)
    for level, size in zip(levels, (3, 2, 2), strict=True):
        groups = [slice(i, i + size) for i in range(0, len(level.nodes), size)]
        weights = [hg.fusion.matrix_weights(level.joint[g][:, :, g]) for g in groups]
        pairs = zip(groups, weights, strict=True)
        told = np.stack([np.einsum("aib,kib->ka", w, told[:, g]) for g, w in pairs], axis=1)
    square = np.sum(told[:, 0] ** 2, axis=-1)
    claimed = float(np.trace(levels[-1].matrix_weights()[1]))
    error = float(square.std(ddof=1) / np.sqrt(RUNS))
    return {"claimed": claimed, "measured": float(square.mean()), "standard_error": error}


def scale(seed: int) -> dict[str, float]:
    """All cross-covariances and matrix weights of many nodes, and a tree of many more, with compilation."""
    plant, parts = moving_point(), drawn_parts(TREE_NODES, seed)
    numbers = {"output": np.array([part[0] for part in parts]), "noise": np.array([part[4] for part in parts])}

    def leaf(one: dict[str, Any]) -> hg.Node:
        sensor, gain = hg.LinearSensor(one["output"], 0.3 * np.eye(2)), hg.Discrete([0.5, 1.0], [0.5, 0.5])
        channel = hg.hop(gain, one["noise"] * np.eye(2))
        return hg.Node(sensor, channel, {OWN: hg.linear_filter(plant, sensor, channel)})

    begin = time.perf_counter(), time.process_time()
    grown = hg.simulation.relay_tree(plant, leaf, numbers, DEGREE, MANY_STEPS)
    tree_took, tree_peak = _since(begin), peak_gb()
    begin = time.perf_counter(), time.process_time()
    found = hg.simulation.cross_covariances(network(plant, parts[:MANY]), OWN, MANY_STEPS)
    pairs, (_, covariance) = found.joint, found.matrix_weights()
    took = _since(begin)
    return {
        "nodes": MANY,
        "steps": MANY_STEPS,
        "seconds": took[0],
        "processor_seconds": took[1],
        "peak_gb": peak_gb(),
        "local": float(np.einsum("iaia->", pairs) / MANY),
        "matrix": float(np.trace(covariance)),
        "tree_nodes": TREE_NODES,
        "tree_degree": DEGREE,
        "tree_seconds": tree_took[0],
        "tree_processor_seconds": tree_took[1],
        "tree_peak_gb": tree_peak,
        "tree_root": float(np.trace(grown.root)),
    }


def _since(begin: tuple[float, float]) -> tuple[float, float]:
    """Seconds of the clock, and of the processor."""
    return time.perf_counter() - begin[0], time.process_time() - begin[1]


def strong(seed: int) -> tuple[dict[str, float], dict[str, float]]:
    """An induction machine behind strong relays: root mean squared error of each rule, and what it claims."""
    rules = {"ci_equal": hg.fusion.EqualIntersection(), "matrix": RULES["matrix"], "all_reports": RULES["all_reports"]}
    net = machine.network(OWN, {name: hg.Fusion(OWN, rule) for name, rule in rules.items()})
    found = hg.monte_carlo(net, machine.HORIZON, STRONG_RUNS, seed, hg.Statistics())["fused"]
    claimed = {name: np.trace(item.claimed(), axis1=1, axis2=2).mean() for name, item in found.items()}
    return (
        {name: float(item.rmse()[0]) for name, item in found.items()},
        {name: float(np.sqrt(value)) for name, value in claimed.items()},
    )


def traffic(seed: int) -> dict[str, list[dict[str, float]]]:
    """Three rooms whose nodes report every d-th step, or on event: reports per step and node, error, and claim."""
    plant, parts = described("three_rooms")
    every = {f"every {d}": hg.fusion.ReportLink(every=d) for d in INTERVALS}
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        name: hg.Fusion(OWN, hg.fusion.AllReports(), uplink=link) for name, link in every.items()
    }
    for told in (True, False):
        for level in THRESHOLDS:
            sends = hg.fusion.EventSending(level, told)
            name = f"{'told' if told else 'untold'} {level}"
            fused[name] = hg.Fusion(OWN, hg.fusion.AllReports(), quantizer=sends)
    net = hg.Network(plant, network(plant, parts).nodes, fused)
    found = hg.monte_carlo(net, TRAFFIC_STEPS, RUNS // 4, seed, hg.Statistics())["fused"]
    result: dict[str, list[dict[str, float]]] = {"every": [], "told": [], "untold": []}
    late = slice(TRAFFIC_STEPS // 2, None)
    for name, item in found.items():
        kind, number = name.split()
        sent = 1 / int(number) if item.uplink is None else float(item.uplink.symbols[late].mean())
        claimed = float(np.trace(item.claimed(), axis1=1, axis2=2)[late].mean())
        square = float(np.mean(item.rmse_over_time()[late] ** 2))
        result[kind].append({"level": float(number), "reports": sent, "error": square, "claimed": claimed})
    return result


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Everything; `advance` is told what begins."""
    advance(f"{TREE_NODES} nodes in a tree, {MANY} nodes")
    of_many = scale(seed)  # first: what memory the process has had at most is of all that came before
    numbers = {}
    for name, what in CASES.items():
        advance(what)
        numbers[name] = one_case(name)
    advance("simulating three rooms")
    simulated = measured(seed)
    advance("a tree of relays")
    of_tree, levels, simulated["root"] = tree(seed)
    advance("choosing what is sent")
    sent = traffic(seed)
    advance("an induction machine")
    errors, claims = strong(seed)
    return Outcome(numbers, simulated, of_tree, levels, of_many, errors, claims, sent)
