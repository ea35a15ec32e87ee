"""kalman-py: `fit_noise`, with its default (BFGS on gradients through JAX), of x+ = .95 x + w, z = x + v.

Run: python learning_kalman_py.py FILE.npz, which holds z (steps,) and point (2,); answers in JSON on standard output.
The least of three calls; what it compiles anew at each is its own.
"""

import json
import sys
import time

import jax
import numpy as np
from kalman_py.learning import fit_noise

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    with np.load(sys.argv[1]) as data:
        z, (q, r) = data["z"][:, None], data["point"]
    seconds = float("inf")
    for _ in range(3):
        began = time.process_time()
        result = fit_noise([[0.95]], [[1.0]], z, [0.0], [[1.0]], Q0=[[q]], R0=[[r]])
        seconds = min(seconds, time.process_time() - began)
    answer = {"found": [float(result.Q[0, 0]), float(result.R[0, 0])], "top": result.log_likelihood, "cpu_s": seconds}
    print(json.dumps(answer))
