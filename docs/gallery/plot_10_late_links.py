"""
Data that arrive late
=====================

Through a network a value may arrive one or two steps after it was sent. The usual mistake is to take it for
current. The best linear filter knows how delays are distributed, also when nobody tells it the delay of a
value, and what it claims is exact: it estimates what was sent, beside the state. Time stamps are worth a good part of
what delays cost.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

drift = np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
plant = hg.LinearPlant([[1.0, 1.0], [0.0, 0.95]], 0.05 * drift, [1.0, 0.5], np.diag([1.0, 0.2]))
sensor, hop = hg.LinearSensor([[1.0, 0.0]], 0.3), hg.hop(1.0, 0.05)
law = hg.Discrete([0, 1, 2], [0.4, 0.35, 0.25])  # chances of a delay of 0, 1, 2 steps
links = {
    "delays not known": hg.model.delayed(hop, law),
    "time stamps": hg.model.delayed(hop, law, timestamped=True),
    "all one step late": hg.model.delayed(hop, 1),
    "not late": hop,
}
filters = {name: {name: hg.linear_filter(plant, sensor, link)} for name, link in links.items()}
late = links["delays not known"]
filters["delays not known"]["taken as current"] = hg.filters.as_current_filter(plant, sensor, late)
network = hg.Network(plant, {name: hg.Node(sensor, link, filters[name]) for name, link in links.items()})
record = hg.monte_carlo(network, 60, runs=1024, key=0)

# %%
# Above what each filter claims of the position, below its mean square error over 1,024 runs. Only the filter that takes
# late data as current differs: it claims what it would have if nothing were late.

fig, axes = plt.subplots(2, 1, figsize=(7, 5.4), layout="constrained", sharex=True, sharey=True)
shown = ["taken as current", "delays not known", "time stamps", "all one step late", "not late"]
for color, name in zip(("C3", "C0", "C2", "C4", "k"), shown, strict=True):
    node = next(node for node, estimates in record.estimates.items() if name in estimates)
    squares = record.errors(node, name)[..., 0] ** 2
    claimed = np.broadcast_to(record.estimates[node][name].covariance[..., 0, 0], squares.shape)
    for ax, curve in zip(axes, (claimed, squares), strict=True):
        ax.plot(curve.mean(axis=0), color, lw=1.4, label=name)
    print(f"{name}: claims {claimed[:, 30:].mean():.3f}, has {squares[:, 30:].mean():.3f}")
axes[0].set(ylabel="claimed variance", ylim=(0, None))
axes[1].set(ylabel="mean square error", xlabel="step")
_ = axes[0].legend(fontsize=8, ncols=3)
