"""
Waiting pays: smoothing
=======================

A filter says what is known of a state when it happens. Whoever can wait a few steps knows more, and whoever
has the whole recording knows most. Behind random gains the smoothed covariance is exact as well.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

swing = 0.98 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
plant = hg.LinearPlant(swing, 0.02 * np.eye(2), [1.0, 0.0], 0.5 * np.eye(2))
sensor = hg.LinearSensor([[1.0, 0.0]], 0.25)
link = hg.hop(hg.Rayleigh(0.8), 0.02)
item = hg.linear_filter(plant, sensor, link)

# All of it can be had before any data: the gap is an outage of ten steps.
z = np.zeros((60, 1))
z[25:35] = np.nan
_, steps = hg.smoothing.smoother_steps(item, z)
waits = {"no wait (filter)": 0, "a lag of 3 steps": 3, "a lag of 10 steps": 10}
fig, ax = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
for name, lag in waits.items():
    estimate = hg.smoothing.FixedLag(lag).estimates(steps)
    ax.plot(np.sqrt(estimate.covariance[:, 0, 0]), label=name)
whole = hg.smoothing.FixedInterval().estimates(steps)
ax.plot(np.sqrt(whole.covariance[:, 0, 0]), "k", label="the whole recording")
ax.axvspan(25, 34, color="0.92", zorder=0)
ax.text(25.3, 0.02, "nothing arrives", fontsize=8)
ax.set(xlabel="step", ylabel="claimed deviation of the position", ylim=(0, None))
ax.legend(fontsize=8)
print("claim of the smoothed estimate:", whole.claim)
