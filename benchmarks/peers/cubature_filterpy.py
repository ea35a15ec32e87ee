"""FilterPy's cubature filter, made to compute what ours does: given the relays' moments, its points drawn anew.

FilterPy has no channel. Its user can put the mean gain into hx, give each update the covariance that the random gain
adds, and draw the points of the measurement from the prediction as ours does (FilterPy's own update reuses the moved
points, which lack the process noise). On the first runs; its time of a step does not depend on how many there are.
"""

import numpy as np
from filterpy.kalman import CubatureKalmanFilter
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from problems import transition
from timed import Arrays, Contender, serve

RUNS = 10


def new_filter(p: Arrays) -> CubatureKalmanFilter:
    """Moves by the machine's Euler step, measures by the mean gain."""
    mean_gain = p["gain"] * p["C"]
    ckf = CubatureKalmanFilter(5, 2, 1.0, hx=lambda x: mean_gain @ x, fx=lambda x, _: transition(x.tolist()))
    ckf.x, ckf.P, ckf.Q = p["mean"].copy(), p["covariance"].copy(), p["Q"]
    return ckf


def informed_run(p: Arrays, run: int) -> np.ndarray:
    ckf, c = new_filter(p), p["C"]
    fixed = p["gain"] ** 2 * p["R"] + p["noise"]
    means = np.empty((p["z"].shape[1], 5))
    for k, z in enumerate(p["z"][run]):
        ckf.predict()
        ckf.sigmas_f = spherical_radial_sigmas(ckf.x, ckf.P)
        y = c @ ckf.x
        second = c @ ckf.P @ c.T + p["R"] + y @ y.T
        ckf.update(z[:, None], R=p["gain_variance"] * second + fixed)
        means[k] = ckf.x[:, 0]
    return means


def prepare(p: Arrays) -> Contender:
    return Contender(lambda: [informed_run(p, i) for i in range(RUNS)], np.array, f"a loop over {RUNS} runs")


if __name__ == "__main__":
    serve(prepare, ("filterpy", "numpy"))
