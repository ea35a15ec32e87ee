"""pykalman: its Rauch-Tung-Striebel smoother, run after run."""

from typing import Any

import numpy as np
from pykalman import KalmanFilter
from timed import Arrays, Contender, serve

RUNS = 20


def prepare(p: Arrays) -> Contender:
    mean, covariance = p["A"] @ p["mean"], p["A"] @ p["covariance"] @ p["A"].T + p["Q"]  # of its first state

    def one_run(gains: Any, z: Any) -> Any:
        received = gains[:, :, None] * p["C"]
        return KalmanFilter(p["A"], received, p["Q"], p["R"], None, None, mean, covariance).smooth(z)[0]

    def work() -> list[Any]:
        return [one_run(*item) for item in zip(p["gains"][:RUNS], p["z"][:RUNS], strict=True)]

    return Contender(work, lambda result: np.array(result), "a loop")


if __name__ == "__main__":
    serve(prepare, ("pykalman", "numpy"))
