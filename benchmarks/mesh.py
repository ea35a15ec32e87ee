"""Estimation without a centre in numbers: errors over a centre's beside what no rule beats, and the time of a step.

Run: python benchmarks/mesh.py [--nodes 20 100 1000] [--graphs 10]; it writes benchmarks/mesh.json.
Graphs are drawn in the unit square until connected; half of the nodes have no sensor, the others measure one of two
positions. Errors are the mean over nodes of the trace, before any data for drawn losses, in units of the error of a
filter that receives everything; "nodes within" is the largest root mean squared error of a node over that of best
weights.
"""

import argparse
import json
import time
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

import heliograph as hg
from heliograph.fusion import DiagonalWeights, DiffusionWeights, MatrixWeights, TraceIntersection
from heliograph.simulation import best_possible, freeze, mesh_arrivals, mesh_errors

RADIUS = {20: 0.34, 100: 0.17, 1000: 0.06}
STEPS, LAST = {20: 80, 100: 100, 1000: 70}, 20  # steps; every fifth of the last is averaged where messages get lost
A = 0.98 * np.kron(np.eye(2), [[1.0, 1.0], [0.0, 0.97]])
Q = np.kron(np.eye(2), 0.02 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
PLANT = hg.LinearPlant(A, Q, np.zeros(4), np.eye(4))
RULES: dict[str, hg.fusion.AbstractFusion] = {
    "best": MatrixWeights(),
    "diagonal": DiagonalWeights(),
    "trace": TraceIntersection(),
    "least trace": hg.CovarianceIntersection(),
    "diffusion": DiffusionWeights(),
}
LARGE = ("best", "diagonal", "trace")  # of a thousand nodes: a step of their joint covariance takes seconds


def graph(nodes: int, generator: np.random.Generator) -> dict[str, tuple[str, ...]]:
    """Neighbours of nodes drawn in the unit square, all of which can be reached."""
    while True:
        places = {f"n{i}": generator.random(2) for i in range(nodes)}
        near = hg.fusion.neighbours_within(places, RADIUS[nodes])
        seen, ahead = {"n0"}, ["n0"]
        while ahead:
            new = set(near[ahead.pop()]) - seen
            seen |= new
            ahead += new
        if len(seen) == nodes:
            return near


def world(nodes: int, loss: float, seed: int) -> tuple[hg.Network, float]:
    """A network with a fusion by each rule, and the trace of a centre's error."""
    generator = np.random.default_rng(seed)
    near = graph(nodes, generator)
    sensing, information = set(generator.permutation(nodes)[nodes // 2 :].tolist()), np.zeros((4, 4))
    parts: dict[str, hg.Node | None] = {}
    for i in range(nodes):
        parts[f"n{i}"] = None
        if i in sensing:
            row, noise = np.eye(1, 4, 2 * int(generator.integers(2))), 0.2 * (1 + 2 * generator.random())
            sensor = hg.LinearSensor(row, noise)
            parts[f"n{i}"] = hg.Node(sensor, hg.perfect(), {"alone": hg.kalman_filter(PLANT, sensor)})
            information += row.T @ row / noise
    covariance = np.eye(4)
    for _ in range(200):
        covariance = np.linalg.inv(np.linalg.inv(A @ covariance @ A.T + Q) + information)
    link = hg.erasure(hg.perfect(), 1 - loss) if loss else None
    names = RULES if nodes < 1000 else LARGE
    fused = {name: hg.Fusion("alone", RULES[name], neighbours=near, link=link) for name in names}
    return hg.Network(PLANT, parts, fused), float(np.trace(covariance))


def errors(nodes: int, loss: float, seed: int) -> dict[str, float]:
    """Error of each rule over a centre's, its claim where that is another number, and the bound."""
    network, centre = world(nodes, loss, seed)
    steps = STEPS[nodes]
    arrived = mesh_arrivals(network, next(iter(network.meshes)), steps, seed)
    # Rules and bound after the same steps.
    ends = np.arange(steps - LAST + 5, steps + 1, 5) if loss else np.array([steps])
    last = ends - 1
    bound = [np.trace(best_possible(network, next(iter(network.meshes)), arrived[:k]), axis1=1, axis2=2) for k in ends]
    result = {"no rule better": float(np.mean(bound)) / centre}
    by_node = {}
    for name in network.meshes:
        found = mesh_errors(network, name, arrived)
        by_node[name] = np.trace(found.actual[last], axis1=2, axis2=3).mean(axis=0)
        result[name] = float(by_node[name].mean()) / centre
        if found.actual is not found.claimed and not np.array_equal(found.actual, found.claimed):
            result[f"{name}, claimed"] = float(np.trace(found.claimed[last], axis1=2, axis2=3).mean()) / centre
    reference = by_node[next(iter(by_node))]
    for name, item in by_node.items():
        result[f"{name}, nodes within"] = float(np.sqrt(item / reference).max())
    return result


def speed(nodes: int, steps: int, rule: str, settle: int = 45) -> dict[str, float]:
    """Seconds of a recording of so many steps, its error over a centre's, and the smallest and largest NEES.

    On a machine that others use, seconds of a processor over the processors are what an idle one needs.
    """
    network, centre = world(nodes, 0.2, 0)
    network = hg.Network(PLANT, network.nodes, {rule: network.meshes[rule]})
    if rule == "diagonal":
        network = freeze(network, rule, mesh_arrivals(network, rule, settle, 1), last=settle // 3)
    generator = np.random.default_rng(0)
    states, x, root = [], generator.standard_normal(4), np.linalg.cholesky(Q)
    for _ in range(steps):
        x = A @ x + root @ generator.standard_normal(4)
        states.append(x)
    truth, z = np.array(states), {}
    for name, node in network.nodes.items():
        z[name] = np.zeros((steps, 0))
        if isinstance(node, hg.Node):
            noise = np.sqrt(node.sensor.noise.covariance[0, 0]) * generator.standard_normal((steps, 1))
            z[name] = truth @ node.sensor.matrix.T + noise
    near = network.meshes[rule].neighbours or {}
    flags = {n: np.where(generator.random((steps, len(m))) < 0.8, 1.0, np.nan) for n, m in near.items() if m}
    seconds, processor = [], []
    for _ in range(3):
        begun, used = time.perf_counter(), time.process_time()
        record = hg.run(network, z, reports={rule: flags})
        seconds.append(time.perf_counter() - begun)
        processor.append(time.process_time() - used)
    off = np.stack([truth - np.asarray(record.estimates[n][rule].mean) for n in network.names])[:, 50:]
    claimed = np.stack([np.asarray(record.estimates[n][rule].covariance) for n in network.names])[:, 50:]
    nees = np.einsum("nta,nta->nt", off, np.linalg.solve(claimed, off[..., None])[..., 0]).mean(axis=1) / 4
    return {
        "first": seconds[0],
        "seconds": min(seconds[1:]),
        "first, of a processor": processor[0],
        "of a processor": min(processor[1:]),
        "error": float((off**2).sum(axis=2).mean()) / centre,
        "least NEES": float(nees.min()),
        "largest NEES": float(nees.max()),
    }


def read() -> dict[str, Any]:
    """Measurements of earlier runs; graphs that were drawn are not drawn again."""
    path = Path(__file__).with_suffix(".json")
    return json.loads(path.read_text()) if path.exists() else {}


def add(key: str, measured: dict[str, Any]) -> None:
    """Write one measurement beside the others."""
    Path(__file__).with_suffix(".json").write_text(json.dumps(read() | {key: measured}, indent=1) + "\n")


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--nodes", type=int, nargs="*", default=list(RADIUS))
    parser.add_argument("--graphs", type=int, default=10)
    parser.add_argument("--losses", type=float, nargs="*", default=[0.0, 0.2])
    parser.add_argument("--speed", nargs="*", default=["trace", "diagonal"])
    parser.add_argument("--sizes", type=int, nargs="*", default=[1000], help="nodes of --speed")
    options = parser.parse_args()
    for nodes, loss in product(options.nodes, options.losses):
        key = f"{nodes} nodes, {loss:g} lost"
        drawn: list[dict[str, float]] = read().get(key, {}).get("each", [])
        for seed in range(len(drawn), options.graphs):
            drawn.append({k: round(v, 4) for k, v in errors(nodes, loss, seed).items()})
            means = {k: [round(float(f([d[k] for d in drawn])), 3) for f in (np.mean, np.std)] for k in drawn[0]}
            add(key, {"graphs": len(drawn), "mean and deviation": means, "each": drawn})
            print(key, seed, means, flush=True)
    for nodes, rule in product(options.sizes, options.speed):
        made = speed(nodes, 1000, rule)
        add(f"{nodes} nodes, 1000 steps, {rule}", made)
        print(nodes, rule, made, flush=True)


if __name__ == "__main__":
    main()
