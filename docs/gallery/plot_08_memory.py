"""
A link that is bad for a while
==============================

Real links fail in bursts: if the gain is low now, it is likely low at the next step too. A filter that
assumes a new draw at each step averages what is the same error again and again, and claims too little.
Both what it claims and what it has can be computed exactly, before any data.
"""

import matplotlib.pyplot as plt

import heliograph as hg

plant = hg.LinearPlant([[0.98]], noise=0.04, initial_mean=[0.0], initial_covariance=1.0)
sensor = hg.LinearSensor([[1.0]], noise=0.05)

lengths = [1.5, 3, 6, 12, 25, 50]  # steps that a bad spell lasts, on average; half of the time is bad
curves = {"assumes no memory: claims": [], "assumes no memory: has": [], "estimates the mode too": []}
for length in lengths:
    change = 1 / length
    good, bad = hg.hop(1.0, 0.05), hg.hop(0.2, 0.05)
    link = hg.gilbert_elliott(good, bad, fail=change, recover=change)
    blind = hg.filters.memoryless_filter(plant, sensor, link)
    error = hg.filters.true_error(blind, plant, sensor, link, horizon=150)
    curves["assumes no memory: claims"].append(error.claimed[-1, 0, 0])
    curves["assumes no memory: has"].append(error.true[-1, 0, 0])
    exact = hg.linear_filter(plant, sensor, link)
    known = hg.filters.true_error(exact, plant, sensor, link, horizon=150)
    curves["estimates the mode too"].append(known.true[-1, 0, 0])

fig, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
for (name, values), style in zip(curves.items(), ("C1--", "C1-", "C0-"), strict=True):
    ax.semilogx(lengths, values, style, marker="o", ms=4, label=name)
ax.set(xlabel="average length of a bad spell (steps)", ylabel="error variance", ylim=(0, None))
ax.set_xticks(lengths, [str(n) for n in lengths], minor=False)
ax.minorticks_off()
_ = ax.legend()
