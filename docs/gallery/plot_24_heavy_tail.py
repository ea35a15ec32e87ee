"""
Close by: errors with a heavy tail
==================================

A target passes a station. Its range comes through two hops that fade, which leaves it almost unknown; its bearing
comes as it is. Where the target passes close, the place is known no better than the distance itself, and over the
width of that belief the bearing bends. A slope, or two points a direction, miss the bend, and the filter says it is
sure.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

drift = np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
motion = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2))
start = np.diag([20.0, 20.0, 2.0, 2.0]) ** 2
target = hg.LinearPlant(motion, 0.05 * drift, [300.0, 50.0, -10.0, 0.0], start, states=("x", "y", "vx", "vy"))
station = hg.Sensor(
    lambda x: jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])]),
    np.diag([1.0, 0.02**2]),
    outputs=("range", "bearing"),
    circular=["bearing"],
)
fading = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02) for _ in range(2)])
model = target, station, hg.parallel([fading, hg.hop(1.0, 1e-4)])
filters = {
    "slope at the mean": hg.extended_filter(*model),
    "cubature, 8 points": hg.cubature_filter(*model),
    "7 points a direction": hg.filters.gaussian_filter(*model, hg.filters.PolynomialMoments(6)),
}
network = hg.Network(target, {"station": hg.Node(station, model[2], filters)})
record = hg.monte_carlo(network, 80, runs=400, key=0)

closest = np.hypot(record.truth[..., 0], record.truth[..., 1]).min(axis=1)
tenths = np.array_split(np.argsort(closest), 10)  # of the runs, closest pass first
fig, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
for color, name in zip(("C3", "C1", "C0"), filters, strict=True):
    squares = np.sum(record.errors("station", name)[..., :2] ** 2, axis=-1)
    errors = [np.sqrt(squares[runs].mean()) for runs in tenths]
    ax.semilogy(range(1, 11), errors, f"{color}o-", ms=4, label=name)
    print(f"{name}: {np.sqrt(squares.mean()):.0f} m RMS, {np.sqrt(np.median(squares)):.0f} m median")
ax.set(xlabel="tenth of the runs, closest pass first", ylabel="error of the place (m, RMS)", xticks=range(1, 11))
ax.set_yticks([20, 50, 100, 200, 400], ["20", "50", "100", "200", "400"], minor=False)
ax.minorticks_off()
_ = ax.legend(fontsize=8)
