"""FilterPy's interacting multiple models of two laws of motion: a loop over runs and steps, on the first runs."""

import numpy as np
from filterpy.kalman import IMMEstimator, KalmanFilter
from timed import Arrays, Contender, serve

RUNS = 10


def one_run(p: Arrays, run: int) -> np.ndarray:
    filters = []
    for law, noise in zip(p["laws"], p["noises"], strict=True):
        kf = KalmanFilter(dim_x=4, dim_z=2)
        kf.F, kf.Q, kf.R, kf.H = law, noise, p["R"], p["C"]
        kf.x, kf.P = p["mean"], p["covariance"]
        filters.append(kf)
    imm = IMMEstimator(filters, p["law"], p["chain"])
    means = np.empty((p["z"].shape[1], 4))
    for k, z in enumerate(p["z"][run]):
        imm.predict()
        imm.update(z)
        means[k] = imm.x
    return means


def prepare(p: Arrays) -> Contender:
    return Contender(lambda: [one_run(p, i) for i in range(RUNS)], np.array, f"a loop over {RUNS} runs")


if __name__ == "__main__":
    serve(prepare, ("filterpy", "numpy"))
