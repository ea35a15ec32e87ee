"""Ours: the Kalman filter with another known gain at each step and run, and a sweep back over what it retained."""

from typing import Any

import jax
from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    plant = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"])
    start = hg.extended_filter(plant, hg.LinearSensor(p["C"], p["R"]), hg.perfect(2)).init()
    interval = hg.smoothing.FixedInterval()

    def step(state: Any, item: Any) -> tuple[Any, Any]:
        gain, z = item
        sensor = hg.LinearSensor(gain[:, None] * p["C"], p["R"])
        return hg.extended_filter(plant, sensor, hg.perfect(2)).step_with_smoother(state, z)

    def one_run(gains: Any, z: Any) -> tuple[Any, Any]:
        _, steps = jax.lax.scan(step, start, (gains, z))
        smoothed = interval.sweep(steps)
        return smoothed.mean, smoothed.covariance[0]

    how = f"over_runs, all cores; {hg.engine.engine_of(one_run, p['gains'], p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(one_run, p["gains"], p["z"]), lambda result: result[0], how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
