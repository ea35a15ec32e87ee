"""Fit of a trend with a season (thirteen states, 400 rows, four variances) beside statsmodels, in processor seconds.

Run: python benchmarks/seasonal_fit.py. The second call counts, as the first compiles. statsmodels searches from one
start; ours from one, and from the six of the default. Maximisers must agree to 1 %: the two begin from wide laws that
differ, and statsmodels stops at its own tolerance. Ends with an error where either of ours takes longer.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from peers.environments import python_of

import heliograph as hg

STEPS, CALLS, AGREE = 400, 4, 0.01
PEER = Path(__file__).resolve().parent / "peers" / "seasonal_statsmodels.py"


def draw(seed: int) -> np.ndarray:
    """A level whose slope wanders, with a season of twelve and noise."""
    rng = np.random.default_rng(seed)
    level, slope, season, z = 315.0, 0.1, list(rng.normal(0, 2, 11)), np.zeros(STEPS)
    for k in range(STEPS):
        level, slope = level + slope + 0.3 * rng.normal(), slope + 0.02 * rng.normal()
        season = [-sum(season) + 0.1 * rng.normal(), *season[:10]]
        z[k] = level + season[0] + 0.5 * rng.normal()
    return z


def build() -> hg.Network:
    """The model, with its four variances free."""
    free = {name: hg.free(0.1, name, "positive") for name in ("level", "slope", "season", "noise")}
    trend = hg.models.trend(free["level"], free["slope"], [315.0, 0.0], initial_variance=1e6)
    season = hg.models.seasonal(12, free["season"], initial_variance=1e6)
    model = hg.models.structural([trend, season], free["noise"], "y")
    filters = {"kalman": hg.kalman_filter(model.plant, model.sensor)}
    return hg.Network(model.plant, {"a": hg.Node(model.sensor, hg.perfect(1), filters)})


def fit(z: np.ndarray, starts: int) -> Any:
    """Fit the series."""
    return hg.fit(build, {"a": z[:, None]}, starts=starts)


def seconds_of(call: Callable[[], Any]) -> float:
    """The least processor time of some calls, after one that compiles."""
    call()
    took = []
    for _ in range(CALLS):
        began = time.process_time()
        call()
        took.append(time.process_time() - began)
    return min(took)


def measure(seed: int = 0) -> dict[str, Any]:
    """Seconds of each, and by how much the maximisers differ."""
    z = draw(seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "series.npz"
        np.savez(file, z=z)
        command = [python_of("statsmodels"), PEER, file]
        theirs = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    mine = [row.estimate for row in fit(z, 1).rows()]
    return {
        "statsmodels, one start": theirs["cpu_s"],
        "heliograph, one start": seconds_of(lambda: fit(z, 1)),
        "heliograph, six starts": seconds_of(lambda: fit(z, 6)),
        "heliograph, intervals by profile": seconds_of(lambda: fit(z, 1).rows("profile")),
        "maximisers differ by": float(np.max(np.abs(np.divide(mine, theirs["found"]) - 1))),
    }


if __name__ == "__main__":
    results = measure(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
    print(json.dumps(results, indent=1))
    if results["maximisers differ by"] > AGREE:
        raise SystemExit("seasonal_fit: another maximum than statsmodels'")
    if max(results["heliograph, one start"], results["heliograph, six starts"]) > results["statsmodels, one start"]:
        raise SystemExit("seasonal_fit: longer than statsmodels")
