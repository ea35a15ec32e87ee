"""
Fusion that knows what is shared
================================

Two rooms' filters are wrong in similar ways, because they follow one plant. Covariance intersection holds
whatever the correlation, and pays for it. If the local filters are linear, the correlation is known before
any data, and the fusion can use it: with the best weights, or with a memory of all reports. The latter is
as good as a filter that receives every sensor itself, or nearly.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

rooms = hg.LinearPlant([[0.95, 0.1], [0.05, 0.9]], 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
link = hg.hop(hg.Discrete([0.6, 1.0], [0.5, 0.5]), noise=0.05)
nodes = {}
for name, row in {"kitchen": [1.0, 0.0], "hall": [0.0, 1.0]}.items():
    sensor = hg.LinearSensor([row], 0.1)
    nodes[name] = hg.Node(sensor, link, {"local": hg.linear_filter(rooms, sensor, link)})
fused = {
    "best weights": hg.Fusion("local", hg.fusion.MatrixWeights()),
    "memory of\nall reports": hg.Fusion("local", hg.fusion.AllReports()),
}
network = hg.Network(rooms, nodes, fused)
horizon = 30

# What each knows after 30 steps, exactly, before any data. One room alone:
traces = {}
local = {}
for name, node in nodes.items():
    error = hg.filters.true_error(node.filters["local"], rooms, node.sensor, link, horizon)
    local[name] = hg.model.Estimate(np.zeros(2), error.claimed[-1], "exact")
    traces[f"{name}\nalone"] = np.trace(error.true[-1])

# Intersection knows these two covariances and nothing else; the others know how they are correlated.
intersection = hg.fusion.fuse(hg.CovarianceIntersection(), list(local.values()))
traces["covariance\nintersection"] = np.trace(intersection.covariance)
for name, covariance in hg.simulation.fused_covariances(network, horizon).items():
    traces[name] = np.trace(covariance[-1])

# The best that is possible: one filter that receives both sensors itself.
both, links = hg.LinearSensor(np.eye(2), 0.1 * np.eye(2)), hg.parallel([link, link])
centre = hg.linear_filter(rooms, both, links)
traces["receives both\nsensors"] = np.trace(hg.filters.true_error(centre, rooms, both, links, horizon).true[-1])

fig, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
bars = ax.bar(range(len(traces)), np.sqrt(list(traces.values())), color=["0.7", "0.7", "C1", "C0", "C0", "C2"])
ax.bar_label(bars, fmt="%.3f")
ax.set_xticks(range(len(traces)), traces.keys(), fontsize=8)
ax.margins(y=0.1)
_ = ax.set_ylabel("error that is claimed\n(root of the trace)")
