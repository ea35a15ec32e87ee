"""
Relays that filter before they forward
======================================

Two relays take turns: while one listens to the sensor, the other sends its own estimate to the receiver.
Each relay may choose its gains so that *its own* error is small, which is what published designs do. But
nobody asks for the relays' estimates. If the gains are chosen for the receiver's error instead, the receiver
is better off, and what the relays send is no estimate any more: it is a message. All of this is computed
before there is any data.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.95, 0.2], [0.0, 0.9]], np.diag([1e-3, 1e-2]), [1.0, 0.0], 0.1 * np.eye(2))
sensor = hg.LinearSensor([[1.0, 0.5]], noise=1e-3)


def link(noise=1e-3):
    return hg.hop(hg.random_affine.LogNormal(-0.1, 0.2), noise)


odd = {"b": {"sensor": link(), "a": link(0.0)}, "receiver": {"a": link()}}
even = {"a": {"sensor": link(), "b": link(0.0)}, "receiver": {"b": link()}}
relays = hg.model.RelayNetwork(plant, sensor, ["a", "b"], [odd, even])

horizon = 25
local = hg.relays.local_error_design(relays, horizon)
tuned = hg.relays.receiver_error_design(relays, horizon)

fig, axes = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
for ax, place in zip(axes, ("receiver", "a"), strict=True):
    for name, design in {"each for itself": local, "all for the receiver": tuned}.items():
        traces = np.trace(design.covariance[place], axis1=1, axis2=2)
        ax.semilogy(np.arange(len(traces)), traces, label=name)
    ax.set(title=f"error of {'the receiver' if place == 'receiver' else 'relay a'}", xlabel="step")
axes[0].set_ylabel("trace of the error covariance")
axes[0].legend()
mean = [np.trace(d.covariance["receiver"], axis1=1, axis2=2)[1:].mean() for d in (local, tuned)]
print(f"mean trace at the receiver: {mean[0]:.4f} each for itself, {mean[1]:.4f} all for the receiver")
