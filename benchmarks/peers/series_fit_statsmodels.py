"""statsmodels: fit of two variances of one recording, and its likelihood there.

Run: python series_fit_statsmodels.py problem.npz, of benchmarks/one_series.py; answers in JSON on standard output.
"""

import json
import sys
import time

import numpy as np
from statsmodels.tsa.statespace.mlemodel import MLEModel


class Recording(MLEModel):
    """Positions and speeds, driven by a noise of a given shape, of which positions are measured."""

    start_params = np.array([0.05, 0.05])
    param_names = ("q", "r")

    def __init__(self, p):
        super().__init__(p["z"], k_states=4)
        self.problem = p
        self["design"], self["transition"], self["selection"] = p["C"], p["A"], np.eye(4)
        self.initialize_known(np.zeros(4), np.eye(4))

    def transform_params(self, unconstrained):
        return np.exp(unconstrained)

    def untransform_params(self, constrained):
        return np.log(constrained)

    def update(self, params, **options):
        q, r = super().update(params, **options)
        p = self.problem
        self["state_cov"], self["obs_cov"] = q * p["shape"], r * np.eye(2)
        self.ssm.initialize_known(p["A"] @ p["mean"], p["A"] @ p["covariance"] @ p["A"].T + q * p["shape"])


if __name__ == "__main__":
    with np.load(sys.argv[1]) as file:
        model = Recording(dict(file))
    began = time.process_time()
    result = model.fit(disp=0, cov_type="none")
    seconds = time.process_time() - began
    print(json.dumps({"found": list(result.params), "top": float(result.llf), "cpu_s": seconds}))
