"""
Signals that add up in the air
==============================

Sensors of one state transmit at once with a fixed total power, each behind a fading of its own, and the receiver gets
the sum. Its error falls as one over their number. On channels of their own they share the power, and the receiver's
noise is heard on each: the error stops at a floor. Relays that forward *one* measurement stop where it does.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.95]], [[0.1]], [0.0], [[1.0]])
unit = 0.1 / (1 - 0.95**2) + 0.05  # power that a transmitter of amplitude 1 sends


def error(count, together, same=False):
    """Steady variance of the best powers of a total."""
    rows = 1 if same else count
    sensor = hg.LinearSensor(np.ones((rows, 1)), 0.05 * np.eye(rows))
    links = [hg.hop(hg.Rayleigh(0.8), noise=0.0 if together else 0.1) for _ in range(count)]
    channel = hg.superposed(links, noise=0.1, same=same) if together else hg.parallel(links)
    return hg.design(hg.Network(plant, {"receiver": hg.Node(sensor, channel, {})}), budget=unit).error


counts = [1, 2, 4, 8, 16, 32, 64]
fig, ax = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
ax.loglog(counts, [error(m, True) for m in counts], "o-", label="added up")
ax.loglog(counts[:5], [error(m, False) for m in counts[:5]], "s-", label="on channels of their own")
ax.loglog(counts, [error(m, True, same=True) for m in counts], "^-", label="relays of one measurement")
ax.loglog(counts, 0.443380 / np.array(counts), "k:", lw=1, label="0.4434 / M")
ax.set(xlabel="number M of transmitters, of one total power", ylabel="steady variance")
_ = ax.legend(fontsize=8)
