"""pykalman: expectation-maximisation of x+ = .95 x + w, z = x + v.

Run: python learning_pykalman.py FILE.npz, which holds z (steps,) and point (2,); answers in JSON on standard output.
It starts at the first measurement, and creeps: after ITERATIONS it is still on its way, and its time a lower limit.
"""

import json
import sys
import time

import numpy as np
from pykalman import KalmanFilter

ITERATIONS = 10

if __name__ == "__main__":
    with np.load(sys.argv[1]) as data:
        z, (q, r) = data["z"][:, None], data["point"]
    item = KalmanFilter([[0.95]], [[1.0]], [[q]], [[r]], None, None, [0.0], [[0.95**2 + q]])
    began = time.process_time()
    item.em(z, n_iter=ITERATIONS, em_vars=["transition_covariance", "observation_covariance"])
    seconds = time.process_time() - began
    result = [float(item.transition_covariance[0, 0]), float(item.observation_covariance[0, 0])]
    print(json.dumps({"found": result, "top": float(item.loglikelihood(z)), "cpu_s": seconds}))
