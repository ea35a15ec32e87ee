"""
A clock that is wrong
=====================

A node whose clock is wrong stamps its values as of another time: the clock's offset and drift are states like others.
They can be known only against another clock that observes the same plant, and while the plant moves. A filter that
linearises anew at each step finds an offset all the same, and claims to know it; one that first asks whether the offset
can be observed keeps what it knew before.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

dt, steps, runs = 0.5, 300, 64
position = hg.LinearSensor([[1.0, 0.0]], 0.04)
noise = 0.02 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
clock = hg.model.Clock(offset=0.5, drift=2e-3)  # standard deviations


def cart(speed, share=1.0, spread=(1.0, 0.01)):
    """A cart seen by a node with a true clock and by one with a wrong one; offset and drift are its states 2 and 3."""
    plant = hg.LinearPlant([[1.0, dt], [0.0, 1.0]], share * noise, [0.0, speed], np.diag(spread))
    nodes = {"true": position, "wrong": position}
    return hg.model.with_clocks(plant, nodes, {"wrong": clock}, [[0.0, 1.0], [0.0, 0.0]], dt)


def offsets(world, believed, channel):
    """True and claimed deviation of the offset over time, of the filter that always estimates it and of the guarded."""
    plant, joint = believed[0], hg.model.joint_sensor(believed[1])
    filters = {
        "always": hg.filters.gaussian_filter(plant, joint, channel, hg.filters.PolynomialMoments(2)),
        "while it can be": hg.filters.clock_filter(plant, joint, channel, ["wrong"]),
    }
    nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name, sensor in world[1].items()}
    record = hg.monte_carlo(hg.Network(world[0], nodes, filters), steps, runs, key=0)
    for name, estimate in record.estimates["fused"].items():
        true = np.sqrt((record.errors("fused", name)[..., 2] ** 2).mean(axis=0))
        yield name, true, np.sqrt(np.broadcast_to(estimate.covariance[..., 2, 2], (runs, steps)).mean(axis=0))


both = hg.parallel([hg.perfect(), hg.perfect()])
alone = hg.parallel([hg.model.silent(1, 1, 1.0), hg.perfect()])  # the true clock is not received
moving, still = cart(1.0), cart(0.0, 0.0, (0.0, 0.0))
cases = {
    "in motion, beside a true clock": (moving, moving, both),
    "at rest, where the filters believe in motion": (still, cart(0.0, spread=(1.0, 0.1)), both),
    "in motion, no true clock": (moving, moving, alone),
}
fig, axes = plt.subplots(len(cases), 1, figsize=(7, 6.5), layout="constrained", sharex=True, sharey=True)
time = dt * np.arange(1, steps + 1)
for ax, (title, case) in zip(axes, cases.items(), strict=True):
    for color, (name, true, claimed) in zip(("C1", "C0"), offsets(*case), strict=True):
        ax.plot(time, true, color, label=f"{name}: true")
        ax.plot(time, claimed, f"{color}--", label=f"{name}: claims")
        print(f"{title}, estimated {name}: has {true[-1]:.3f} s, claims {claimed[-1]:.3f} s")
    ax.set_title(title, fontsize=9)
    ax.set(ylabel="offset (s)", ylim=(0, 1.5))
axes[-1].set_xlabel("time (s)")
_ = axes[0].legend(fontsize=8, ncols=2, title="offset estimated", title_fontsize=8)
