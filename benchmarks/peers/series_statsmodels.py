"""statsmodels: its compiled Kalman filter, smoother and likelihood on one recording."""

import numpy as np
from series import Arrays, Tasks, answer
from statsmodels.tsa.statespace.kalman_smoother import KalmanSmoother


def prepare(p: Arrays) -> Tasks:
    model = KalmanSmoother(k_endog=2, k_states=4, k_posdef=4)
    model["design"], model["transition"], model["selection"] = p["C"], p["A"], np.eye(4)
    model["state_cov"], model["obs_cov"] = p["Q"], p["R"]
    # Its first state is that of the first row.
    model.initialize_known(p["A"] @ p["mean"], p["A"] @ p["covariance"] @ p["A"].T + p["Q"])
    model.tolerance = 0.0  # its default stops the covariance early
    model.bind(p["z"].copy())
    return {
        "filter": lambda: model.filter().filtered_state.T,
        "smoother": lambda: model.smooth().smoothed_state.T,
        "likelihood": lambda: model.loglike(),
    }


if __name__ == "__main__":
    answer(prepare)
