"""
Reports that are sent, and errors that are left
===============================================

Three rooms share their warmth, with a thermometer and a filter in each. Their reports reach a centre that remembers
all of them, every d-th step or where the estimate has moved by a threshold. Silence that is understood guarantees a
bound, which is wide; a centre that takes silence for a loss claims less and guarantees nothing. Lower left is better.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

warmth = np.diag([0.9, 0.8, 0.95]) + 0.1 * np.diag([1, 1], 1)
rooms = hg.LinearPlant(warmth, 0.1 * np.eye(3), np.zeros(3), np.eye(3))
gain = hg.Discrete([0.8 - np.sqrt(0.06), 0.8 + np.sqrt(0.06)], [0.5, 0.5])
nodes = {}
for i in range(3):
    sensor, link = hg.LinearSensor(np.eye(3)[[i]], 0.1), hg.hop(gain, 0.05)
    nodes[f"room {i}"] = hg.Node(sensor, link, {"local": hg.linear_filter(rooms, sensor, link)})


def event(level, informed):
    """Sent where the estimate has moved by a threshold."""
    return hg.Fusion("local", hg.fusion.AllReports(), quantizer=hg.fusion.EventSending(level, informed))


levels = (0.05, 0.15, 0.3, 0.5)
kinds = {
    "every d-th step": [
        hg.Fusion("local", hg.fusion.AllReports(), uplink=hg.fusion.ReportLink(every=d)) for d in (1, 2, 3, 4, 6)
    ],
    "on event, silence understood": [event(level, True) for level in levels],
    "on event, silence taken for a loss": [event(level, False) for level in levels],
}
fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
for color, (kind, fusions) in zip(("C0", "C2", "C3"), kinds.items(), strict=True):
    points = []
    for fusion in fusions:
        network = hg.Network(rooms, nodes, {"centre": fusion})
        item = hg.monte_carlo(network, 36, runs=128, key=0, keep=hg.Statistics())["fused"]["centre"]
        reports = 1 / fusion.uplink.every if item.uplink is None else item.uplink.symbols[18:].mean()
        claimed = np.trace(item.claimed(), axis1=1, axis2=2)[18:].mean()
        points.append((reports, np.mean(item.rmse_over_time()[18:] ** 2), claimed))
    sent, errors, claims = np.array(points).T
    ax.semilogy(sent, errors, f"{color}o-", label=kind)
    ax.semilogy(sent, claims, f"{color}:")
    print(f"{kind}: {sent.round(2)} reports, errors {errors.round(3)}, claims {claims.round(3)}")
ax.plot([], [], "k:", label="claimed")
ax.set(xlabel="reports per step and node", ylabel="mean square error, and what is claimed of it")
_ = ax.legend(fontsize=8)
