"""Time to design a relay network's gains: 100 steps of the example, and the cost of a step in the state dimension."""

import os

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import heliograph as hg
from heliograph.relays.design import _propagate, initial_error_covariance
from heliograph_studies.successive_relays.setting import Setting

STEPS = 100
LIMIT = 0.020  # seconds, warm, one core


def median_time(call: Callable[[], object], repeats: int = 21) -> float:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def of_dimension(n: int) -> hg.model.RelayNetwork:
    rng = np.random.default_rng(n)
    plant = hg.LinearPlant(rng.normal(size=(n, n)) * 0.5 / np.sqrt(n), np.eye(n), np.zeros(n), np.eye(n))
    return hg.model.RelayNetwork(plant, hg.LinearSensor(rng.normal(size=(1, n)), [[1.0]]), ("relay_1", "relay_2"),
                           Setting().network().slots)  # fmt: skip


def dense(d: int) -> float:
    """One product of dense (d, d) matrices, in a scan of STEPS."""
    with jax.enable_x64(True):
        a = jax.numpy.asarray(np.random.default_rng(d).normal(size=(d, d)) / d)
        run = jax.jit(lambda x: jax.lax.scan(lambda b, _: (a @ b, None), x, None, length=STEPS)[0])
        return median_time(lambda: run(a).block_until_ready()) / STEPS


def measure() -> dict[str, Any]:
    """Milliseconds to design STEPS steps of the example."""
    network = Setting().network()
    start = time.perf_counter()
    hg.relays.local_error_design(network, STEPS)
    first = time.perf_counter() - start
    warm = median_time(lambda: hg.relays.local_error_design(network, STEPS))
    steps, moments = network.steps(STEPS), initial_error_covariance(network)
    recursion = median_time(lambda: _propagate(steps, moments))
    values = {"first call": 1e3 * first, "warm": 1e3 * warm, "recursion, of the warm call": 1e3 * recursion}
    return {"unit": "ms", "values": values, "at_most": {"warm": 1e3 * LIMIT}}


def main() -> None:
    first, warm, recursion = measure()["values"].values()
    print(f"design of {STEPS} steps: first call {first:.0f} ms, warm {warm:.2f} ms (limit {1e3 * LIMIT:.0f} ms), "
          f"of which the recursion {recursion:.2f} ms")  # fmt: skip
    print("n   design of a step (us)   dense (4 n)^3 product (us)   ratio")
    for n in (3, 6, 12, 24):
        net = of_dimension(n)
        tables, at_start = net.steps(STEPS), initial_error_covariance(net)
        step = median_time(lambda t=tables, s=at_start: _propagate(t, s), 7) / STEPS
        product = dense(4 * n)
        print(f"{n:<3} {1e6 * step:>10.1f} {1e6 * product:>22.1f} {step / product:>22.1f}")
    if warm > 1e3 * LIMIT:
        raise SystemExit(f"design of {STEPS} steps: expected at most {1e3 * LIMIT:g} ms, got {warm:.2f} ms")


if __name__ == "__main__":
    main()
