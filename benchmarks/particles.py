"""Particle filters of the state on one recording: nanoseconds of processors a particle and row, natively and by XLA.

Run: python benchmarks/particles.py, or within benchmarks/run.py. Two positions and speeds of which positions are
measured: four states, two outputs. Both engines take the same rows in turn, ROUNDS times, when warm; the least counts.
Means of 10,000 particles on must be within a tenth of a deviation of the Kalman filter's, on average over rows.
"""

import json
import os
import time
from typing import Any

import numpy as np

import heliograph as hg
from heliograph.engine.choice import SETTING
from heliograph.filters.rows.run_over_data import Filtered

ROWS, ROUNDS = 100, 5
PARTICLES = 1_000, 10_000, 100_000
FEW, APART = 10_000, 0.1
AT_MOST = {"10,000, prior, native": 40.0, "10,000, optimal, native": 50.0}


def recording() -> tuple[hg.LinearPlant, hg.LinearSensor, np.ndarray]:
    """Return plant, sensor and measured positions."""
    f = np.kron(np.eye(2), [[1.0, 0.1], [0.0, 0.98]])
    q, h = np.diag([0.01, 0.1, 0.01, 0.1]), np.eye(4)[[0, 2]]
    rng, x, rows = np.random.default_rng(0), np.zeros(4), []
    for _ in range(ROWS):
        x = f @ x + np.sqrt(np.diag(q)) * rng.normal(size=4)
        rows.append(h @ x + np.sqrt(0.5) * rng.normal(size=2))
    return hg.LinearPlant(f, q, np.zeros(4), np.eye(4)), hg.LinearSensor(h, 0.5 * np.eye(2)), np.array(rows)


def run_by(engine: str, filter: Any, z: np.ndarray) -> tuple[float, Filtered]:
    """Return the processor's nanoseconds a particle and row, and the results, of an engine ("": that of a user)."""
    os.environ[SETTING] = engine
    start = time.process_time()
    result = filter.run(z)
    return (time.process_time() - start) * 1e9 / len(z) / filter.particles, result


def measure() -> dict[str, Any]:
    """Measure both proposals, with each count of particles."""
    plant, sensor, z = recording()
    right = hg.kalman_filter(plant, sensor).run(z)
    deviation = np.sqrt(np.diagonal(right.covariances, axis1=1, axis2=2))
    values, before = dict[str, float](), os.environ.get(SETTING)
    for particles in PARTICLES:
        for proposal in ("prior", "optimal"):
            filter = hg.filters.particle_filter(plant, sensor, hg.perfect(2), particles, proposal=proposal)
            for _ in range(2):
                for engine in ("", "xla"):
                    run_by(engine, filter, z)
            time.sleep(1)  # code that is made with care, in the background
            rounds = [[run_by(engine, filter, z) for engine in ("", "xla")] for _ in range(ROUNDS)]
            for _, result in rounds[-1]:
                apart = float(np.mean(np.abs(result.means - right.means) / deviation))
                if particles >= FEW and apart > APART:
                    raise SystemExit(
                        f"particles: {proposal}, {particles}: {apart:.2g} deviations from the Kalman filter"
                    )
            for place, name in enumerate(("native", "XLA")):
                values[f"{particles:,}, {proposal}, {name}"] = round(min(one[place][0] for one in rounds), 1)
    os.environ.pop(SETTING) if before is None else os.environ.update({SETTING: before})
    return {"unit": "ns of processors a particle and row", "values": values, "at_most": AT_MOST}


if __name__ == "__main__":
    print(json.dumps(measure(), indent=1))
