"""Networks whose local filters see one plant: the published-style cases, and random ones."""

import numpy as np

import heliograph as hg

CV = 0.98 * np.kron(np.eye(2), [[1, 1], [0, 0.97]])
CV_NOISE = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1]]))


def two_gains(mean, variance):
    """A gain of this mean and variance."""
    return hg.Discrete([mean - np.sqrt(variance), mean + np.sqrt(variance)], [0.5, 0.5])


def network(plant, parts, fused, order=None):
    """Nodes (C, R, mean gain, its variance, N) with the best linear filter "local" each."""
    nodes = {}
    for i in range(len(parts)) if order is None else order:
        c, r, mean, variance, noise = parts[i]
        sensor = hg.LinearSensor(c, r * np.eye(len(c)))
        channel = hg.hop(two_gains(mean, variance), noise=noise * np.eye(len(c)))
        nodes[f"node {i}"] = hg.Node(sensor, channel, {"local": hg.linear_filter(plant, sensor, channel)})
    return hg.Network(plant, nodes, fused)


def rules():
    """Every informed rule, of the filter "local"."""
    f = hg.fusion
    results = {
        "matrix": f.MatrixWeights(),
        "matrix_with_mean": f.MatrixWeights(with_mean=True),
        "diagonal": f.DiagonalWeights(),
        "scalar": f.ScalarWeights(),
        "all_reports": f.AllReports(),
    }
    return {name: hg.Fusion("local", rule) for name, rule in results.items()}


def case(name):
    """Plant and nodes of a case."""
    item = np.eye(4)
    if name == "three_partial":
        outputs = [item[[0]], item[[2]], (item[[0]] + item[[2]]) / np.sqrt(2)]
        parts = list(zip(outputs, [0.2] * 3, [0.8, 0.9, 0.7], [0.05, 0.1, 0.08], [0.1] * 3, strict=True))
        return hg.LinearPlant(CV, CV_NOISE, np.zeros(4), item), parts
    if name == "three_rooms":
        rooms = np.diag([0.9, 0.8, 0.95]) + 0.1 * np.diag([1, 1], 1)
        parts = [(np.eye(3)[[i]], 0.1, 0.8, 0.06, 0.05) for i in range(3)]
        return hg.LinearPlant(rooms, 0.1 * np.eye(3), np.zeros(3), np.eye(3)), parts
    return hg.LinearPlant(CV, CV_NOISE, np.zeros(4), item), [(item[[0, 2]], 0.3, 0.8, 0.1, 0.2)] * 4


def random_case(seed, nodes=3, n=3):
    """A random plant with a mean, and nodes that receive one or two numbers; some receive the same."""
    draw = np.random.default_rng(seed)
    matrix = draw.normal(size=(n, n)) / np.sqrt(n)
    root = draw.normal(size=(n, n))
    plant = hg.LinearPlant(matrix, root @ root.T / 10, draw.normal(size=n), np.eye(n))
    parts = [
        (draw.normal(size=(1 + i % 2, n)), 0.1 + draw.random(), 0.5 + draw.random(), draw.random() / 5, draw.random())
        for i in range(nodes)
    ]
    return plant, parts
