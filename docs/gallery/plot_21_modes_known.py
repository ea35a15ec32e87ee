"""
What it is worth to know a link's mode
======================================

A link stays good or bad for some twenty steps at a time. A filter that assumes a new gain at each step claims less
than half of its error. The best linear filter that is told nothing errs hardly less, but claims what it has. A
Gaussian for each mode halves the error, and a receiver that is told the mode, be it one step late, takes a fifth off
that again.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.98]], 0.04, [0.0], 0.04 / (1 - 0.98**2))
sensor = hg.LinearSensor([[1.0]], 0.05)
link = hg.gilbert_elliott(good=hg.hop(1.0, 0.05), bad=hg.hop(0.2, 0.05), fail=0.03, recover=0.05)
model = (plant, sensor, link)
nodes = {
    "told nothing": hg.Node(
        sensor,
        link,
        {
            "no memory": hg.filters.memoryless_filter(*model),
            "linear, modes": hg.linear_filter(*model),
            "a Gaussian per mode (GPB2)": hg.filters.gpb2_filter(*model),
        },
    ),
    "told late": hg.Node(
        sensor,
        hg.model.with_flag(link, late=True),
        {"mode known one step late": hg.filters.mode_late_filter(*model)},
    ),
    "told": hg.Node(sensor, hg.model.with_flag(link), {"mode known": hg.filters.mode_known_filter(*model)}),
}
runs, steps = 1024, 150
record = hg.monte_carlo(hg.Network(plant, nodes), steps, runs, key=0)

fig, axes = plt.subplots(2, 1, figsize=(7, 5.4), layout="constrained", sharex=True, sharey=True)
colors = iter(("C3", "C0", "C2", "C4", "k"))
for node, estimates in record.estimates.items():
    for name, estimate in estimates.items():
        squares, color = record.errors(node, name)[..., 0] ** 2, next(colors)
        claimed = np.broadcast_to(estimate.covariance[..., 0, 0], (runs, steps)).mean(axis=0)
        axes[0].plot(claimed, color, lw=1.3, label=name)
        axes[1].plot(squares.mean(axis=0), color, lw=1.3)
        print(f"{name}: {estimate.claim}, claims {claimed[50:].mean():.3f}, has {squares[:, 50:].mean():.3f}")
axes[0].set(ylabel="claimed variance", ylim=(0, 0.4))
axes[1].set(ylabel="mean square error", xlabel="step")
_ = axes[0].legend(fontsize=8, ncols=2)
