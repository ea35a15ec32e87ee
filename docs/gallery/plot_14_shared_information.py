"""
Fusion that knows what is shared
================================

Two rooms' filters are wrong in similar ways, because they follow one plant. Covariance intersection holds
whatever the correlation, and pays for it. If the local filters are linear, the correlation is known before
any data, and the fusion can use it: with the best weights, or with a memory of all reports. The latter is
as good as a filter that hears every sensor itself, or nearly.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

rooms = hg.LinearPlant([[0.95, 0.1], [0.05, 0.9]], 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
link = hg.hop(hg.Discrete([0.6, 1.0], [0.5, 0.5]), noise=0.05)
nodes = {}
for name, row in {"kitchen": [1.0, 0.0], "hall": [0.0, 1.0]}.items():
    sensor = hg.LinearSensor([row], 0.1)
    nodes[name] = hg.Node(sensor, link, {"own": hg.linear_filter(rooms, sensor, link)})
both = hg.LinearSensor(np.eye(2), 0.1 * np.eye(2))
centre = hg.linear_filter(rooms, both, hg.parallel([link, link]))
fused = {
    "covariance\nintersection": hg.Fusion("own", hg.CovarianceIntersection()),
    "best weights": hg.Fusion("own", hg.fusion.MatrixWeights()),
    "memory of\nall reports": hg.Fusion("own", hg.fusion.AllReports()),
    "hears all\nsensors": centre,
}
network = hg.Network(rooms, nodes, fused)
found = hg.monte_carlo(network, horizon=30, runs=512, key=0, keep=hg.Statistics())["fused"]

fig, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
for place, statistics in enumerate(found.values()):
    label = ("claimed", "over 512 runs") if place == 0 else (None, None)
    claimed = np.sqrt(np.trace(statistics.claimed()[10:], axis1=1, axis2=2).mean())
    has = np.sqrt(np.trace(statistics.actual()[10:], axis1=1, axis2=2).mean())
    ax.bar(place - 0.2, claimed, 0.4, color="C0", label=label[0])
    ax.bar(place + 0.2, has, 0.4, color="C1", label=label[1])
ticks = [f"{name}\n({statistics.claim})" for name, statistics in found.items()]
ax.set_xticks(range(len(ticks)), ticks, fontsize=8)
ax.set_ylabel("RMS error")
_ = ax.legend()
