"""What a number of nodes costs: the first call, which compiles, and each node, step and run of many.

Run: python benchmarks/nodes.py [--quick] [PYTHON]; with the PYTHON of another environment, its release is measured.
Linear plant of 4 states, 2 outputs behind two Rayleigh hops, the linear filter, running statistics. Each first call is
64 runs of 50 steps in a process of its own: cold, and again with the programs that the cold one kept.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from typing import Any

NODES = (4, 64, 256, 1024)
COLD, KEPT, RATE, LOST_RATE = 8.0, 3.0, 250.0, 600.0  # seconds, and nanoseconds per node, step and run
MANY = 20_000  # runs, of 4 nodes
FIRST = """
import json, sys, time
import numpy as np
import heliograph as hg

def network(nodes, arrival=None):
    rng = np.random.default_rng(0)
    plant = hg.LinearPlant(0.95 * np.eye(4) + 0.02 * rng.normal(size=(4, 4)), 0.1 * np.eye(4), np.zeros(4), np.eye(4))
    made = {}
    for i in range(nodes):
        sensor = hg.LinearSensor(rng.normal(size=(2, 4)), 0.1 * np.eye(2))
        heard = hg.amplify_and_forward([hg.hop(hg.Rayleigh(1.0), 0.1, dimension=2)] * 2)
        channel = heard if arrival is None else hg.erasure(heard, arrival)
        made[f"n{i}"] = hg.Node(sensor, channel, {"linear": hg.linear_filter(plant, sensor, heard)})
    return hg.Network(plant, made)

def seconds(item, runs, seed):
    start = time.perf_counter()
    hg.monte_carlo(item, 50, runs, seed, hg.Statistics())
    return time.perf_counter() - start
"""
ONE = FIRST + "print(json.dumps(seconds(network(int(sys.argv[1])), 64, 0)))\n"
WARM = FIRST + (
    "runs, arrival = int(sys.argv[1]), json.loads(sys.argv[2])\n"
    "item = network(4, arrival)\n"
    "times = [seconds(item, runs, seed) for seed in range(4)]\n"
    "print(json.dumps(1e9 * min(times[1:]) / (4 * 50 * runs)))\n"
)


def said(program: str, arguments: Sequence[object], python: str, cache: str) -> float:
    """The number that a program prints, in a process of its own that keeps compiled programs in `cache`."""
    environment = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1"}
    found = subprocess.run(
        [python, "-c", program, *map(str, arguments)], env=os.environ | environment, stdout=subprocess.PIPE, check=True
    )
    return float(json.loads(found.stdout.splitlines()[-1]))


def measure(nodes: Sequence[int] = NODES, runs: int = MANY, python: str = sys.executable) -> dict[str, Any]:
    """Seconds of the first call by number of nodes, and nanoseconds per node, step and run of many runs."""
    values, most = {}, {}
    for count in nodes:
        with tempfile.TemporaryDirectory() as cache:
            for how, limit in (("cold", COLD), ("kept", KEPT)):
                key = f"first_call_s {count} {how}"
                values[key], most[key] = said(ONE, [count], python, cache), limit
    with tempfile.TemporaryDirectory() as cache:
        for key, arrival, limit in (("4", "null", RATE), ("4 with losses", "0.9", LOST_RATE)):
            key = f"ns_per_node_step_run {key}"
            values[key], most[key] = said(WARM, [runs, arrival], python, cache), limit
    return {"unit": "s, and ns per node, step and run", "values": values, "at_most": most}


def main() -> None:
    """Measure and print."""
    quick = "--quick" in sys.argv
    others = [a for a in sys.argv[1:] if a != "--quick"]
    python = others[0] if others else sys.executable
    found = measure((4,), 640, python) if quick else measure(python=python)
    for key, value in found["values"].items():
        print(f"{key:<36}{value:>10.2f}  at most {found['at_most'][key]:g}")


if __name__ == "__main__":
    main()
