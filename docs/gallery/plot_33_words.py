"""
What a flipped bit costs
========================

A sensor sends words of finite length, of which bits flip. The best linear filter pays for every flipped leading bit; a
filter that knows what a flipped bit is has a third of its variance, and is as good as a checksum that costs no bit.
Left against the bits of a word without flips, right against the error rate at eight bits.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.95]], 0.1, [0.0], 0.1 / (1 - 0.95**2), states=["level"])
sensor = hg.LinearSensor([[1.0]], 0.05, outputs=["level"])
reach = 5 * np.sqrt(0.1 / (1 - 0.95**2) + 0.05)
runs, steps = 1500, 60


def variances(bits, p, dither, checksum=False):
    """Mean squared errors over the later steps, by filter."""
    encoder = hg.Words(bits=bits, low=-reach, high=reach, dither=dither)
    link = hg.decode_and_forward([0.0 if checksum else p])
    filters = {"words": hg.word_filter(plant, sensor, link, encoder)}
    if not checksum:
        filters["linear"] = hg.linear_filter(plant, sensor, link, encoder=encoder)
    channel = hg.erasure(link, (1 - p) ** bits) if checksum else link
    network = hg.Network(plant, {"a": hg.Node(sensor, channel, filters, encoder=encoder)})
    table = hg.monte_carlo(network, steps, runs, 5, keep=hg.Statistics())["a"]
    return {name: np.mean(table[name].rmse_over_time()[20:] ** 2) for name in filters}


bits = np.array([2, 3, 4, 6])
by_bits = {d: [variances(b, 0.0, d) for b in bits] for d in ("none", "subtracted")}
rates = np.array([1e-3, 3e-3, 0.01, 0.05])
by_rate = [variances(8, p, "none") for p in rates]
checked = [variances(8, p, "none", checksum=True)["words"] for p in rates]

figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), layout="constrained")
left.plot(bits, [v["linear"] for v in by_bits["subtracted"]], "o-", color="#d55e00", label="linear filter")
left.plot(bits, [v["words"] for v in by_bits["none"]], "o-", color="#0072b2", label="word filter, no dither")
left.plot(
    bits, [v["words"] for v in by_bits["subtracted"]], "s--", color="#0072b2", label="word filter, subtracted dither"
)
left.set(xlabel="bits of a word, none flips", xticks=bits, ylabel="variance of the level's error", yscale="log")
right.plot(rates, [v["linear"] for v in by_rate], "o-", color="#d55e00", label="linear filter")
right.plot(rates, [v["words"] for v in by_rate], "o-", color="#0072b2", label="word filter")
right.plot(rates, checked, "s--", color="0.4", label="packets with a checksum of no length")
right.set(xlabel="error rate of a bit, words of 8 bits", xscale="log", yscale="log", ylim=left.get_ylim())
for axes in (left, right):
    axes.set(yticks=[0.04, 0.06, 0.1, 0.2, 0.3], yticklabels=["0.04", "0.06", "0.1", "0.2", "0.3"])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8)
assert by_rate[2]["words"] < 0.35 * by_rate[2]["linear"]  # at p = .01: .045 and .152
