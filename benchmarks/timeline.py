"""Time of an event in a timeline of the README's network, a fifth of them out of order, on one core.

Run: python benchmarks/timeline.py. Microseconds of a push, the mean over all and the least over stretches of STRETCH.
"""

import os
import time
import warnings
from typing import Any

import numpy as np
from alone import show
from stream import readme_filter

import heliograph as hg

EVENTS, WARM, STRETCH = 6000, 1500, 500  # before WARM everything was compiled once
SPACING, LATE, LONGEST = 0.5, 0.2, 3.0  # s between events; the share that is late, and the longest delay
WINDOW = 5.0
LIMIT = 333  # 3,000 events a second


def readme_network() -> hg.Network:
    """Two filters at one node, the one that knows its relay and the one that trusts the mean gain."""
    aware: Any = readme_filter()
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), noise=0.02), hg.hop(1.0, noise=0.01, amplification=1.2)])
    channel = hg.parallel([relay, hg.perfect()])
    mean = hg.mean_gain_filter(aware.plant, aware.sensor, channel)
    return hg.Network(aware.plant, {"cart": hg.Node(aware.sensor, channel, {"relay_aware": aware, "mean_gain": mean})})


def measure() -> dict[str, Any]:
    """The mean and the least time of a push."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    generator = np.random.default_rng(0)
    moments = SPACING * np.arange(1, EVENTS + 1)
    late = generator.random(EVENTS) < LATE
    arrivals = moments + np.where(late, generator.uniform(SPACING, LONGEST, EVENTS), 0.0)
    order, z = np.argsort(arrivals, kind="stable"), generator.normal(5.0, 1.0, (EVENTS, 2))
    with warnings.catch_warnings():  # the README's noise has a part that does not grow with dt
        warnings.simplefilter("ignore")
        timeline = hg.Timeline(readme_network(), WINDOW)
    timeline.push("inputs", 0, 0.0, [0.1])
    stamps = []
    for i in order:
        stamps.append(time.perf_counter_ns())
        assert timeline.push("cart", int(i), moments[i], z[i], arrivals[i]) == "used"
    stamps.append(time.perf_counter_ns())
    taken = np.diff(stamps[WARM:]) / 1e3
    stretches = taken[: len(taken) // STRETCH * STRETCH].reshape(-1, STRETCH).mean(axis=1)
    values = {
        "an event, mean": float(taken.mean()),
        "an event, best stretch": float(stretches.min()),
        "share out of order": float(np.mean(np.diff(moments[order]) < 0)),
    }
    return {"unit": "us", "values": values, "at_most": {"an event, mean": LIMIT}}


if __name__ == "__main__":
    show(measure())
