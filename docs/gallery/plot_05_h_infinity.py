"""
A guarantee for the worst disturbance (H-infinity)
==================================================

A covariance speaks of the average. If the disturbance is not noise but something that may be unkind, a
motor that runs at just the wrong frequency, say, one asks for the worst case instead: the energy of the
filter's error, divided by the energy of everything that disturbs, shall stay below a *level* squared.

The smallest level over a horizon is the solution of a convex problem. A certificate, made by other code,
confirms it. The curve shows that measurements matter here: without any, the smallest level that can be
proven is far higher.
"""

import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

turn = 0.5
swing = 0.97 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
link = hg.hop(hg.random_affine.bernoulli(0.9), noise=1.0)  # one packet in ten is lost, untold

horizons = [4, 8, 12]
levels = {"measurements used": [], "measurements ignored": []}
for steps in horizons:
    system = hg.h_infinity.growth_system(
        steps=steps,
        transition=swing,
        growth=0.05,  # what is not in the matrix grows by at most this much
        output=[[1.0, 0.0]],
        disturbance=[[0.0], [1.0]],
        feedthrough=[[0.0]],
        target=np.eye(2),
        channel=link,
        initial_weight=1.0,
    )
    design = hg.h_infinity.horizon_design(system, separate=True)
    nothing = hg.h_infinity.horizon_design(system, separate=True, gains=np.zeros_like(design.gains))
    levels["measurements used"].append(design.level)
    levels["measurements ignored"].append(nothing.level)

parts = design.gains, design.weights, design.multipliers, design.level
certificate = hg.h_infinity.certify_level(system, *parts)
print(f"level {design.level:.2f} over {steps} steps; certified: {certificate.certified}")

fig, ax = plt.subplots(figsize=(6, 3.4), layout="constrained")
for name, values in levels.items():
    ax.plot(horizons, values, "o-", label=name)
ax.set(xlabel="horizon (steps)", ylabel="smallest proven level", ylim=(0, None), xticks=horizons)
_ = ax.legend()
