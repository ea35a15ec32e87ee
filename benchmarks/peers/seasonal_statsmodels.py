"""statsmodels: fit of a trend with a season of twelve, thirteen states and four free variances.

Run: python seasonal_statsmodels.py FILE.npz, which holds z (steps,); answers in JSON on standard output.
"""

import json
import sys
import time

import numpy as np
from statsmodels.tsa.statespace.structural import UnobservedComponents

ORDER = ("sigma2.level", "sigma2.trend", "sigma2.seasonal", "sigma2.irregular")

if __name__ == "__main__":
    with np.load(sys.argv[1]) as data:
        model = UnobservedComponents(data["z"], level="local linear trend", seasonal=12)
    seconds = float("inf")
    for _ in range(4):
        began = time.process_time()
        result = model.fit(disp=0)
        seconds = min(seconds, time.process_time() - began)
    found = dict(zip(model.param_names, result.params.tolist(), strict=True))
    print(json.dumps({"found": [found[name] for name in ORDER], "cpu_s": seconds}))
