"""
Places smoothed behind two fading hops
======================================

Places in two directions are sent with one gain over two hops that fade. How well they are known so far, some steps
later, and once all is in: these deviations are exact, and known before any data. Below, the errors of one run within
them.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

noise = 1e-3 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
start = np.diag([1.0, 0.01, 1.0, 0.01])
motion = np.kron(np.eye(2), [[1.0, 1.0], [0.0, 1.0]])
plant = hg.LinearPlant(motion, np.kron(np.eye(2), noise), [0.0, 0.1, 0.0, -0.05], start, states=["x", "vx", "y", "vy"])
sensor = hg.LinearSensor(np.eye(4)[[0, 2]], 0.25)
first = hg.hop(hg.Rayleigh(0.8), 0.02, dimension=2)
second = hg.hop(hg.Rayleigh(0.8), 0.01, amplification=1.2, dimension=2)
link = hg.amplify_and_forward([first, second])
item = hg.linear_filter(plant, sensor, link)
network = hg.Network(plant, {"node": hg.Node(sensor, link, {"linear": item})})
record = hg.monte_carlo(network, 100, runs=2, key=0, smooth=hg.smoothing.FixedInterval())
_, steps = hg.smoothing.smoother_steps(item, record.measurements["node"][0])


def deviation(covariance):
    """Of the place, over time."""
    return np.sqrt(covariance[:, 0, 0] + covariance[:, 2, 2])


fig = plt.figure(figsize=(8, 6.4), layout="constrained")
upper, lower = fig.subfigures(2, 1, height_ratios=[5, 6])
ax, time = upper.subplots(), np.arange(1, 101)
ax.plot(time, deviation(steps.covariance), "0.5", label="filter")
for lag, color in {1: "C1", 5: "C2", 20: "C3"}.items():
    ax.plot(time, deviation(hg.smoothing.FixedLag(lag).estimates(steps).covariance), color, label=f"{lag} later")
ax.plot(time, deviation(hg.smoothing.FixedInterval().estimates(steps).covariance), "C0", label="all data")
ax.set(ylabel="standard deviation of the place", xlabel="step", ylim=(0, None))
ax.legend(fontsize=8)

grid = lower.subplots(2, 2, sharex=True, sharey=True)
for row, (name, part, color) in zip(
    grid, (("filter", record, "0.5"), ("smoother", record.smoothed, "C0")), strict=True
):
    errors, covariance = part.errors("node", "linear")[0], part.estimates["node"]["linear"].covariance[0]
    for panel, state in zip(row, (0, 2), strict=True):
        band = 2 * np.sqrt(covariance[:, state, state])
        panel.fill_between(time, -band, band, color=color, alpha=0.25, lw=0)
        panel.plot(time, errors[:, state], color, lw=0.9)
        panel.set_title(f"{name}: {plant.states[state]}, within two deviations", fontsize=8)
grid[0, 0].set_ylabel("error")
_ = grid[1, 0].set(ylabel="error", xlabel="step")
