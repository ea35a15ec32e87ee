"""cuthbert: its sequential square-root Kalman filter, vectorised over the runs."""

from typing import Any

import jax
import numpy as np
from batches import vectorised
from cuthbert import filter as run_filter
from cuthbert.gaussian import kalman
from timed import Arrays, Contender, serve


def prepare(p: Arrays) -> Contender:
    root = {name: np.linalg.cholesky(p[name]) for name in ("Q", "R", "covariance")}
    none, zero = np.zeros(2), np.zeros(4)
    built = kalman.build_filter(
        p["mean"],
        root["covariance"],
        lambda _: (jax.numpy.asarray(p["A"]), jax.numpy.asarray(zero), jax.numpy.asarray(root["Q"])),
        lambda i: (i[0][:, None] * p["C"], jax.numpy.asarray(none), jax.numpy.asarray(root["R"]), i[1]),
    )

    def one_run(gains: Any, z: Any) -> tuple[Any, Any]:
        states = run_filter(built, (gains, z), built.init_prepare())
        return states.mean[1:], states.chol_cov[-1]

    return vectorised(one_run, [p["gains"], p["z"]])


if __name__ == "__main__":
    serve(prepare, ("cuthbert", "jax", "numpy"))
