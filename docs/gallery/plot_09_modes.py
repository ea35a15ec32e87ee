"""
Guessing which mode a link is in
================================

Behind a link that is good or bad for a while, what arrives tells something of the mode. The interacting
multiple model filter (IMM) keeps one Gaussian for each mode and the modes' probabilities; GPB2 weighs each
pair of modes. Both are sharper than the best linear filter; what they claim is nominal, because they forget
parts of the mixture at each step.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.98]], 0.04, [2.0], 1.0)
sensor = hg.LinearSensor([[1.0]], 0.05)
link = hg.markov_fading([0.2, 1.0], [[0.95, 0.05], [0.03, 0.97]], noise=0.05)
filters = {
    "linear": hg.linear_filter(plant, sensor, link),
    "imm": hg.filters.imm_filter(plant, sensor, link),
    "gpb2": hg.filters.gpb2_filter(plant, sensor, link),
}
network = hg.Network(plant, {"node": hg.Node(sensor, link, filters)})
record = hg.monte_carlo(network, horizon=120, runs=256, key=3)

fig, axes = plt.subplots(2, 1, figsize=(7, 4.6), sharex=True, layout="constrained")
steps = np.arange(1, 121)
axes[0].plot(steps, record.measurements["node"][0, :, 0], color="0.7", label="what arrives")
axes[0].plot(steps, record.truth[0, :, 0], "k", label="truth")
axes[0].legend(fontsize=8)
for name in filters:
    error = record.errors("node", name)[..., 0]
    axes[1].plot(steps, np.sqrt(np.mean(error**2, axis=0)), label=f"RMS error: {name}")
    rms = np.sqrt(np.mean(error[:, 30:] ** 2))
    print(f"{name}: RMS error {rms:.3f} over 256 runs, claim {record.estimates['node'][name].claim}")
axes[1].legend(fontsize=8)
_ = axes[1].set(xlabel="step", ylabel="over 256 runs", ylim=(0, None))
