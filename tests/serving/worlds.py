"""Two small networks, messages for fleets of them, and a service over each; what is compiled is shared."""

import json
from functools import cache

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram

SENSOR = hg.LinearSensor([[1.0]], 0.1)
HOP = hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
WINDOW = 5.0


@cache
def moving() -> hg.Network:
    """Continuous time: a position driven by noise and a speed that is given, received by two nodes."""
    plant = hg.Plant(lambda x, u: x + u[0] * u[1], lambda u: jnp.diag(0.3 * u[1:]), [0.0], 1.0, inputs=["speed", "dt"])
    node = hg.Node(SENSOR, HOP, {"cubature": hg.cubature_filter(plant, SENSOR, HOP)})
    return hg.Network(plant, {"a": node, "b": node})


@cache
def stepping() -> hg.Network:
    """Time counts steps: a pushed state, two nodes, fused by intersection."""
    plant = hg.LinearPlant([[0.95]], 0.04, [1.0], 0.5, [[1.0]], inputs=["push"])
    node = hg.Node(SENSOR, HOP, {"linear": hg.linear_filter(plant, SENSOR, HOP)})
    return hg.Network(plant, {"a": node, "b": node}, {"both": hg.Fusion("linear", hg.fusion.EqualIntersection())})


def fleet(network: hg.Network, window: float = WINDOW, **options: float) -> Fleet:
    """A fleet of its own, of a program that all share."""
    return Fleet(_lanes(id(network)), Options(window, **options))


@cache
def _lanes(which: int) -> NetworkProgram:
    return NetworkProgram(next(network for network in (moving(), stepping()) if id(network) == which))


def messages(plants: int, count: int, seed: int, whole: bool, longest: float = 3.0) -> list[dict[str, object]]:
    """Of each plant some from both nodes, a third late by up to `longest`, in the order of their arrival."""
    generator, results = np.random.default_rng(seed), []
    for plant in range(plants):
        for i in range(count):
            time = float(i // 2) if whole else round(float(i * 0.4 + generator.uniform(0, 0.3)), 3)
            delay = generator.uniform(0, longest) if generator.random() < 1 / 3 else 0.0
            item: dict[str, object] = {
                "plant": f"p{plant}", "node": "ab"[i % 2], "sequence": i // 2, "time": time,
                "values": [None if generator.random() < 0.1 else float(generator.normal(1.0, 0.5))],
                "arrival": time + delay,
            }  # fmt: skip
            if i % 6 == 0:
                item["inputs"] = [float(generator.normal(0, 0.1))]
            results.append(item)
    return sorted(results, key=lambda item: item["arrival"])


def lines(result: list[dict[str, object]]) -> list[bytes]:
    """Messages as they travel."""
    return [json.dumps(item).encode() for item in result]
