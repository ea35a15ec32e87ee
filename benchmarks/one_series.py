"""One long recording, beside others: nanoseconds a row of filters, smoothers and likelihoods of a million rows.

Run: python benchmarks/one_series.py [--without-peers], or within benchmarks/run.py. Positions and speeds in a plane, of
which positions are measured: four states, two outputs, complete rows. Each is timed when warm, the least of three
calls by the clock; slow peers take fewer rows. Means must agree to 1e-6, likelihoods to 1e-9 of their size. The
gradient is that of the log-likelihood in two variances, with its information, as a fit takes it.
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from peers.environments import python_of
from peers.series import least

import heliograph as hg
from heliograph.learning.likelihood.data import gather_data
from heliograph.learning.likelihood.evaluation import evaluate_at_points
from heliograph.learning.likelihood.objective import make_objectives
from heliograph.learning.parametric_network import describe

ROWS = 1_000_000
FEW = 30_000  # rows that are not divided into chunks
MEANS, LIKELIHOOD = 1e-6, 1e-9
PEERS = {
    "statsmodels": "series_statsmodels.py",
    "pykalman": "series_pykalman.py",
    "cuthbert": "series_cuthbert.py",
    "fast-kalman": "series_fast_kalman.py",
    "kalman-py": "series_kalman_py.py",
}
FOLDER = Path(__file__).resolve().parent / "peers"
AT_MOST = {
    "heliograph, filter": 25.0,
    "heliograph, filter, row by row": 70.0,
    "heliograph, smoother": 60.0,
    "heliograph, likelihood": 20.0,
    "heliograph, gradient": 80.0,
}


def problem() -> dict[str, np.ndarray]:
    """A plane's positions and speeds each tenth of a second, and ROWS of measured positions."""
    a, c = np.eye(4) + 0.1 * np.eye(4, k=2), np.eye(2, 4)
    q, r = np.diag([1e-4, 1e-4, 1e-2, 1e-2]), 0.25 * np.eye(2)
    rng, x = np.random.default_rng(0), np.zeros(4)
    w, v = rng.normal(size=(ROWS, 4)) @ np.sqrt(q), rng.normal(size=(ROWS, 2)) @ np.sqrt(r)
    z = np.empty((ROWS, 2))
    for k in range(ROWS):
        x = a @ x + w[k]
        z[k] = x[:2] + v[k]
    return {"A": a, "C": c, "Q": q, "R": r, "mean": np.zeros(4), "covariance": np.eye(4), "z": z}


def score(p: dict[str, np.ndarray]) -> Callable[[], np.ndarray]:
    """Return what computes the gradient of the log-likelihood in the sizes of the noise of plant and sensor, at 1."""

    def build() -> hg.Network:
        plant = hg.LinearPlant(p["A"], hg.free(1.0, "q", "positive") * p["Q"], p["mean"], p["covariance"])
        sensor = hg.LinearSensor(p["C"], hg.free(1.0, "r", "positive") * p["R"])
        return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {})})

    described = describe(build)
    data = gather_data(described.start, {"node": p["z"]}, None, described.parameters.size)
    objective, start = make_objectives(described)[0], described.parameters.start[None]
    return lambda: evaluate_at_points(objective, start, data).gradient


def ours(p: dict[str, np.ndarray]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Nanoseconds a row of each task, and its means or likelihood."""
    plant, sensor = hg.LinearPlant(p["A"], p["Q"], p["mean"], p["covariance"]), hg.LinearSensor(p["C"], p["R"])
    item, z = hg.kalman_filter(plant, sensor), p["z"]
    network = hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {"Kalman": item})})
    tasks = {
        "filter": lambda: item.run(z).means,
        "smoother": lambda: hg.rts_smoother(item, z).means,
        "likelihood": lambda: hg.log_likelihood(item, z),
        "hg.run": lambda: hg.run(network, {"node": z}).estimates["node"]["Kalman"].mean,
    }
    times = {name: least(task, len(z), 9) for name, task in (tasks | {"gradient": score(p)}).items()}
    times["filter, row by row"] = least(lambda: item.run(z[:FEW]), FEW, 9)
    return times, {name: np.asarray(task()) for name, task in tasks.items()}


def theirs(name: str, p: dict[str, np.ndarray]) -> tuple[dict[str, Any], dict[str, np.ndarray]] | None:
    """The same of a peer, whose environment may not be made."""
    with tempfile.TemporaryDirectory() as folder:
        data, means = Path(folder) / "problem.npz", Path(folder) / "means.npz"
        np.savez(data, **p)  # type: ignore[arg-type]  # arrays by name
        try:
            python = python_of(name)
        except RuntimeError as error:
            print(error, file=sys.stderr)
            return None
        command = [python, FOLDER / PEERS[name], data, means]
        said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        with np.load(means) as file:
            return json.loads(said.splitlines()[-1])["ns"], dict(file)


def check(name: str, mine: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> None:
    """End where a peer's means or likelihood are not ours; filters alone have our means of the first rows."""
    for task, values in other.items():
        expected = mine[task.split(",")[0]]
        if values.ndim:  # of the first rows, or of the last one alone
            expected = expected[-1:] if len(values) == 1 else expected[: len(values)]
        if task == "smoother" and len(values) < ROWS:
            expected, values = expected[: len(values) // 2], values[: len(values) // 2]  # its end is not ours
        apart = float(np.max(np.abs(values - expected))) / (1.0 if values.ndim else float(np.abs(expected)))
        if not apart <= (MEANS if values.ndim else LIKELIHOOD):
            raise SystemExit(f"one series: {name}, {task}: {apart:.1e} from ours")


def measure(with_peers: bool = True) -> dict[str, Any]:
    """Nanoseconds a row of each, by the clock; those of processors behind the name."""
    p = problem()
    times, means = ours(p)
    results = {"heliograph": times}
    for name in PEERS if with_peers else ():
        answered = theirs(name, p)
        if answered is not None:
            results[name] = answered[0]
            check(name, means, answered[1])
    values = {f"{who}, {task}": round(ns[0], 1) for who, tasks in results.items() for task, ns in tasks.items()}
    values |= {
        f"{who}, {task}, of processors": round(ns[1], 1) for who, tasks in results.items() for task, ns in tasks.items()
    }
    return {"unit": "ns a row of one recording", "values": values, "at_most": AT_MOST}


if __name__ == "__main__":
    print(json.dumps(measure("--without-peers" not in sys.argv), indent=1))
