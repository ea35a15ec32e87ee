"""
Probabilities that are only roughly known
=========================================

Nobody knows to the last digit how often a relay uses which gain. With a ``radius``, each probability may be off
by that much. The filter then claims an *upper* bound: it holds for every law that is possible. The picture
shows the bound, and the true error for the laws at the corners of what is possible.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.9]], noise=0.1, initial_mean=[2.0], initial_covariance=0.5)
sensor = hg.LinearSensor([[1.0]], noise=0.05)
values, guess, radius = [0.4, 0.8, 1.2], [0.3, 0.4, 0.3], 0.1
rough = hg.hop(hg.Discrete(values, guess, radius), noise=0.05)
careful = hg.linear_filter(plant, sensor, rough)

fig, ax = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
worst = []
for law in hg.Discrete(values, guess, radius).extremes():
    world = hg.hop(law, noise=0.05)
    error = hg.filters.true_error(careful, plant, sensor, world, horizon=25)
    ax.plot(error.true[:, 0, 0], "C1", lw=0.8, label=None if worst else "has, if that law is the true one")
    worst.append(error.true[:, 0, 0])
ax.plot(error.claimed[:, 0, 0], "C0", lw=2, label=f"claims ({careful.claim})")
ax.set(xlabel="step", ylabel="error variance", ylim=(0, None))
ax.legend()
print(f"{len(worst)} laws; largest share of the bound that is used: {np.max(worst / error.claimed[:, 0, 0]):.2f}")
