"""Learning two variances from 10,000 steps, beside statsmodels: likelihoods, maximisers, seconds of processor time.

Run: python benchmarks/learning.py. Likelihoods at one point must agree to 1e-8 of their size, maximisers to 1e-6. Ours
is timed once compiled, with the intervals and sentences that `hg.fit` makes; theirs with the maximum alone.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from peers.environments import python_of

import heliograph as hg

STEPS = 10_000
POINT = np.array([0.5, 0.5])
LIKELIHOOD, MAXIMISER = 1e-8, 1e-6
PEER = Path(__file__).resolve().parent / "peers" / "learning_statsmodels.py"


def network(q: Any, r: Any) -> hg.Network:
    """x+ = .95 x + w, z = x + v."""
    plant = hg.LinearPlant([[0.95]], q, [0.0], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], r), hg.perfect(), {})})


def free() -> hg.Network:
    """The same with both variances free."""
    return network(hg.free(POINT[0], "q"), hg.free(POINT[1], "r"))


def theirs(z: np.ndarray) -> dict[str, Any]:
    """What statsmodels finds."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recording.npz"
        np.savez(file, z=z, point=POINT)
        said = subprocess.run([python_of("statsmodels"), PEER, file], check=True, capture_output=True, text=True)
    found: dict[str, Any] = json.loads(said.stdout)
    return found


def ours(z: np.ndarray) -> dict[str, Any]:
    """What a fit finds, timed at its second call."""
    node = network(*POINT).nodes["node"]
    item = hg.linear_filter(network(*POINT).plant, node.sensor, node.channel)
    for _ in range(2):
        began = time.process_time()
        found = hg.fit(free, z, starts=1)
        rows = found.rows()
        seconds = time.process_time() - began
    top = found.log_likelihood["linear"]
    at_point = float(hg.log_likelihood(item, z))
    return {"at_point": at_point, "found": [row.estimate for row in rows], "top": top, "cpu_s": seconds}


def main() -> None:
    """Compare, and say it."""
    z = hg.monte_carlo(network(0.2, 0.3), STEPS, 1, 0).measurements["node"][0]
    mine, other = ours(z), theirs(z[:, 0])
    print(json.dumps({"heliograph": mine, "statsmodels": other}, indent=1))
    apart = abs(mine["at_point"] / other["at_point"] - 1), abs(mine["top"] / other["top"] - 1)
    off = float(np.max(np.abs(np.divide(mine["found"], other["found"]) - 1)))
    print(f"likelihoods agree to {max(apart):.1e}, maximisers to {off:.1e} of their size")
    if max(apart) > LIKELIHOOD or off > MAXIMISER:
        sys.exit("they do not agree")


if __name__ == "__main__":
    main()
