"""kalman-py: its filter, smoother and log-likelihood by JAX on the first rows of one recording."""

import jax
import numpy as np
from kalman_py import KalmanFilter
from series import Arrays, Tasks, answer

ROWS = 10_000


def prepare(p: Arrays) -> Tasks:
    jax.config.update("jax_enable_x64", True)
    item = KalmanFilter(p["A"], p["C"], p["Q"], p["R"], p["mean"], p["covariance"])

    def smooth() -> np.ndarray:
        return np.asarray(item.smooth(item.filter(p["z"], "jax")).means)

    return {"filter": lambda: np.asarray(item.filter(p["z"], "jax").means), "smoother": smooth}


if __name__ == "__main__":
    answer(prepare, ROWS)
