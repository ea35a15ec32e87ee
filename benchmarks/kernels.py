"""Time of one filter step of one run, beside the same step written with the library's factorisations under vmap.

Run: python benchmarks/kernels.py. Every pair of programs agrees before it is timed. The floor is the least arithmetic
of a step at the arithmetic rate of one core, PEAK; it counts neither memory nor the launch of each small program.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve

import heliograph as hg
from heliograph.papers.cubature_fusion.compute import network
from heliograph.papers.cubature_fusion.setting import PRINTED, STRONG, cubature, plant, sensor

PEAK = 40e9  # flops per second: 8 numbers wide, two operations a cycle, 2.6 GHz
STEPS, REPEATS = 40, 7
KALMAN_FLOPS, CUBATURE_FLOPS = 450, 1_750  # symmetric results by half
BLOCKS = (64, 256, 1024)
Step = Callable[[Any, Any], Any]


def kalman(rng: np.random.Generator) -> tuple[Step, Step, Any, Callable[[int], Any]]:
    """Four states, two measurements, a known gain that differs at each step and run: ours, the library's, the start."""
    a, c, q, r = 0.9 * np.eye(4) + 0.05 * rng.normal(size=(4, 4)), rng.normal(size=(2, 4)), 0.1 * np.eye(4), np.eye(2)
    model = hg.LinearPlant(a, q, np.zeros(4), np.eye(4))

    def ours(state: Any, item: Any) -> Any:
        known = hg.LinearSensor(item[0][:, None] * c, r)
        return hg.extended_filter(model, known, hg.perfect(2)).step(state, item[1])[0]

    def library(state: Any, item: Any) -> Any:
        mean, spread, h = a @ state[0], a @ state[1] @ a.T + q, item[0][:, None] * c
        return _corrected(mean, spread, h @ spread, h @ spread @ h.T + r, item[1] - h @ mean)

    def data(runs: int) -> Any:
        return rng.uniform(0.5, 1.0, (STEPS, runs, 2)), rng.normal(size=(STEPS, runs, 2))

    return ours, library, hg.extended_filter(model, hg.LinearSensor(c, r), hg.perfect(2)).init(), data


def relayed(rng: np.random.Generator) -> tuple[Step, Step, Any, Callable[[int], Any]]:
    """Five states, two measurements behind relays whose gains have known laws, cubature: likewise."""
    known = replace(
        STRONG, sensor_gain=hg.Discrete([0.7, 1.0], [0.5, 0.5]), relay_gain=hg.Discrete([0.8, 1.0], [0.5, 0.5])
    )
    ckf, c = cubature(known, 0, hg.Polytope()), np.asarray(sensor(known, 0).matrix)
    q, r, eye = known.process_noise * np.eye(5), known.sensor_noise * np.eye(2), np.eye(2)
    gain = known.amplitude * known.mean_gain
    power = known.amplitude**2 * known.relay_gain.moment(2) * known.sensor_gain.moment(2)
    relay = known.amplification**2 * known.relay_power * known.relay_gain.moment(2)
    noise = relay * known.relay_noise + known.receiver_noise

    def moments(function: Callable[[Any], Any], mean: Any, spread: Any) -> Any:
        offsets = np.sqrt(5) * jnp.linalg.cholesky(spread).T
        offsets = jnp.concatenate([offsets, -offsets])
        values = jax.vmap(function)(mean + offsets)
        apart = values - values.mean(axis=0)
        return values.mean(axis=0), apart.T @ apart / 10, offsets.T @ apart / 10

    def ours(state: Any, z: Any) -> Any:
        return ckf.step(state, z)[0]

    def library(state: Any, z: Any) -> Any:
        mean, spread, _ = moments(lambda x: plant(known).transition(x, ()), *state)
        spread = spread + q
        y, inner, cross = moments(lambda x: c @ x, mean, spread)
        inner = inner + r
        omega = power * (inner + jnp.outer(y, y)) - gain**2 * jnp.outer(y, y) + noise * eye
        return _corrected(mean, spread, gain * cross.T, omega, z - gain * y)

    return ours, library, ckf.init(), lambda runs: 0.1 * rng.normal(size=(STEPS, runs, 2))


def _corrected(mean: Any, spread: Any, cross: Any, omega: Any, innovation: Any) -> Any:
    gain = cho_solve((jnp.linalg.cholesky(omega), True), cross).T
    return mean + gain @ innovation, spread - gain @ cross


def nanoseconds(step: Step, start: Any, data: Any, runs: int) -> tuple[float, float, Any]:
    """Of one step of one run, seconds to compile, and the last state."""
    states = jax.tree.map(lambda leaf: jnp.tile(leaf, (runs, *[1] * np.ndim(leaf))), tuple(start))
    if hasattr(start, "_fields"):
        states = type(start)(*states)

    def scan(states: Any, data: Any) -> Any:
        body = jax.vmap(lambda state, item: step(state, item))
        return jax.lax.scan(lambda s, item: (type(s)(*body(s, item)) if hasattr(s, "_fields") else body(s, item), None),
                            states, data)[0]  # fmt: skip

    began = time.perf_counter()
    program = jax.jit(scan).lower(states, data).compile()
    compiling, best = time.perf_counter() - began, np.inf
    data = jax.tree.map(jnp.asarray, data)
    for _ in range(REPEATS):
        began = time.perf_counter()
        last = jax.block_until_ready(program(states, data))
        best = min(best, time.perf_counter() - began)
    return 1e9 * best / STEPS / runs, compiling, last


def main() -> None:
    print("step      runs   ours (ns)  library (ns)  ratio  floor (ns)  compile (s)  difference")
    problems = {"kalman": (kalman, 10_000, KALMAN_FLOPS), "cubature": (relayed, 20_000, CUBATURE_FLOPS)}
    with jax.enable_x64(True):
        for name, (problem, many, flops) in problems.items():
            ours, library, start, draw = problem(np.random.default_rng(0))
            for runs in (*BLOCKS, many):
                data = draw(runs)
                fast, compiling, a = nanoseconds(ours, start, data, runs)
                slow, _, b = nanoseconds(library, start, data, runs)
                gap = max(float(jnp.abs(x - y).max() / jnp.abs(y).max()) for x, y in zip(a, b, strict=True))
                assert gap < 1e-9, gap  # rounding of 40 steps
                print(f"{name:<9} {runs:>5} {fast:>10.0f} {slow:>13.0f} {slow / fast:>6.1f} {1e9 * flops / PEAK:>11.0f}"
                      f" {compiling:>12.1f} {gap:>11.1e}")  # fmt: skip
    example, seconds = network(PRINTED), []
    for seed in range(REPEATS):
        began = time.perf_counter()
        hg.monte_carlo(example, PRINTED.horizon, 50, seed, hg.Statistics())
        seconds.append(time.perf_counter() - began)
    print(f"cubature fusion, 50 runs: first call {seconds[0]:.1f} s, warm {min(seconds[1:]):.3f} s")


if __name__ == "__main__":
    main()
