"""
Gains of a few values: the mixture filter
=========================================

A relay switches between three amplifications and does not say which one it uses. The best linear filter
treats the gain as noise. The mixture filter asks at each step which of the gains fits what arrived, and
weighs the three answers. It claims a *nominal* covariance only: after each step its mixture of Gaussians
is cut down to one.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.99]], noise=0.01, initial_mean=[3.0], initial_covariance=0.5)
sensor = hg.LinearSensor([[1.0]], noise=0.01)
switching = hg.hop(hg.Discrete([0.5, 1.0, 1.8], [0.3, 0.4, 0.3]), noise=0.01)
filters = {
    "mixture": hg.filters.mixture_filter(plant, sensor, switching),
    "best linear": hg.linear_filter(plant, sensor, switching),
}
network = hg.Network(plant, {"node": hg.Node(sensor, switching, filters)})
record = hg.monte_carlo(network, horizon=50, runs=256, key=2)

steps = np.arange(1, 51)
fig, axes = plt.subplots(2, 1, figsize=(7, 5), sharex=True, layout="constrained")
axes[0].plot(steps, record.measurements["node"][0, :, 0], "k.", ms=4, label="what arrived")
axes[0].plot(steps, record.truth[0, :, 0], "k", lw=1, label="truth")
for name in filters:
    axes[0].plot(steps, record.estimates["node"][name].mean[0, :, 0], label=name)
    error = record.errors("node", name)[..., 0]
    axes[1].plot(steps, np.sqrt(np.mean(error**2, axis=0)), label=f"{name}: RMS error")
    rms = np.sqrt(np.mean(error[:, 10:] ** 2))
    print(f"{name}: RMS error {rms:.3f}, claim {record.estimates['node'][name].claim}")
axes[0].legend(fontsize=8, ncols=2)
axes[1].legend(fontsize=8)
_ = axes[1].set(xlabel="step", ylabel="over 256 runs", ylim=(0, None))
