"""FilterPy: a loop over runs and steps, on the first runs; its time of a step does not depend on how many there are."""

import numpy as np
from filterpy.kalman import KalmanFilter
from timed import Arrays, Contender, serve

RUNS = 20


def one_run(p: Arrays, run: int) -> np.ndarray:
    kf = KalmanFilter(dim_x=4, dim_z=2)
    kf.F, kf.Q, kf.R = p["A"], p["Q"], p["R"]
    kf.x, kf.P = p["mean"], p["covariance"]
    means = np.empty((p["z"].shape[1], 4))
    for k, (gain, z) in enumerate(zip(p["gains"][run], p["z"][run], strict=True)):
        kf.predict()
        kf.update(z, H=gain[:, None] * p["C"])
        means[k] = kf.x
    return means


def prepare(p: Arrays) -> Contender:
    return Contender(lambda: [one_run(p, i) for i in range(RUNS)], np.array, f"a loop over {RUNS} runs")


if __name__ == "__main__":
    serve(prepare, ("filterpy", "numpy"))
