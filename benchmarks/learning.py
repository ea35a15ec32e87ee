"""Learning two variances from 10,000 steps, beside others to the same maximum: seconds of processor time.

Run: python benchmarks/learning.py, or within benchmarks/run.py. Likelihoods at one point must agree with statsmodels'
to 1e-8 of their size, maximisers to 1e-6; kalman-py stops by its own rule, which must be no higher. Each is timed when
warm, the least of three calls, and with the maximum alone; ours also with the intervals and sentences that `hg.fit`
makes. pykalman creeps: its time is that of its first iterations, after which it is below the maximum still.
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
CALLS = 3
PEERS = {
    "statsmodels": "learning_statsmodels.py",
    "kalman-py": "learning_kalman_py.py",
    "pykalman": "learning_pykalman.py",
}
FOLDER = Path(__file__).resolve().parent / "peers"
SHARE = 0.1  # of a peer's time that ours may take, intervals included


def network(q: Any, r: Any) -> hg.Network:
    """x+ = .95 x + w, z = x + v."""
    plant = hg.LinearPlant([[0.95]], q, [0.0], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], r), hg.perfect(), {})})


def free() -> hg.Network:
    """The same with both variances free."""
    return network(hg.free(POINT[0], "q"), hg.free(POINT[1], "r"))


def theirs(z: np.ndarray) -> dict[str, dict[str, Any]]:
    """What each peer finds of those whose environment can be made."""
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "recording.npz"
        np.savez(file, z=z, point=POINT)
        for name, program in PEERS.items():
            try:
                python = python_of(name)
            except RuntimeError as error:
                print(error, file=sys.stderr)
                continue
            command = [python, FOLDER / program, file]
            said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
            results[name] = json.loads(said.splitlines()[-1])
    return results


def ours(z: np.ndarray) -> dict[str, Any]:
    """What a fit finds, timed when compiled: all of it, and without its intervals."""
    node = network(*POINT).nodes["node"]
    item = hg.linear_filter(network(*POINT).plant, node.sensor, node.channel)
    whole, alone = [], []
    for _ in range(1 + CALLS):
        began = time.process_time()
        fitted = hg.fit(free, z, starts=1)
        alone.append(time.process_time() - began)
        rows = fitted.rows()
        whole.append(time.process_time() - began)
    top, at_point = fitted.log_likelihoods["linear"], float(hg.log_likelihood(item, z))
    estimates = [row.estimate for row in rows]
    return {
        "at_point": at_point,
        "found": estimates,
        "top": top,
        "cpu_s": min(whole[1:]),
        "alone_cpu_s": min(alone[1:]),
    }


def check(mine: dict[str, Any], others: dict[str, dict[str, Any]]) -> None:
    """End where a likelihood or a maximum is not ours."""
    if "statsmodels" in others:
        other = others["statsmodels"]
        apart = max(abs(mine[name] / other[name] - 1) for name in ("at_point", "top"))
        off = float(np.max(np.abs(np.divide(mine["found"], other["found"]) - 1)))
        print(f"likelihoods agree to {apart:.1e}, maximisers to {off:.1e} of their size", file=sys.stderr)
        if apart > LIKELIHOOD or off > MAXIMISER:
            raise SystemExit("learning: another likelihood or maximum than statsmodels'")
    for name, other in others.items():
        if other["top"] > mine["top"] + LIKELIHOOD * abs(mine["top"]):
            raise SystemExit(f"learning: {name} found a higher likelihood, {other['top']}")


def measure() -> dict[str, Any]:
    """Seconds of each, ours over each, and how far below our maximum each stopped."""
    z = hg.monte_carlo(network(0.2, 0.3), STEPS, 1, 0).measurements["node"][0]
    mine, others = ours(z), theirs(z[:, 0])
    check(mine, others)
    values = {"heliograph": mine["cpu_s"], "heliograph, maximum alone": mine["alone_cpu_s"]}
    values |= {name: other["cpu_s"] for name, other in others.items()}
    shares = {f"ours over {name}": mine["cpu_s"] / other["cpu_s"] for name, other in others.items()}
    values |= shares | {f"nats below, {name}": mine["top"] - other["top"] for name, other in others.items()}
    return {"unit": "s of processor time, 10,000 steps", "values": values, "at_most": dict.fromkeys(shares, SHARE)}


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
