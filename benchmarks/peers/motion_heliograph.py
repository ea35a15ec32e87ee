"""Ours: the interacting multiple model filter of a plant with two laws of motion."""

from typing import Any

import jax
from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    laws = [hg.LinearPlant(a, q, p["mean"], p["covariance"]) for a, q in zip(p["laws"], p["noises"], strict=True)]
    chain = hg.random_affine.MarkovChain(p["chain"], initial=p["law"] @ p["chain"])
    sensor = hg.LinearSensor(p["C"], p["R"])
    imm = hg.filters.imm_filter(hg.markov_plant(laws, chain), sensor, hg.perfect(len(p["C"])))
    start = imm.init()

    def step(state: Any, z: Any) -> tuple[Any, Any]:
        state, estimate = imm.step(state, z)
        return state, estimate.mean

    def one_run(z: Any) -> tuple[Any, Any]:
        last, means = jax.lax.scan(step, start, z)
        return means, last.gaussian.covariance

    how = f"over_runs, all cores; {hg.engine.engine_of(one_run, p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(one_run, p["z"]), lambda result: result[0], how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
