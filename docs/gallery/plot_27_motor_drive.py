"""
A motor's speed behind two relays, and a load that the model does not know
==========================================================================

An induction machine starts against friction and a fan; at 0.75 s the load grows by 1.5 Nm. The filters' model knows of
it only as process noise. Stator currents reach two nodes through fading relays. Left the noise as it was stated: the
fused filter claims too much error. Right a tenth of it: the speed's error grows with the load, and the claim denies it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg

step, steps = 5e-4, 2000
poles, stator, rotor, main, inertia = 2, 2.9338, 1.355, 143.75e-3, 5.1e-3
winding = main + 5.87e-3
coupling = main / winding
scale = np.array([3.9, 3.9, 0.4, 0.4, np.pi * 50])  # A, Vs, rad/s
middle = step * (np.arange(steps) + 0.5)
angle = 2 * np.pi * 40 * np.where(middle < 0.5, middle**2, middle - 0.25)
volts = ((4 + 100 * np.minimum(middle / 0.5, 1)) * np.array([np.cos(angle), np.sin(angle)])).T
dry = np.where(middle < 0.75, 0.1, 1.6)


def rates(x, u, load):
    """Change of currents, rotor flux and speed under a load of any speed."""
    i, psi, speed = x[:2], x[2:4], x[4]
    flux_rate = rotor / winding * (main * i - psi) + poles * speed * jnp.stack([-psi[1], psi[0]])
    torque = 1.5 * poles * coupling * (psi[0] * i[1] - psi[1] * i[0])
    current_rate = (u - stator * i - coupling * flux_rate) / (winding - main * coupling)
    return jnp.concatenate([current_rate, flux_rate, (torque - load(speed))[None] / inertia])


def move(x, u, load=lambda speed: 0.0, h=step):
    """A step by the method of Runge and Kutta, per unit."""
    rate, x = partial(rates, u=u, load=load), x * scale
    a = rate(x)
    b = rate(x + h / 2 * a)
    c = rate(x + h / 2 * b)
    return (x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c))) / scale


def loaded(x, row):
    """A step of the truth in ten parts."""
    u, dry = row
    load = lambda w: jnp.clip(w * inertia / 1e-3, -dry, dry) + 1e-3 * w + 3e-5 * w * w  # noqa: E731
    x = jax.lax.fori_loop(0, 10, lambda _, x: move(x, u, load, step / 10), x)
    return x, x


with jax.enable_x64(True):
    truth = np.asarray(jax.lax.scan(loaded, jnp.zeros(5), (volts, dry))[1])
gains = ([0.7, 0.85, 1.0], [0.3, 0.3, 0.4]), ([0.4, 0.7, 1.0], [0.2, 0.3, 0.5]), ([0.8, 0.9, 1.0], [0.2, 0.3, 0.5])
*first, last = (hg.hop(hg.Discrete(v, p, 0.02), 0.05**2, dimension=2) for v, p in gains)
links = [hg.amplify_and_forward([link, last]) for link in first]
noise = np.random.default_rng(0).normal(0, 0.05, (2, steps, 2))
sent = {f"relay {i + 1}": hg.simulation.transmit(3.9 * truth[:, :2] + noise[i], links[i], i) for i in range(2)}
sensor = hg.LinearSensor(3.9 * np.eye(2, 5), 0.05**2)
walk, start = np.array([0.05, 0.05, 5e-4, 5e-4, 1.39]) / scale, np.array([0.1, 0.1, 0.01, 0.01, 1.0]) / scale
fig, axes = plt.subplots(2, 2, figsize=(9, 5), sharex=True, sharey="row", layout="constrained")
for (top, bottom), trust, title in zip(axes.T, (1, 10), ("process noise as stated", "a tenth of it"), strict=True):
    plant = hg.Plant(move, np.diag((walk / trust) ** 2), np.zeros(5), np.diag(start**2), None, ["u_alpha", "u_beta"])
    filters = [hg.cubature_filter(plant, sensor, link, hg.filters.ZeroMean()) for link in links]
    nodes = {name: hg.Node(sensor, links[i], {"local": filters[i]}) for i, name in enumerate(sent)}
    network = hg.Network(plant, nodes, {"both": hg.Fusion("local", hg.CovarianceIntersection())})
    record = hg.run(network, sent, volts, truth=truth)
    both, clock = record.estimates["fused"]["both"], step * np.arange(1, steps + 1)
    mean, claimed = scale[4] * both.mean[..., -1].ravel(), scale[4] * np.sqrt(both.covariance[..., -1, -1]).ravel()
    top.plot(clock, mean, "C0", label="both relays")
    top.plot(clock, scale[4] * truth[:, 4], "k", lw=1, label="truth")
    bottom.plot(clock, mean - scale[4] * truth[:, 4], "C0", lw=0.8)
    bottom.fill_between(clock, -2 * claimed, 2 * claimed, color="C0", alpha=0.2, label="twice what is claimed")
    top.set(title=title), bottom.set(xlabel="time (s)", ylim=(-8, 8))
axes[0, 0].set(ylabel="speed (rad/s)"), axes[1, 0].set(ylabel="its error (rad/s)")
axes[0, 0].legend(fontsize=8), axes[1, 0].legend(fontsize=8)
