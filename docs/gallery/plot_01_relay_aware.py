"""
A relay that fades, and the filter that knows it
================================================

A quantity that drifts (a temperature, a position) is measured every step. Its sensor is received through
a relay: the first hop fades as radio does indoors (Rayleigh), the second amplifies, and both add noise.
The receiver knows how the gain is *distributed*, but not what it was at any step.

Most people would put the mean gain into a Kalman filter. That filter takes every fade for a movement
of the plant, and what it claims of its own error is far too small. A filter that knows the gain's
second moment gives the measurement the weight that it deserves.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.98]], noise=0.02, initial_mean=[2.0], initial_covariance=0.3)
sensor = hg.LinearSensor([[1.0]], noise=0.02)
fading = hg.hop(hg.Rayleigh(0.8), noise=0.02)
amplified = hg.hop(1.0, noise=0.01, amplification=1.2)
relay = hg.amplify_and_forward([fading, amplified])
filters = {
    "knows the relay": hg.linear_filter(plant, sensor, relay),
    "trusts the mean gain": hg.mean_gain_filter(plant, sensor, relay),
}
network = hg.Network(plant, {"station": hg.Node(sensor, relay, filters)})
record = hg.monte_carlo(network, horizon=60, runs=64, key=4)

fig, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True, layout="constrained")
steps = np.arange(1, 61)
for ax, (name, estimate) in zip(axes, record.estimates["station"].items(), strict=True):
    mean, deviation = estimate.mean[0, :, 0], np.sqrt(estimate.covariance[0, :, 0, 0])
    low, high = mean - 2 * deviation, mean + 2 * deviation
    ax.fill_between(steps, low, high, alpha=0.25, label="two claimed deviations")
    ax.plot(steps, mean, label="estimate")
    ax.plot(steps, record.truth[0, :, 0], "k", lw=1, label="truth")
    ax.set(title=name, xlabel="step")
axes[0].set_ylabel("level")
axes[0].legend(fontsize=8)

# %%
# What the claims are worth shows over many runs: the normalised squared error (NEES) is 1 for a filter
# whose covariance is true, and above 1 for one that is too sure of itself.

for name, estimate in record.estimates["station"].items():
    error = record.errors("station", name)[..., 0]
    nees = np.mean(error**2 / estimate.covariance[..., 0, 0])
    rms = np.sqrt(np.mean(error**2))
    print(f"{name}: RMS error {rms:.3f}, NEES {nees:.2f}, claim {estimate.claim}")
