"""What every rule reaches before any data, in three small networks, a tree of twelve nodes, and a network of many."""

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import heliograph as hg

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
RUNS, MEASURED_STEPS = 2000, 30
STAGES = len(CASES) + 3

Part = tuple[np.ndarray, float, float, float, float]  # C, variance of v, mean and variance of the gain, variance of n


@dataclass(frozen=True)
class Outcome:
    """Traces over time by case and rule, numbers for the summary, and what simulation says of one case."""

    traces: dict[str, dict[str, np.ndarray]]
    cases: dict[str, dict[str, float | list[float]]]
    measured: dict[str, dict[str, float]]
    tree: dict[str, float]
    scale: dict[str, float]


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


def heard(part: Part) -> tuple[hg.LinearSensor, hg.AbstractRandomAffine]:
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


def one_case(name: str) -> tuple[dict[str, np.ndarray], dict[str, float | list[float]]]:
    """Traces over time, and at the end."""
    plant, parts = described(name)
    net = network(plant, parts)
    found = hg.simulation.fused_covariances(net, STEPS) | {"central": central(plant, parts, STEPS)}
    traces = {rule: np.trace(p, axis1=1, axis2=2) for rule, p in found.items()}
    joint = hg.simulation.cross_covariances(net, OWN, STEPS).joint
    claimed, true = equal_intersection(joint)
    local = [float(np.trace(joint[i, :, i])) for i in range(len(parts))]
    head: dict[str, float | list[float]] = {
        "local": local, "equal_intersection_claimed": claimed, "equal_intersection_true": true,
    }  # fmt: skip
    return traces, head | {rule: float(trace[-1]) for rule, trace in traces.items()}


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


def tree(seed: int) -> dict[str, float]:
    """Twelve nodes heard by four relays, these by two, these by the root: its error, and that without the relays."""
    plant, parts = moving_point(), drawn_parts(12, seed)
    leaves = hg.simulation.cross_covariances(network(plant, parts), OWN, STEPS)
    relays = leaves.fused({f"relay {i}": leaves.nodes[3 * i : 3 * i + 3] for i in range(4)})
    upper = relays.fused({"left": relays.nodes[:2], "right": relays.nodes[2:]})
    traces = [float(np.trace(level.matrix_weights()[1])) for level in (upper, leaves)]
    best = float(np.trace(central(plant, parts, STEPS)[-1]))
    return {"root": traces[0], "flat": traces[1], "central": best}


def scale(seed: int) -> dict[str, float]:
    """All cross-covariances and matrix weights of many nodes: seconds with compilation, peak memory of the process."""
    plant, parts = moving_point(), drawn_parts(MANY, seed)
    begin = time.perf_counter()
    found = hg.simulation.cross_covariances(network(plant, parts), OWN, MANY_STEPS)
    pairs, (_, covariance) = found.joint, found.matrix_weights()
    seconds = time.perf_counter() - begin
    unit = 1e9 if sys.platform == "darwin" else 1e6
    return {
        "nodes": MANY,
        "steps": MANY_STEPS,
        "seconds": seconds,
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit,
        "local": float(np.einsum("iaia->", pairs) / MANY),
        "matrix": float(np.trace(covariance)),
    }


def compute(seed: int, advance: Callable[[str], None] = lambda what: None) -> Outcome:
    """Everything; `advance` is told what begins."""
    traces, numbers = {}, {}
    for name, what in CASES.items():
        advance(what)
        traces[name], numbers[name] = one_case(name)
    advance("simulating three rooms")
    simulated = measured(seed)
    advance("a tree of relays")
    of_tree = tree(seed)
    advance(f"{MANY} nodes")
    return Outcome(traces, numbers, simulated, of_tree, scale(seed))
