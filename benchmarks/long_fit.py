"""Fit of two variances of one long recording (four states, two outputs) beside statsmodels, in processor seconds.

Run: python benchmarks/long_fit.py [ROWS], a million by default. The model is that of benchmarks/one_series.py; both
begin at the same point, wrong by a factor of five. The second call of ours counts, as the first compiles; statsmodels
stops its covariance early, as by default. Maximisers must agree to 1 %, and ours may take at most AT_MOST of its time.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from one_series import problem
from peers.environments import python_of

import heliograph as hg

AT_MOST, AGREE = 0.05, 0.01
SHAPE = np.diag([1e-2, 1e-2, 1.0, 1.0])  # of the plant's noise, whose size is free
PEER = Path(__file__).resolve().parent / "peers" / "series_fit_statsmodels.py"


def fit(p: dict[str, np.ndarray], starts: int) -> Any:
    """Fit both variances."""

    def build() -> hg.Network:
        plant = hg.LinearPlant(p["A"], hg.free(0.05, "q", "positive") * SHAPE, p["mean"], p["covariance"])
        sensor = hg.LinearSensor(p["C"], hg.free(0.05, "r", "positive") * np.eye(2))
        return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {})})

    return hg.fit(build, {"node": p["z"]}, starts=starts)


def measure(rows: int) -> dict[str, Any]:
    """Processor seconds of each, the estimates, and how far apart they are."""
    p = problem()
    p["z"] = p["z"][:rows]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "series.npz"
        np.savez(file, **p, shape=SHAPE)  # type: ignore[arg-type]  # arrays by name
        command = [python_of("statsmodels"), PEER, file]
        theirs = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    took = {}
    for starts in (1, 6):
        fit(p, starts)
        began = time.process_time()
        found = fit(p, starts)
        took[starts] = time.process_time() - began
    mine = [float(found.values[name]) for name in ("q", "r")]
    return {
        "rows": rows,
        "statsmodels, one start": theirs["cpu_s"],
        "heliograph, one start": took[1],
        "heliograph, six starts": took[6],
        "share of its time": took[1] / theirs["cpu_s"],
        "log-likelihood above its": found.log_likelihood - theirs["top"],
        "maximisers differ by": float(np.max(np.abs(np.divide(mine, theirs["found"]) - 1))),
    }


if __name__ == "__main__":
    results = measure(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
    print(json.dumps(results, indent=1))
    if not results["maximisers differ by"] < AGREE:
        raise SystemExit("long_fit: another maximum than statsmodels'")
    if not results["share of its time"] <= AT_MOST:
        raise SystemExit(f"long_fit: more than {AT_MOST} of statsmodels' time")
