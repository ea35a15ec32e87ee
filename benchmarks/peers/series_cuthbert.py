"""cuthbert: its square-root Kalman filter, sequential and parallel in time, on the first rows of one recording."""

from typing import Any

import jax
import numpy as np
from cuthbert import filter as run_filter
from cuthbert.gaussian import kalman
from series import Arrays, Tasks, answer

ROWS = 10_000


def prepare(p: Arrays) -> Tasks:
    jax.config.update("jax_enable_x64", True)
    root = {name: jax.numpy.asarray(np.linalg.cholesky(p[name])) for name in ("Q", "R", "covariance")}
    a, c, zero, none = (jax.numpy.asarray(x) for x in (p["A"], p["C"], np.zeros(4), np.zeros(2)))
    mean = jax.numpy.asarray(p["mean"])
    built = kalman.build_filter(
        mean, root["covariance"], lambda _: (a, zero, root["Q"]), lambda z: (c, none, root["R"], z)
    )

    def task(parallel: bool) -> Any:
        run = jax.jit(lambda z: run_filter(built, z, built.init_prepare(), parallel=parallel).mean[1:])
        return lambda: np.asarray(run(p["z"]))

    return {"filter": task(False), "filter, parallel in time": task(True)}


if __name__ == "__main__":
    answer(prepare, ROWS)
