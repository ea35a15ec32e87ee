"""
How many losses can a filter bear?
==================================

If the plant is unstable, its error grows between two packets. Below a certain arrival probability the mean
error has no bound, although it is small at most times. For each plant two numbers can be computed: below
the first nothing helps, above the second the mean error is bounded.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[1.25, 0.0], [1.0, 1.1]], 20 * np.eye(2), np.zeros(2), np.eye(2))
sensor = hg.LinearSensor([[1.0, 1.0]], 2.5)
critical = hg.linear.critical_arrival(plant, sensor)

arrivals = np.linspace(0.25, 1.0, 16)
bounds = []
for arrival in arrivals:
    received = hg.erasure(hg.perfect(), arrival)
    node = hg.Node(sensor, received, {"knows losses": hg.kalman_filter(plant, sensor)})
    result = hg.simulation.certify_boundedness(hg.Network(plant, {"node": node}))
    bounds.append(np.trace(result.bound) if result.verdict == "certified" else np.nan)

fig, ax = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
ax.axvspan(0.2, critical.lower, color="C3", alpha=0.2, label="every filter diverges")
ax.axvspan(critical.lower, critical.upper, color="0.85", label="undecided")
ax.semilogy(arrivals, bounds, "o-", label="certified bound on the mean error (trace)")
ax.set(xlabel="probability that a packet arrives", xlim=(0.2, 1.0), ylim=(50, 2e4))
ax.legend(fontsize=8)
print(f"below {critical.lower:.3f} nothing helps; above {critical.upper:.3f} the mean error is bounded")
