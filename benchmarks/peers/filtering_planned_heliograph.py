"""Ours, where matrices are the same in every run: covariances and gains before any data, means alone for each run."""

from typing import Any

import jax
import numpy as np
from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    plant, steps = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"]), p["z"].shape[1]
    planned = hg.kalman_filter(plant, hg.LinearSensor(p["C"], p["R"])).planned(np.zeros((steps, 0)))

    def step(carry: Any, z: Any) -> tuple[Any, Any]:
        state, k = carry
        state, estimate = planned.step(state, z, (), k)
        return (state, k + 1), estimate.mean

    def one_run(z: Any) -> Any:
        return jax.lax.scan(step, (planned.init(), 0), z)[1]

    how = f"over_runs, all cores; {hg.engine.engine_of(one_run, p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(one_run, p["z"]), lambda result: result, how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
