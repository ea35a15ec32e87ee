"""Time of one covariance step of the quadratic filter: half-vectorised against the full Kronecker square.

Run: OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/quadratic.py (threads would hide the operation count).
Prints one row per dimension of state plus bias. Both forms run the library's own
`covariance_step` on the same model; the full one has y (x) y with every product twice.
"""

import time
from collections.abc import Callable

import numpy as np

import heliograph as hg
from heliograph.design.linear_system import Steps
from heliograph.design.lmmse import covariance_step
from heliograph.random_affine.monomials import position

DIMENSIONS = (4, 8, 16)
REPEATS = 7


def square_of(dimension: int) -> hg.LinearSystem:
    """State and bias of half the dimension each, one output behind a relay of two hops."""
    generator = np.random.default_rng(dimension)
    half = dimension // 2
    a = generator.normal(size=(half, half))
    a *= 0.8 / np.abs(np.linalg.eigvals(a)).max()
    skewed = hg.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])
    noise = hg.Independent([skewed] * half)
    bias = hg.LinearPlant(0.5 * np.eye(half), noise, np.zeros(half), noise)
    plant = hg.with_bias(hg.LinearPlant(a, noise, np.zeros(half), noise), 0.1 * np.eye(half), bias)
    sensor = hg.LinearSensor(generator.normal(size=(1, dimension)), skewed)
    powers = hg.Discrete(np.sqrt([1.0, 1.5, 2.0]), [0.1, 0.3, 0.6])
    channel = hg.amplify_and_forward([hg.hop(powers, skewed), hg.hop(powers, skewed)])
    return hg.lifted_system(plant, sensor, channel, 2, 2)


def duplicated(system: hg.LinearSystem, dimension: int) -> tuple[Steps, np.ndarray, np.ndarray]:
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


def main() -> None:
    print("dimension  half  full  half (ms)  full (ms)  ratio  difference")
    for dimension in DIMENSIONS:
        system = square_of(dimension)
        full, start, copy = duplicated(system, dimension)
        step, spread = system.step(1), system.covariance
        fast = seconds(lambda: covariance_step(spread, step), dimension)  # noqa: B023
        slow = seconds(lambda: covariance_step(start, full), dimension)  # noqa: B023
        a, b = covariance_step(spread, step).covariance, covariance_step(start, full).covariance
        gap = np.abs(copy @ a @ copy.T - b).max() / np.abs(b).max()
        sizes = f"{dimension:>9} {len(spread):>5} {len(start):>5}"
        print(f"{sizes} {1e3 * fast:>10.4f} {1e3 * slow:>10.4f} {slow / fast:>6.2f} {gap:>11.1e}")


if __name__ == "__main__":
    main()
