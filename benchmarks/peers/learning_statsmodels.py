"""statsmodels: likelihood at a point, and maximiser, of x+ = .95 x + w, z = x + v with free variances q and r.

Run: python learning_statsmodels.py FILE.npz, which holds z (steps,) and point (2,); answers in JSON on standard output.
"""

import json
import sys
import time

import numpy as np
from statsmodels.tsa.statespace.mlemodel import MLEModel


class Recording(MLEModel):
    """The plant starts a step before the first measurement, with mean 0 and variance 1."""

    start_params = np.array([0.5, 0.5])
    param_names = ("q", "r")

    def __init__(self, z):
        super().__init__(z, k_states=1)
        self["design", 0, 0], self["transition", 0, 0], self["selection", 0, 0] = 1.0, 0.95, 1.0
        self.initialize_known(np.zeros(1), np.eye(1))
        self.ssm.tolerance = 0.0  # its default stops the covariance early, which costs 3e-7 in the likelihood

    def transform_params(self, unconstrained):
        return np.exp(unconstrained)

    def untransform_params(self, constrained):
        return np.log(constrained)

    def update(self, params, **options):
        q, r = super().update(params, **options)
        self["state_cov", 0, 0], self["obs_cov", 0, 0] = q, r
        self.ssm.initialize_known(np.zeros(1), np.array([[0.95**2 + q]]))


if __name__ == "__main__":
    with np.load(sys.argv[1]) as data:
        model, point = Recording(data["z"]), data["point"]
    at_point = float(model.loglike(point))
    seconds = float("inf")
    for _ in range(3):
        began = time.process_time()
        result = model.fit(disp=0, method="bfgs", gtol=1e-9, maxiter=500)
        seconds = min(seconds, time.process_time() - began)
    print(json.dumps({"at_point": at_point, "found": list(result.params), "top": float(result.llf), "cpu_s": seconds}))
