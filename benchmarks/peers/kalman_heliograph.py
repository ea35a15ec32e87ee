"""Ours: the Kalman filter of a linear system, whose sensor has another known gain at each step and run."""

from typing import Any

import jax
from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    plant = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"])
    start = hg.extended_filter(plant, hg.LinearSensor(p["C"], p["R"]), hg.perfect(2)).init()

    def step(state: Any, item: Any) -> tuple[Any, Any]:
        gain, z = item
        sensor = hg.LinearSensor(gain[:, None] * p["C"], p["R"])
        state, estimate = hg.extended_filter(plant, sensor, hg.perfect(2)).step(state, z)
        return state, estimate.mean

    def one_run(gains: Any, z: Any) -> tuple[Any, Any]:
        last, means = jax.lax.scan(step, start, (gains, z))
        return means, last.covariance

    how = f"over_runs, all cores; {hg.engine.engine_of(one_run, p['gains'], p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(one_run, p["gains"], p["z"]), lambda result: result[0], how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
