"""
A robot seen by range and bearing
=================================

A station measures how far away a robot is, and in which direction. West of the station the direction
jumps from +180 to -180 degrees. A filter that takes bearings for ordinary numbers reads this jump as a
turn of the whole world and loses the robot. Saying which outputs are angles is enough: ``circular``.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg


def move(x, u):  # place and heading; inputs: distance and turn of each step
    return jnp.stack([x[0] + u[0] * jnp.cos(x[2]), x[1] + u[0] * jnp.sin(x[2]), x[2] + u[1]])


def look(x):
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def described(heading, bearing):
    """The robot and the station's sensor, with the states and outputs that are angles."""
    noise, start = np.diag([0.05, 0.05, 0.01]) ** 2, np.diag([0.5, 0.5, 0.05]) ** 2
    states = ["x", "y", "heading"]
    place = [-12.0, 3.0, -np.pi / 2]
    inputs = ["distance", "turn"]
    plant = hg.Plant(move, noise, place, start, states, inputs, circular=heading)
    outputs = ["range", "bearing"]
    return plant, hg.Sensor(look, np.diag([0.5, 0.05]) ** 2, outputs=outputs, circular=bearing)


link = hg.parallel([hg.hop(1.0, 0.1), hg.hop(1.0, 1e-4)])
lossy = hg.erasure(link, arrival=0.8)  # one packet in five is lost, and the station knows
robot, station = described(["heading"], ["bearing"])
filters = {
    "numbers on a line": hg.cubature_filter(*described([], []), link),
    "angles": hg.cubature_filter(robot, station, link),
}
network = hg.Network(robot, {"station": hg.Node(station, lossy, filters)})
record = hg.monte_carlo(network, 40, runs=32, key=1, inputs=np.tile([0.15, 0.02], (40, 1)))
errors, paths = {}, {}
for name, estimate in record.estimates["station"].items():
    errors[name] = np.hypot(*np.moveaxis(record.errors("station", name)[..., :2], -1, 0))
    paths[name] = estimate.mean
    print(f"{name}: RMS error of the place {np.sqrt(np.mean(errors[name] ** 2)):.2f} m")

# %%
# The run in which numbers on a line did worst:

run = errors["numbers on a line"].mean(axis=1).argmax()
fig, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
for name, path in paths.items():
    ax.plot(path[run, :, 0], path[run, :, 1], ".-", lw=1, label=name)
ax.plot(*record.truth[run, :, :2].T, "k", lw=4, alpha=0.3, label="truth")
ax.plot(0, 0, "k^", label="station")
left = ax.get_xlim()[0]
ax.plot([left, 0], [0, 0], "k:", lw=1)
ax.text(left, 0.1, "here the bearing jumps", fontsize=8)
ax.set(xlabel="x (m)", ylabel="y (m)")
_ = ax.legend(fontsize=8)
