"""
Learning a link from what came through it
=========================================

Nobody has measured how a link fades, or how loud its receiver's noise is. What arrived tells it, without any
knowledge of the true state: write ``hg.free(start)`` where a number is unknown, and ``hg.fit`` finds the numbers
under which the recording is most likely. Each comes with an interval: four times the recording, half the interval.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

TRUTH = {"plant noise": 0.15, "fading": 0.7, "hop noise": 0.3}


def network(numbers):
    """A cart that is pushed to and fro, and whose position is received over a Rayleigh link."""
    plant = hg.LinearPlant([[0.95]], numbers["plant noise"], [0.0], 1.0, [[1.0]], states=["position"])
    sensor = hg.LinearSensor([[1.0]], 0.1)
    link = hg.hop(hg.Rayleigh(numbers["fading"]), numbers["hop noise"])
    filters = {"aware": hg.linear_filter(plant, sensor, link)}
    return hg.Network(plant, {"cart": hg.Node(sensor, link, filters)})


def unknown():
    """The same network before anything is known of it: first guesses in place of the numbers."""
    return network(
        {
            "plant noise": hg.free(0.5, "plant noise"),
            "fading": hg.free(0.4, "fading"),
            "hop noise": hg.free(0.1, "hop noise"),
        }
    )


steps = 1600
pushes = np.where(np.arange(steps) // 30 % 2, 0.4, -0.4)[:, None]
received = hg.monte_carlo(network(TRUTH), steps, runs=1, key=0, inputs=pushes).measurements["cart"][0]
fits = {n: hg.fit(unknown, received[:n], pushes[:n], starts=1) for n in (400, steps)}
print(fits[steps])

# %%
# What is that worth? On data that no fit has seen, three filters receive the same: one with the first guesses, one with
# the learned numbers, one with the true ones. NEES is the squared error over what the filter claims: 1 if that is true.

world = network(TRUTH)
cart = world.nodes["cart"]
learned = {"first guesses": unknown(), "learned": fits[steps].network, "true numbers": world}
filters = {name: item.nodes["cart"].filters["aware"] for name, item in learned.items()}
fresh = hg.Network(world.plant, {"cart": hg.Node(cart.sensor, cart.channel, filters)})
record = hg.monte_carlo(fresh, 100, runs=64, key=1, inputs=pushes[:100])

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=[2, 3], layout="constrained")
left.axvline(1.0, color="k", lw=1)
for place, (n, result) in enumerate(fits.items()):
    for height, row in enumerate(result.rows()):
        at, truth = height + 0.2 * (1 - 2 * place), TRUTH[row.name]
        left.plot([row.low / truth, row.high / truth], [at, at], f"C{place}", lw=6, alpha=0.3)
        left.plot(row.estimate / truth, at, f"C{place}o", label=f"{n} steps" if not height else None)
left.set(
    xlabel="learned / true, and 95 % intervals", xscale="log", yticks=range(3), yticklabels=TRUTH, ylim=(-0.5, 3.0)
)
left.set_xticks([0.25, 0.5, 1, 2], ["1/4", "1/2", "1", "2"])
left.minorticks_off()
left.legend(fontsize=8)
for name in ("first guesses", "learned"):
    right.plot(record.estimates["cart"][name].mean[0, :, 0], label=name)
right.plot(record.truth[0, :, 0], "k", lw=1, label="truth")
right.set(title="on new data", xlabel="step", ylabel="position")
right.legend(fontsize=8)
for name, estimate in record.estimates["cart"].items():
    error = record.errors("cart", name)[..., 0]
    nees = np.mean(error**2 / estimate.covariance[..., 0, 0])
    print(f"{name}: RMS error {np.sqrt(np.mean(error**2)):.3f}, NEES {nees:.2f}")
