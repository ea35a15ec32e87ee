"""Ours, where gains are the same in every run: all matrices before any data, vectors alone for each run."""

from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    plant = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"])
    sensor = hg.LinearSensor(p["C"], p["R"])
    planned = hg.smoothing.planned_smoother(
        hg.kalman_filter(plant, sensor), p["z"].shape[1], hg.smoothing.FixedInterval()
    )
    how = f"over_runs, all cores; {hg.engine.engine_of(planned.means, p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(planned.means, p["z"]), lambda result: result, how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
