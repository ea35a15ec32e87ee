"""
Fusion over links with few bits
===============================

Two stations filter on their own and send their estimates to a fusion centre. The radio allows a few bits
for each number, so estimates are quantized. The centre knows how far a quantizer can be off and widens the
covariances by that; so what it claims stays an upper bound at any number of levels.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

rooms = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.05 * np.eye(2), [0.0, 0.0], np.eye(2))
link = hg.hop(hg.Discrete([0.6, 1.0], [0.5, 0.5]), noise=0.02)
nodes = {}
for name, row in {"kitchen": [1.0, 0.2], "hall": [0.2, 1.0]}.items():
    sensor = hg.LinearSensor([row], noise=0.05)
    nodes[name] = hg.Node(sensor, link, {"local": hg.linear_filter(rooms, sensor, link)})

counts = [7, 15, 31, 63, 127]
rule = hg.fusion.EqualIntersection()
fused = {f"{levels}": hg.Fusion("local", rule, hg.fusion.UniformQuantizer(levels, amplitude=4.0)) for levels in counts}
fused["not quantized"] = hg.Fusion("local", rule)
network = hg.Network(rooms, nodes, fused)
result = hg.monte_carlo(network, horizon=25, runs=512, key=0, keep=hg.Statistics())["fused"]

has = [result[str(n)].rmse()[0] for n in counts]
claims = [np.sqrt(np.trace(result[str(n)].claimed(), axis1=1, axis2=2).mean()) for n in counts]
fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
ax.semilogx(counts, claims, "s--", label="claimed (upper bound)")
ax.semilogx(counts, has, "o-", label="RMS error over 512 runs")
ax.axhline(result["not quantized"].rmse()[0], color="k", lw=1, ls=":", label="not quantized: RMS error")
ax.set(xlabel="levels of the quantizer", ylabel="fused error", ylim=(0, None))
ax.set_xticks(counts, [str(n) for n in counts], minor=False)
ax.minorticks_off()
ax.legend()
print({name: statistics.claim for name, statistics in result.items()})
