"""Cost of knowing what silence says: the event filter beside a Kalman filter that skips it, and beside particles.

Run: python benchmarks/event_triggered.py. Each filters the same measurements of RUNS runs, in turn, and the least time
of each counts. Particles of (x, reference) are stepped by NumPy for all runs side by side, as many as have the error of
the sum of three and two Gaussians to 1 %.
"""

import time
from typing import Any

import numpy as np
from links_with_memory import means_of
from scipy.special import ndtr, ndtri

import heliograph as hg

RUNS, STEPS, REPEATS = 1000, 100, 5
A, Q, R, DELTA, LOSS = 0.98, 0.04, 0.01, 0.6, 0.2
COUNTS = (10, 20, 50, 100, 200, 500)  # of particles
AS_GOOD = 1.01


def particles(z: np.ndarray, count: int) -> np.ndarray:
    """Means after each step, (run, step), of a bootstrap filter."""
    random, runs = np.random.default_rng(1), len(z)
    x, reference, results = random.normal(size=(runs, count)), np.zeros((runs, count)), []
    for k, value in enumerate(z.T[..., None]):
        x = A * x + np.sqrt(Q) * random.normal(size=x.shape)
        came, deviation = ~np.isnan(value), np.sqrt(R)
        low, high = ndtr((reference - DELTA - x) / deviation), ndtr((x - reference - DELTA) / deviation)
        event = np.ones_like(x) if k == 0 else low + high
        quiet, gone = 1 - event, LOSS * event
        y = np.where(came, value, 0.0)
        sent = 1.0 if k == 0 else np.abs(y - reference) > DELTA * (1 - 1e-9)
        arrived = np.exp(-((y - x) ** 2) / (2 * R)) * sent + 1e-300
        weight = np.where(came, arrived, quiet + gone + 1e-300)
        weight /= weight.sum(axis=1, keepdims=True)
        share = random.random(x.shape)
        place = share * event
        place = np.where(place < low, place, 1 - (place - low)) if k else share
        lost = ~came & (random.random(x.shape) * (quiet + gone) > quiet)
        drawn = x + deviation * ndtri(np.clip(place, 1e-300, 1 - 1e-16))
        reference = np.where(came, y, np.where(lost, drawn, reference))
        results.append((weight * x).sum(axis=1))
        points = (random.random((runs, 1)) + np.arange(count)) / count
        chosen = np.minimum((np.cumsum(weight, axis=1)[:, None] < points[..., None]).sum(axis=-1), count - 1)
        x, reference = (np.take_along_axis(part, chosen, axis=1) for part in (x, reference))
    return np.array(results).T


def measure() -> dict[str, Any]:
    """Nanoseconds of a step and run of each, their ratios to the Kalman filter, and the particles that are as good."""
    plant, sensor = hg.LinearPlant([[A]], Q, [0.0], 1.0), hg.LinearSensor([[1.0]], R)
    link, rule = hg.erasure(hg.perfect(), 1 - LOSS), hg.SendOnDelta(DELTA)
    items = {
        "silence skipped": hg.kalman_filter(plant, sensor),
        "one and one": hg.event_filter(plant, sensor, link, rule, known=1, lost=1),
        "three and two": hg.event_filter(plant, sensor, link, rule),
    }
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, link, {}, trigger=rule)}), STEPS, RUNS, 0)
    z, truth = record.measurements["a"], record.truth
    runs, best, error = {name: means_of(item) for name, item in items.items()}, {}, {}
    for name, run in runs.items():
        error[name] = float(np.sqrt(np.mean((hg.simulation.over_runs(run, z)[..., 0] - truth[..., 0]) ** 2)))
        best[name] = np.inf
    for _ in range(REPEATS):
        for name, run in runs.items():
            begun = time.perf_counter()
            hg.simulation.over_runs(run, z)
            best[name] = min(best[name], time.perf_counter() - begun)
    for count in COUNTS:
        begun = time.perf_counter()
        means = particles(z[..., 0], count)
        best["particles"] = time.perf_counter() - begun
        error["particles"] = float(np.sqrt(np.mean((means - truth[..., 0]) ** 2)))
        if error["particles"] < AS_GOOD * error["three and two"]:
            break
    values = {f"{name} (ns per step and run)": 1e9 * seconds / (RUNS * STEPS) for name, seconds in best.items()}
    values |= {f"{name} (error)": item for name, item in error.items()}
    values |= {
        f"{name} over skipping": best[name] / best["silence skipped"] for name in ("one and one", "three and two")
    }
    values["particles as good"] = count
    return {"unit": "ns, and ratios", "values": values, "at_most": {}}


if __name__ == "__main__":
    for key, value in measure()["values"].items():
        print(f"{key:<42}{value:>12.4g}")
