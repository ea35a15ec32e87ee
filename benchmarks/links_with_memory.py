"""Cost of memory: the exact filter of a 4-state plant behind two modes beside the one that assumes no memory.

Run: python benchmarks/links_with_memory.py. Both have their gains computed once; each filters the same measurements of
RUNS runs, in turn, and the least time of each counts.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

RUNS, STEPS, REPEATS = 10_000, 100, 7


def filters() -> dict[str, hg.filters.AbstractFilter]:
    """Planned for STEPS steps."""
    turn = np.array([[0.95, 0.2], [-0.2, 0.95]])
    plant = hg.LinearPlant(np.kron(np.eye(2), turn), 0.1 * np.eye(4), np.zeros(4), np.eye(4))
    sensor = hg.LinearSensor([[1.0, 0.0, 0.5, 0.0]], 0.05)
    channel = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.2, 0.05), fail=0.03, recover=0.05)
    items = {
        "no memory": hg.filters.memoryless_filter(plant, sensor, channel),
        "two modes": hg.linear_filter(plant, sensor, channel),
    }
    return {name: item.planned(np.zeros((STEPS, 0))) for name, item in items.items()}


def means_of(item: hg.filters.AbstractFilter) -> Callable[[jax.Array], jax.Array]:
    """All estimates of one run."""

    def run(z: jax.Array) -> jax.Array:
        def step(state: Any, row: tuple[jax.Array, jax.Array]) -> tuple[Any, jax.Array]:
            after, estimate = item.step(state, row[1], (), row[0])
            return after, jnp.asarray(estimate.mean)

        start = jax.tree.map(jnp.asarray, item.init())
        return jax.lax.scan(step, start, (jnp.arange(STEPS), z))[1]

    return run


def measure() -> dict[str, Any]:
    """Nanoseconds of a step and run of each, and their ratio."""
    z = np.random.default_rng(0).normal(size=(RUNS, STEPS, 1))
    runs = {name: means_of(item) for name, item in filters().items()}
    for run in runs.values():
        hg.simulation.over_runs(run, z)  # compiles
    best = dict.fromkeys(runs, np.inf)
    for _ in range(REPEATS):
        for name, run in runs.items():
            start = time.perf_counter()
            hg.simulation.over_runs(run, z)
            best[name] = min(best[name], time.perf_counter() - start)
    values = {f"{name} (ns per step and run)": 1e9 * seconds / (RUNS * STEPS) for name, seconds in best.items()}
    values["ratio"] = best["two modes"] / best["no memory"]
    return {"unit": "ns, and their ratio", "values": values, "at_most": {"ratio": 2.5}}


if __name__ == "__main__":
    for key, value in measure()["values"].items():
        print(f"{key:<36}{value:>10.2f}")
