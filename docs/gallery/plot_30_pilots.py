"""
What a pilot is worth
=====================

A level behind a gain that fades. A receiver that is told a noisy reading of the gain, a pilot, is the better the
smaller the reading's error: from the receiver that knows the law alone to the one that knows the gain. The errors of
3,000 runs are what the filters claim, and a bound that draws nothing is close above.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.95]], 0.1, [0.0], 0.1 / (1 - 0.95**2), states=["level"])
sensor = hg.LinearSensor([[1.0]], 0.05, outputs=["level"])
runs = 3000


def receiver(known):
    """Claimed variance after 60 steps, mean squared error of runs with twice its error, and the filter."""
    link = hg.hop(hg.Rayleigh(0.8), noise=0.1, known=known)
    filter = hg.linear_filter(plant, sensor, link)
    network = hg.Network(plant, {"a": hg.Node(sensor, link, {"f": filter})})
    table = hg.monte_carlo(network, 60, runs, 1, keep=hg.Statistics()).to_xarray()
    squared = table["errors"].values[:, -1, 0, 0, 0, 0] / table["runs"].values
    claimed = table["claimed"].values[:, -1, 0, 0, 0, 0].mean()
    return claimed, squared.mean(), 2 * squared.std() / np.sqrt(len(squared) - 1), filter


errors = np.array([0.1, 0.2, 0.4, 0.8])
pilots = [receiver(hg.model.Pilot(error**2)) for error in errors]
claimed, squared, twice, filters = zip(*pilots, strict=True)
bounds = [hg.filters.mean_error_bound(filter, 60)[-1, 0, 0] for filter in filters]

figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
axes.errorbar(errors, squared, twice, fmt="o", color="#0072b2", label=f"squared error of {runs:,} runs, ± 2 errors")
axes.plot(errors, claimed, color="#0072b2", label="mean of what the filter claims")
axes.plot(errors, bounds, color="#d55e00", linestyle="--", label="bound, without drawing")
for known, words in ((False, "knows the law of the gain alone"), (True, "knows the gain")):
    level = receiver(known)[0]
    axes.axhline(level, color="0.4", linewidth=1)
    axes.text(0.8, level, words, fontsize=8, color="0.3", ha="right", va="bottom" if known is False else "top")
axes.set(xlabel="deviation of the reading's error", ylabel="variance of the level", ylim=(0.085, 0.165))
axes.set(xscale="log", xticks=errors, xticklabels=[f"{error:g}" for error in errors])
axes.minorticks_off()
_ = axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(0, 0.86))
