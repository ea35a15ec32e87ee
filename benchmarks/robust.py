"""Cost of doubting outliers: the robust and adaptive filters beside the filter of the same model without outliers.

Run: python benchmarks/robust.py. Constant velocity in the plane, the place seen, and the same with the distances to
four anchors. Each filters the same measurements of RUNS runs, in turn, natively, and the median over passes of its time
over the plain filter's in the same pass counts. Every gain depends on what arrived in its run, so that none is planned.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from links_with_memory import STEPS, means_of

import heliograph as hg
from heliograph.engine.choice import engine_of

RUNS, PASSES = 2000, 15
ANCHORS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0], [10.0, 10.0]])
PLAIN = "plain"
RULES = {
    "gate": hg.filters.Gate(),
    "Huber": hg.filters.Huber(),
    "inverse multiquadric": hg.filters.InverseMultiquadric(),
    "WoLF": hg.filters.WoLF(1.3),
}


def linear() -> dict[str, hg.filters.AbstractFilter]:
    """Filters of a linear sensor, two received numbers."""
    plant = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), 0.1 * np.eye(4), np.zeros(4), np.eye(4))
    gaussian = hg.LinearSensor(np.eye(2, 4), np.eye(2))
    contaminated = hg.LinearSensor(np.eye(2, 4), hg.Contaminated(np.eye(2), 0.05, 100 * np.eye(2)))
    student = hg.LinearSensor(np.eye(2, 4), hg.StudentT(np.eye(2), 3.0))
    channel, plain = hg.perfect(2), hg.kalman_filter(plant, gaussian)
    return {
        PLAIN: plain,
        **{name: hg.robust_filter(plant, gaussian, channel, rule) for name, rule in RULES.items()},
        "Student, variational Bayes": hg.robust_filter(plant, student, channel, hg.filters.StudentVB()),
        "contaminated, score": hg.robust_filter(plant, contaminated, channel),
        "Student, score": hg.robust_filter(plant, student, channel),
        "adaptive": hg.adaptive_filter(plain),
    }


def ranges() -> dict[str, hg.filters.AbstractFilter]:
    """Extended filters of four distances."""
    move = np.eye(4) + 0.1 * np.eye(4, k=2)
    plant = hg.Plant(lambda x, u: jnp.asarray(move) @ x, 0.1 * np.eye(4), np.array([3.0, 4.0, 0.0, 0.0]), np.eye(4))

    def distance(x: Any) -> Any:
        return jnp.hypot(x[0] - ANCHORS[:, 0], x[1] - ANCHORS[:, 1])

    sensor, channel = hg.Sensor(distance, np.eye(4)), hg.perfect(4)
    lines = hg.filters.Linearization()
    filters = {name: hg.robust_filter(plant, sensor, channel, rule, lines) for name, rule in RULES.items()}
    return {PLAIN: hg.extended_filter(plant, sensor, channel), **filters}


def ratios(items: dict[str, hg.filters.AbstractFilter], received: int) -> dict[str, float]:
    """Nanoseconds of a plain step and run, and how many times as long each filter takes."""
    z = np.random.default_rng(0).normal(3.0, 2.0, size=(RUNS, STEPS, received))
    z[np.random.default_rng(1).random(z.shape) < 0.05] = 30.0
    runs = {name: means_of(item) for name, item in items.items()}
    for name, run in runs.items():
        if not (engine := engine_of(run, z)).startswith("native"):
            raise SystemExit(f"{name}: expected a native program, got {engine}")
        hg.simulation.over_runs(run, z)  # compiles
    took: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(PASSES):
        for name, run in runs.items():
            begun = time.perf_counter()
            hg.simulation.over_runs(run, z)
            took[name].append(time.perf_counter() - begun)
    values = {f"{PLAIN} (ns per step and run)": 1e9 * float(np.median(took[PLAIN])) / (RUNS * STEPS)}
    return values | {
        f"{name} over {PLAIN}": float(np.median(np.divide(took[name], took[PLAIN]))) for name in runs if name != PLAIN
    }


def measure() -> dict[str, Any]:
    """Both sensors; the rules that weigh shall take at most 1.3 plain filters."""
    values = {f"two outputs: {name}": value for name, value in ratios(linear(), 2).items()}
    values |= {f"four ranges: {name}": value for name, value in ratios(ranges(), 4).items()}
    limits = {name: 1.3 for name in values if any(f": {rule} over" in name for rule in RULES)}
    return {"unit": "ns, and ratios", "values": values, "at_most": limits}


if __name__ == "__main__":
    for key, value in measure()["values"].items():
        print(f"{key:<56}{value:>10.2f}")
