"""Ours: the interacting multiple model filter behind a link whose gain moves as a Markov chain."""

from typing import Any

import jax
from timed import Arrays, Contender, serve

import heliograph as hg


def prepare(p: Arrays) -> Contender:
    plant = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"])
    chain = hg.random_affine.MarkovChain(
        p["chain"], initial=p["law"] @ p["chain"]
    )  # the peer's law is that before the first step
    link = hg.markov_fading(p["gains"], chain, noise=p["R"])
    imm = hg.filters.imm_filter(plant, hg.LinearSensor(p["C"], 0.0 * p["R"]), link)
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
