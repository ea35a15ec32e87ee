"""
Data that arrive late
=====================

Through a network a value may arrive one or two steps after it was sent. The usual mistake is to take it for
current. The best linear filter knows how delays are distributed, also when nobody tells it the delay of a
value, and what it claims is exact: it estimates what was sent, beside the state.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

drift = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
plant = hg.LinearPlant([[1.0, 1.0], [0.0, 0.95]], 0.05 * drift, [1.0, 0.5], np.diag([1.0, 0.2]))
sensor = hg.LinearSensor([[1.0, 0.0]], 0.3)
chances = [0.4, 0.35, 0.25]  # of a delay of 0, 1, 2 steps
link = hg.hop(1.0, 0.05, delay=hg.Discrete([0, 1, 2], chances))

cases = {
    "taken as current": (hg.filters.as_current_filter(plant, sensor, link), link),
    "delays not known": (hg.linear_filter(plant, sensor, link), link),
}
fig, ax = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
for color, (name, (item, channel)) in enumerate(cases.items()):
    error = hg.filters.true_error(item, plant, sensor, channel, horizon=30)
    ax.plot(error.true[:, 0, 0], f"C{color}", label=f"{name}: has")
    ax.plot(error.claimed[:, 0, 0], f"C{color}--", label=f"{name}: claims")
    print(f"{name}: claims {error.claimed[-1, 0, 0]:.2f}, has {error.true[-1, 0, 0]:.2f}")

ax.set(xlabel="step", ylabel="error variance of the position", ylim=(0, 1.6))
_ = ax.legend(fontsize=8, ncols=2)
