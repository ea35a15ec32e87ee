"""Ours: the cubature filter that knows its relays' second moments, in the publication's strong scenario, laws known."""

from dataclasses import replace
from typing import Any

import jax
from problems import RELAY_GAINS, SENSOR_GAINS
from timed import Arrays, Contender, serve

import heliograph as hg
from heliograph_studies.cubature_fusion.setting import STRONG, cubature


def prepare(p: Arrays) -> Contender:
    known = replace(STRONG, sensor_gain=hg.Discrete(*SENSOR_GAINS), relay_gain=hg.Discrete(*RELAY_GAINS))
    ckf = cubature(known, 0, hg.filters.Polytope())
    start = ckf.init()

    def step(state: Any, z: Any) -> tuple[Any, Any]:
        state, estimate = ckf.step(state, z)
        return state, estimate.mean

    def one_run(z: Any) -> tuple[Any, Any]:
        last, means = jax.lax.scan(step, start, z)
        return means, last.covariance

    how = f"over_runs, all cores; {hg.engine.engine_of(one_run, p['z'])}"
    return Contender(lambda: hg.simulation.over_runs(one_run, p["z"]), lambda result: result[0], how)


if __name__ == "__main__":
    serve(prepare, ("heliograph", "jax", "numpy"))
