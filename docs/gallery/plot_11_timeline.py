"""
Events out of order, and twice
==============================

A ``Timeline`` takes events as a network delivers them. Each gets a verdict; one that is late is put in its
place in time, and what came after is computed again. So the estimates are those of a filter that had received
everything in order.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], np.diag([0.01, 0.02]), [0.0, 1.0], np.eye(2))
sensor = hg.LinearSensor([[1.0, 0.0]], 0.5)
node = hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(plant, sensor)})
network = hg.Network(plant, {"radio": node})

random = np.random.default_rng(1)
values = np.cumsum(np.full(25, 1.0)) + random.normal(0, 0.7, 25)
arrivals = np.arange(25) + random.exponential(1.0, 25)
order = np.argsort(arrivals)

timeline = hg.Timeline(network, window=8)
verdicts, known = [], []
for k in order:
    verdict = timeline.push("radio", sequence=k, time=k, values=[values[k]], arrival=arrivals[k])
    verdicts.append(verdict)
    mean = timeline.estimates()["radio"]["kalman"].mean[0]
    known.append((arrivals[k], mean))
again = timeline.push("radio", sequence=24, time=24, values=[values[24]], arrival=arrivals.max() + 1)
print({v: verdicts.count(v) for v in set(verdicts)}, "; a copy of the last one:", again)

fig, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
for k in range(25):
    ax.plot([k, arrivals[k]], [values[k]] * 2, color="0.75", lw=1)
ax.plot(np.arange(25), values, "k.", label="measured")
ax.plot(arrivals, values, "C1>", ms=4, label="arrived")
ax.plot(*np.transpose(known), "C0", label="estimate of the latest moment")
ax.set(xlabel="time (steps)", ylabel="position")
_ = ax.legend()
