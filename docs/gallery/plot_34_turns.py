"""
A target that turns, a sensor that gets stuck
=============================================

A vehicle goes straight or turns left or right; its radar works, or repeats the origin for a while. Plant and
sensor have modes, and the interacting multiple model filter (IMM) has their probabilities after each row. The
filter of one law of motion and of a sensor that works goes to the origin whenever the radar does.
"""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import heliograph as hg


def turning_by(rate):
    """Position, heading and speed after a second of a turn with this rate."""

    def move(x, u):
        east, north, heading, speed = x
        return jnp.stack([east + speed * jnp.cos(heading), north + speed * jnp.sin(heading), heading + rate, speed])

    noise, start = np.diag([0.01, 0.01, 1e-4, 1e-3]), np.diag([1.0, 1.0, 0.1, 0.05])
    return hg.Plant(
        move, noise, [20.0, 10.0, 0.0, 1.0], start, ["east", "north", "heading", "speed"], circular=["heading"]
    )


straight = turning_by(0.0)
motion = hg.markov_plant(
    [straight, turning_by(0.2), turning_by(-0.2)],
    [[0.94, 0.03, 0.03], [0.1, 0.9, 0.0], [0.1, 0.0, 0.9]],
    initial=[1.0, 0.0, 0.0],
)
working = hg.Sensor(lambda x: x[:2], 0.2 * np.eye(2), outputs=["east", "north"])
stuck = hg.Sensor(lambda x: 0.0 * x[:2], 0.01 * np.eye(2), outputs=["east", "north"])
radar, link = hg.markov_sensor([working, stuck], [[0.98, 0.02], [0.2, 0.8]], initial=[1.0, 0.0]), hg.perfect(2)
filters = {
    "imm": hg.filters.imm_filter(motion, radar, link),
    "one law": hg.cubature_filter(straight, working, link),
}
network = hg.Network(motion, {"radar": hg.Node(radar, link, filters)})
run = hg.simulate(network, horizon=80, key=4)

fig, (track, modes) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
track.plot(*run.measurements["radar"].T, "x", color="0.6", label="measured")
track.plot(*run.truth[:, :2].T, "k", label="truth")
for name in filters:
    track.plot(*run.estimates["radar"][name].mean[:, :2].T, label=name)
    print(f"{name}: RMS error {np.sqrt(np.mean(run.errors('radar', name)[:, :2] ** 2)):.2f}")
track.set(xlabel="east", ylabel="north", aspect="equal")
track.legend(fontsize=8)
# Probabilities of the six joint modes, the plant's first and slowest.
six = run.estimates["radar"]["imm"].modes.reshape(-1, 3, 2)
frozen = np.all(np.abs(run.measurements["radar"]) < 0.5, axis=1)
modes.fill_between(np.arange(1, 81), 0, 1, where=frozen, step="mid", color="0.9", label="at the origin")
modes.plot(np.arange(1, 81), six[:, 1].sum(axis=1), label="P(left turn)")
modes.plot(np.arange(1, 81), six[:, 2].sum(axis=1), label="P(right turn)")
modes.plot(np.arange(1, 81), six[:, :, 1].sum(axis=1), "k:", label="P(stuck)")
modes.set(xlabel="step", ylim=(0, 1))
_ = modes.legend(fontsize=8)
