"""FilterPy's cubature filter as it comes: the mean gain for the truth, a constant noise. Less work, worse estimates."""

import numpy as np
from cubature_filterpy import RUNS, new_filter
from timed import Arrays, Contender, serve


def one_run(p: Arrays, run: int) -> np.ndarray:
    ckf = new_filter(p)
    ckf.R = p["gain"] ** 2 * p["R"] + p["noise"]
    means = np.empty((p["z"].shape[1], 5))
    for k, z in enumerate(p["z"][run]):
        ckf.predict()
        ckf.update(z[:, None])
        means[k] = ckf.x[:, 0]
    return means


def prepare(p: Arrays) -> Contender:
    return Contender(lambda: [one_run(p, i) for i in range(RUNS)], np.array, f"a loop over {RUNS} runs")


if __name__ == "__main__":
    serve(prepare, ("filterpy", "numpy"))
