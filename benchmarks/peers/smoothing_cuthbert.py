"""cuthbert: its sequential square-root Kalman filter and smoother, vectorised over the runs."""

from typing import Any

import jax
import numpy as np
from batches import vectorised
from cuthbert import filter as run_filter
from cuthbert import smoother as run_smoother
from cuthbert.gaussian import kalman
from timed import Arrays, Contender, serve

RUNS = 2_000  # of the problem's: as many again would take as long for each


def prepare(p: Arrays, parallel: bool = False, runs: int = RUNS) -> Contender:
    root = {name: np.linalg.cholesky(p[name]) for name in ("Q", "R", "covariance")}
    none, zero = np.zeros(2), np.zeros(4)

    def move(_: Any) -> tuple[Any, Any, Any]:
        return jax.numpy.asarray(p["A"]), jax.numpy.asarray(zero), jax.numpy.asarray(root["Q"])

    def receive(i: Any) -> tuple[Any, Any, Any, Any]:
        return i[0][:, None] * p["C"], jax.numpy.asarray(none), jax.numpy.asarray(root["R"]), i[1]

    forward = kalman.build_filter(p["mean"], root["covariance"], move, receive)
    backward = kalman.build_smoother(move)

    def one_run(gains: Any, z: Any) -> tuple[Any, Any]:
        states = run_filter(forward, (gains, z), forward.init_prepare(), parallel=parallel)
        smoothed = run_smoother(backward, states, parallel=parallel)
        return smoothed.mean[1:], smoothed.chol_cov[1]

    return vectorised(one_run, [p["gains"][:runs], p["z"][:runs]])


if __name__ == "__main__":
    serve(prepare, ("cuthbert", "jax", "numpy"))
