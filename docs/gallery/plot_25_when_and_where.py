"""
Who sends when, and where a relay stands
========================================

Of six sensors one may send at each step: the best schedule of each period, beside an error that no schedule of any
period goes below. Over two hops it pays to be silent and then loud, at the same mean power. And one relay between a
sensor and a receiver stands best halfway only while noise is small, beyond that nearer to one end.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg
from heliograph_studies import theory

plant = [[0.95, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, -0.1, 0.8]], np.diag([0.1, 0.05, 0.2])
rows = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 0, 1]])
noises, distance = [0.5, 0.4, 0.3, 0.6, 0.5, 0.8], np.array([1.2, 0.7, 1.9, 1.0, 1.5, 0.5])
kappa = np.array([1.02, 1.05, 1.02, 1.1, 1.02, 1.05])
paths = hg.planning.independent_paths(*plant, rows, noises, kappa, distance**3 / kappa)
turns = theory.best_schedule(paths, powers=6.0, periods=[1, 2, 3])
slow = hg.planning.independent_paths([[0.99]], [[0.02]], [[1.0]], [0.2], 1.0, [[2.0, 2.0]])
bursts = theory.burst_sending(slow, powers=0.5)

fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
for ax, errors, found in zip(axes, (turns.by_period, bursts.errors), (turns, bursts), strict=False):
    ax.plot(list(errors), list(errors.values()), "C0o-", label="found")
    ax.axhline(found.bound, color="C3", ls="--", label="nothing is below")
    ax.set_xticks(list(errors))
    ax.legend(fontsize=8)
axes[0].set(title="one of six sensors at a step", xlabel="period", ylabel="mean error")
axes[1].set(title="two hops, seldom but loud", xlabel="sending every n-th step, n")
for exponent, color in {2.5: "C2", 3.0: "C0", 4.0: "C3"}.items():
    halfway = 2**exponent * (exponent / 2 - 1)  # noise up to which the midpoint is best
    rho = np.geomspace(0.2 * halfway, 20 * halfway, 40)
    sites = np.array([theory.relay_line(r, exponent).sites[0] for r in rho])
    axes[2].semilogx(rho, np.minimum(sites, 1 - sites), color, label=f"path loss d^{exponent:g}")
    axes[2].plot(halfway, 0.5, f"{color}o")
axes[2].set(title="best site of one relay", xlabel="noise of the whole way, over power", ylabel="part of the way")
axes[2].legend(fontsize=8)
print(f"schedule {turns.steps}: {turns.error:.4f}, the greedy one {turns.greedy:.4f}, none below {turns.bound:.4f}")
print(f"every {bursts.every}th step: {bursts.error:.3f}, every step: {bursts.errors[1]:.3f}")
