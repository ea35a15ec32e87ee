"""Time of one covariance step of the quadratic filter: half-vectorised against the full Kronecker square.

Run: python benchmarks/quadratic.py, on one thread (more would hide the operation count). Prints one row per dimension
of state plus bias. Both forms run the library's own `step_covariance_roots` on the same model; the full one has
y (x) y with every product twice.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import heliograph as hg
from heliograph.factors.square_root_update import covariance_of_root, roots_of
from heliograph.linear.lmmse_recursion import RecursionStep, find_noise_roots, step_covariance_roots
from heliograph.linear.system import Steps
from heliograph.random_affine.moments.monomials import position

DIMENSIONS = (4, 8, 16)
REPEATS = 7


def square_of(dimension: int) -> hg.linear.LinearSystem:
    """State and bias of half the dimension each, one output behind a relay of two hops."""
    generator = np.random.default_rng(dimension)
    half = dimension // 2
    a = generator.normal(size=(half, half))
    a *= 0.8 / np.abs(np.linalg.eigvals(a)).max()
    skewed = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])
    noise = hg.random_affine.Independent([skewed] * half)
    bias = hg.LinearPlant(0.5 * np.eye(half), noise, np.zeros(half), noise)
    state, driven = hg.LinearPlant(a, noise, np.zeros(half), noise), 0.1 * np.eye(half)
    row = generator.normal(size=(1, dimension))  # the output has the state in it, and the bias
    sensor = hg.LinearSensor(row[:, :half], skewed)
    plant, sensor = hg.model.with_bias(state, sensor, bias, coupling=driven, loading=row[:, half:])
    powers = hg.Discrete(np.sqrt([1.0, 1.5, 2.0]), [0.1, 0.3, 0.6])
    channel = hg.amplify_and_forward([hg.hop(powers, skewed), hg.hop(powers, skewed)])
    return hg.linear.lifted_system(plant, sensor, channel, 2, 2)


def duplicated(system: hg.linear.LinearSystem, dimension: int) -> tuple[Steps, np.ndarray, np.ndarray]:
    """The last step and the start in the full form [y; y (x) y], and the matrix that copies the half into the full."""
    places, unit = position(dimension + 1, 2), np.eye(dimension + 1, dtype=int)
    rows = [places[tuple(unit[i] + unit[-1])] for i in range(dimension)]
    rows += [places[tuple(unit[i] + unit[j])] for i in range(dimension) for j in range(dimension)]
    copy = np.eye(len(system.mean))[rows]
    back = np.linalg.pinv(copy)
    s = system.step(1)
    inner = copy @ s.transition @ back, copy @ s.drift, copy @ s.process @ copy.T
    full = Steps(*inner, s.output @ back, s.offset, s.noise)
    return full, copy @ system.covariance @ copy.T, copy


def seconds(call: Callable[[], object], dimension: int) -> float:
    """Best of several timings of one call."""
    loops = max(1, 4000 // dimension**3)
    best = np.inf
    for _ in range(REPEATS):
        start = time.perf_counter()
        for _ in range(loops):
            call()
        best = min(best, (time.perf_counter() - start) / loops)
    return float(best)


def prepared(step: Steps, covariance: np.ndarray) -> Callable[[], RecursionStep]:
    """The covariance step of this model, whose roots are taken before the clock starts."""
    return partial(step_covariance_roots, roots_of(covariance), step, find_noise_roots(step, np.diag(covariance)))


class Row(NamedTuple):
    """Sizes, seconds and relative difference of the two forms."""

    half: int
    full: int
    fast: float
    slow: float
    gap: float


def row(dimension: int) -> Row:
    """Both forms at one dimension."""
    system = square_of(dimension)
    full, start, copy = duplicated(system, dimension)
    half, whole = prepared(system.step(1), system.covariance), prepared(full, start)
    fast, slow = seconds(half, dimension), seconds(whole, dimension)
    a, b = covariance_of_root(half().root), covariance_of_root(whole().root)
    gap = float(np.abs(copy @ a @ copy.T - b).max() / np.abs(b).max())
    return Row(len(system.covariance), len(start), fast, slow, gap)


def measure() -> dict[str, Any]:
    """Milliseconds of a step in both forms."""
    values = {}
    for dimension in DIMENSIONS:
        r = row(dimension)
        values[f"dimension {dimension}, half-vectorised"] = 1e3 * r.fast
        values[f"dimension {dimension}, full square"] = 1e3 * r.slow
    return {"unit": "ms", "values": values, "at_most": {}}


def main() -> None:
    print("dimension  half  full  half (ms)  full (ms)  ratio  difference")
    for dimension in DIMENSIONS:
        r = row(dimension)
        sizes = f"{dimension:>9} {r.half:>5} {r.full:>5}"
        print(f"{sizes} {1e3 * r.fast:>10.4f} {1e3 * r.slow:>10.4f} {r.slow / r.fast:>6.2f} {r.gap:>11.1e}")


if __name__ == "__main__":
    main()
