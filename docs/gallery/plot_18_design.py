"""
Where power belongs
===================

Three sensors measure a plant of two states. The first is received directly, the other two through a relay each, which
amplifies what it receives, noise included. How much should each of the five transmitters send? ``hg.design`` spreads a
budget so that the best linear filter of all that is received has the least error; and says how much better any
other spread could be.

Power does not go everywhere in proportion: below some budget a relayed path gets none, since two noisy hops carry
next to no information. Then it comes in at once, with a good share.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

plant = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], np.diag([0.1, 0.05]), [0.0, 0.0], np.eye(2))
fading = hg.Discrete([0.7, 1.0, 1.3], [0.3, 0.4, 0.3])


def relayed(distance):
    """Two hops of the same length; noise grows with the distance, as a signal falls with it."""
    return hg.amplify_and_forward([hg.hop(fading, 0.4), hg.hop(fading, 0.4 * distance**3)])


near = hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.5), hg.hop(fading, 0.2), {})
left = hg.Node(hg.LinearSensor([[0.0, 1.0]], 0.4), relayed(1.2), {})
right = hg.Node(hg.LinearSensor([[1.0, 1.0]], 0.3), relayed(0.8), {})
network = hg.Network(plant, {"near": near, "left": left, "right": right})

budgets = np.geomspace(0.2, 40, 19)
designs = [hg.design(network, budget=budget) for budget in budgets]
few = budgets[::3]
equal = [hg.design(network, budget=hg.planning.Budget(per_transmitter=budget / 5)).error for budget in few]

fig, (left_ax, right_ax) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left_ax.plot(few, equal, "C7--", label="the same for each transmitter")
left_ax.plot(budgets, [best.error for best in designs], "C0", lw=2, label="best spread")
left_ax.set(xscale="log", xlabel="total power", ylabel="error variance, both states", ylim=(0, None))
left_ax.legend(fontsize=8)
names = list(designs[0].powers)
shares = [[best.powers[name][0] / best.total for best in designs] for name in names]
colors = ["C1", "#2ca02c", "#98df8a", "#1f77b4", "#aec7e8"]
right_ax.stackplot(budgets, shares, labels=names, colors=colors)
right_ax.set(xscale="log", xlabel="total power", ylabel="share of it", xlim=budgets[[0, -1]], ylim=(0, 1))
right_ax.legend(fontsize=8, loc="lower left")

# %%
# With two hops in a path the problem is not convex, so a search alone proves nothing. The certificate bounds from
# below what *any* spread of the same power can reach, and the last column is how far the design may be from that.

for budget, best in list(zip(budgets, designs, strict=True))[::6]:
    print(
        f"power {budget:6.2f}: error {best.error:.4f}, at most {best.certificate.gap / best.error:.1e} above the best"
    )
print(designs[9].certificate.words)

# %%
# Asked the other way round: the least power that reaches a target error.

cheap = hg.design(network, target_error=0.3)
print({name: round(float(power[0]), 2) for name, power in cheap.powers.items()}, "in all", round(cheap.total, 2))
