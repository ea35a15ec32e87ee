"""Cost of a filter of one's own: a textbook's Kalman filter beside the library's, and an ensemble filter by member.

Run: python benchmarks/own_filters.py. Constant velocity in the plane, the place seen, one number in twenty lost. Each
filters the same measurements of RUNS runs, in turn, natively, and the least time of all threads together counts.
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from links_with_memory import STEPS, means_of

import heliograph as hg
from heliograph.engine.choice import engine_of

RUNS, PASSES, MEMBERS = 512, 25, 100
LOST = 0.05
PLANT = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), 0.01 * np.eye(4), np.zeros(4), np.eye(4))
SENSOR = hg.LinearSensor(np.eye(2, 4), 0.1 * np.eye(2))


class Own(hg.filters.AbstractFilter):
    """What both filters of one's own say of themselves."""

    claim: str = eqx.field(static=True, default="nominal")
    states: tuple = eqx.field(static=True, default=PLANT.states)
    inputs: tuple = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=2)


class Textbook(Own):
    """P- = A P A' + Q, S = C P- C' + R, K = P- C' S^-1, x = x- + K (z - C x-), P = P- - K S K'."""

    @hg.filters.in_float64
    def init(self):
        return jnp.asarray(PLANT.initial_mean), jnp.asarray(PLANT.initial_covariance)

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        (x, P), A = state, PLANT.matrix
        return A @ x, A @ P @ A.T + PLANT.noise_covariance(u)

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        (x, P), C, R, there = state, SENSOR.matrix, SENSOR.noise.covariance, ~jnp.isnan(z)
        innovation = hg.filters.gaussian_innovation(z, C @ x, C @ P @ C.T + R)
        S = jnp.where(there[:, None] & there, innovation.covariance, jnp.eye(2))
        K = jnp.linalg.solve(S, jnp.where(there[:, None], C @ P, 0.0)).T
        return (x + K @ jnp.where(there, innovation.value, 0.0), P - K @ S @ K.T), innovation

    @hg.filters.estimates
    def estimate(self, state):
        return hg.model.Estimate(*state, self.claim)


class Ensemble(Own):
    """Members moved with noise, corrected by perturbed measurements with the sample's gain."""

    @hg.filters.in_float64
    def init(self):
        key, mine = jax.random.split(jax.random.PRNGKey(0))
        return jax.vmap(PLANT.sample_initial)(jax.random.split(mine, MEMBERS)), key

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        key, mine = jax.random.split(state[1])
        noise = jax.vmap(lambda one: PLANT.sample_noise(one, jnp.zeros(0)))(jax.random.split(mine, MEMBERS))
        return state[0] @ PLANT.matrix.T + noise, key

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        (x, key), there = state, ~jnp.isnan(z)
        y = x @ SENSOR.matrix.T
        drawn = y + jax.vmap(SENSOR.noise.sample)(jax.random.split(key, MEMBERS))
        dx, dy = x - x.mean(axis=0), jnp.where(there, y - y.mean(axis=0), 0.0)
        S = dy.T @ dy / (MEMBERS - 1) + SENSOR.noise.covariance
        K = jnp.linalg.solve(S, dy.T @ dx / (MEMBERS - 1)).T
        received = hg.filters.gaussian_innovation(z, y.mean(axis=0), S)
        return (x + jnp.where(there, z - drawn, 0.0) @ K.T, key), received

    @hg.filters.estimates
    def estimate(self, state):
        return hg.model.Estimate(state[0].mean(axis=0), jnp.cov(state[0].T), self.claim)


def measure() -> dict[str, Any]:
    """Nanoseconds of a step and run of the library's filter, the textbook's over it, and of a member."""
    z = np.random.default_rng(0).normal(size=(RUNS, STEPS, 2))
    z[np.random.default_rng(1).random(z.shape) < LOST] = np.nan
    runs = {name: means_of(f) for name, f in (("ours", hg.kalman_filter(PLANT, SENSOR)), ("textbook", Textbook()),
                                              ("ensemble", Ensemble()))}  # fmt: skip
    best = dict.fromkeys(runs, np.inf)
    means = {name: hg.simulation.over_runs(run, z) for name, run in runs.items()}  # compiles
    for name, run in runs.items():
        if not (engine := engine_of(run, z)).startswith("native"):
            raise SystemExit(f"{name}: expected a native program, got {engine}")
    if not np.allclose(means["ours"], means["textbook"], atol=1e-9):
        raise SystemExit("textbook: expected the library's means, got others")
    for _ in range(PASSES):
        for name, run in runs.items():
            begun = time.process_time()
            hg.simulation.over_runs(run, z)
            best[name] = min(best[name], (time.process_time() - begun) / (RUNS * STEPS) * 1e9)
    values = {
        "Kalman filter, ours (ns per step and run)": best["ours"],
        "Kalman filter of a textbook over ours": best["textbook"] / best["ours"],
        "ensemble filter (ns per member, step and run)": best["ensemble"] / MEMBERS,
    }
    return {"unit": "ns, and ratios", "values": values, "at_most": {"Kalman filter of a textbook over ours": 1.1}}


if __name__ == "__main__":
    for key, value in measure()["values"].items():
        print(f"{key:<56}{value:>10.2f}")
