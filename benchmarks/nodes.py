"""What the number of nodes costs: the first call, which compiles, and the time per node, step and run of later ones.

Run: python benchmarks/nodes.py [--old SRC], SRC the `src` folder of another release, measured beside on few nodes.
A linear plant of 4 states, 2 outputs, a two-hop Rayleigh relay, the linear filter, statistics, 50 steps; the first call
has 64 runs. Each number of nodes in a process of its own; "again" finds the compiled programs on disk.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from typing import Any

NODES = (4, 64, 256, 1024)
FIRST_CALL, AGAIN, STEP, STEP_ERASED = 8.0, 3.0, 250.0, 600.0  # at most: seconds, seconds, and ns
PROGRAM = """
import json, sys, time
import numpy as np
import heliograph as hg
nodes, runs, erased, cache = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "erased", sys.argv[4]
if cache:
    (getattr(hg, "simulation", None) or hg).keep_compilations(cache)
steps, generator = 50, np.random.default_rng(0)
plant = hg.LinearPlant(0.95 * np.eye(4) + 0.05 * np.eye(4, k=1), 0.1 * np.eye(4), np.zeros(4), np.eye(4))

def node(i):
    sensor = hg.LinearSensor(generator.normal(size=(2, 4)), 0.1)
    laws = hg.Rayleigh(0.8), hg.Rayleigh(0.9)
    relay = hg.amplify_and_forward([hg.hop(law, 0.02, dimension=2) for law in laws])
    received = hg.erasure(relay, 0.9) if erased else relay
    return hg.Node(sensor, received, {"linear": hg.linear_filter(plant, sensor, relay)})

def seconds(count, seed):
    start = time.perf_counter()
    hg.monte_carlo(network, steps, count, seed, hg.Statistics())
    return time.perf_counter() - start

network = hg.Network(plant, {f"n{i}": node(i) for i in range(nodes)})
first = seconds(64, 0)
if runs:
    seconds(runs, 1)
    warm = min(seconds(runs, 2 + i) for i in range(3))
print(json.dumps([first, 1e9 * warm / (nodes * steps * runs) if runs else None]))
"""


def single(nodes: int, runs: int, cache: str = "", erased: bool = False, source: str | None = None) -> list[float]:
    """Seconds of the first call, and nanoseconds per node, step and run of later ones with so many runs (0: none)."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    if source is not None:
        environment["PYTHONPATH"] = source
    command = [sys.executable, "-c", PROGRAM, str(nodes), str(runs), "erased" if erased else "whole", cache]
    completed = subprocess.run(command, check=True, env=environment, stdout=subprocess.PIPE, text=True)
    result: list[float] = json.loads(completed.stdout.splitlines()[-1])
    return result


def measure(old: str | None = None) -> dict[str, Any]:
    """First calls by number of nodes, without and with compiled programs on disk, and the time of later calls."""
    first, again, step = {}, {}, {}
    for nodes in NODES:
        with tempfile.TemporaryDirectory() as folder:
            first[str(nodes)], step[str(nodes)] = single(nodes, max(20_000 * 4 // nodes, 64), folder)
            again[str(nodes)] = single(nodes, 0, folder)[0]
    erased = single(4, 20_000, erased=True)[1]
    values = {f"first call, {n} nodes (s)": value for n, value in first.items()}
    values |= {f"again, {n} nodes (s)": value for n, value in again.items()}
    values |= {f"{n} nodes (ns per node, step, run)": value for n, value in step.items()}
    values |= {"4 nodes, erased (ns per node, step, run)": erased}
    at_most = {f"first call, {n} nodes (s)": FIRST_CALL for n in first} | {
        f"again, {n} nodes (s)": AGAIN for n in again
    }
    at_most |= {
        "4 nodes (ns per node, step, run)": STEP,
        "4 nodes, erased (ns per node, step, run)": STEP_ERASED,
    }
    results = {"unit": "see each", "values": values, "at_most": at_most, "first_call_s": first, "again_s": again}
    results |= {"ns_per_node_step_run": step, "ns_per_node_step_run_erased": {"4": erased}}
    if old is not None:
        measured = {str(n): single(n, 20_000 if n == 4 else 0, source=old) for n in NODES[:2]}
        results["old_release"] = {
            "first_call_s": {n: times[0] for n, times in measured.items()},
            "ns_per_node_step_run": {"4": measured["4"][1]},
        }
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description="What the number of nodes costs.")
    parser.add_argument("--old", help="the src folder of another release, measured beside")
    print(json.dumps(measure(parser.parse_args().old), indent=1))


if __name__ == "__main__":
    main()
