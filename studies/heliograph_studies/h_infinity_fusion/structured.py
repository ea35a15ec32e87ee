"""A second example, of ours, that tells filters apart: a lightly damped rotation received through noisy, lossy relays.

x+ = A x + phi(x) + B v with |eig A| = 0.97 and |phi(x) - phi(xhat)| <= 0.05 |x - xhat|; here measurements matter, and
so does what a filter is designed for.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion.worst_disturbance import Draws, World

STEPS = 40
DAMPING, ANGLE = 0.97, 0.5  # of the rotation: its period is 4 pi steps
ROTATION = DAMPING * np.array([[np.cos(ANGLE), np.sin(ANGLE)], [-np.sin(ANGLE), np.cos(ANGLE)]])
GROWTH = 0.05
DISTURBANCE = np.array([[0.0], [1.0]])
TARGET = np.eye(2)
WEIGHT = 1.0
OUTPUTS = {"1": [[1.0, 0.0]], "2": [[0.0, 1.0]], "3": [[0.7, 0.7]]}
ARRIVAL = (0.95, 0.95, 0.9)
NOISE_GAIN = (3.0, 3.0, 9.0)
INPUTS = ("v", "moving", "white")
SCENARIOS = ("white", "bias", "resonant")
BOX = 100.0  # half the side of the box over which phi is searched


def slight(x: jax.Array) -> jax.Array:
    """phi: its slope is GROWTH at zero and less elsewhere."""
    return jnp.stack([jnp.zeros_like(x[0]), 10 * GROWTH * jnp.sin(x[0] / 10)])


def dynamics(x: jax.Array, k: object = 0) -> jax.Array:
    """A x + phi(x)."""
    return jnp.asarray(ROTATION @ x + slight(x))


def plant(disturbed: bool = True) -> hg.Plant:
    """The plant; not `disturbed`: what filters believe, v white of variance one."""

    def transition(x: jax.Array, u: jax.Array) -> jax.Array:
        return jnp.where(u[1] > 0, dynamics(x) + (DISTURBANCE[:, 0] * u[0] if disturbed else 0.0), x)

    def noise(u: jax.Array) -> jax.Array:
        return jnp.asarray(u[1] * (u[2] if disturbed else 1.0) * (DISTURBANCE @ DISTURBANCE.T))

    return hg.Plant(transition, noise, np.zeros(2), np.eye(2) / WEIGHT, inputs=INPUTS)


def inputs(scenario: str) -> np.ndarray:
    """(v, moving, white) of each step; v of mean square one whatever it is."""
    k = np.arange(STEPS)
    v = {"white": 0 * k, "bias": 1 + 0 * k, "resonant": np.sqrt(2) * np.sin(ANGLE * k)}[scenario]
    return np.stack([v, np.minimum(k, 1), np.full(STEPS, scenario == "white")], axis=1).astype(float)


def sensor(node: str) -> hg.LinearSensor:
    """y = C_i x."""
    return hg.LinearSensor(OUTPUTS[node], 0.0)


def lossy(link: int) -> hg.random_affine.AbstractRandomAffine:
    """A link that loses without telling."""
    return hg.hop(hg.random_affine.bernoulli(ARRIVAL[link]), NOISE_GAIN[link] ** 2)


def lossless(link: int) -> hg.random_affine.AbstractRandomAffine:
    """The link without losses."""
    return hg.hop(1.0, NOISE_GAIN[link] ** 2)


def known(link: int) -> hg.random_affine.AbstractRandomAffine:
    """A link that loses and tells."""
    return hg.erasure(lossless(link), ARRIVAL[link])


def channel(
    hop: Callable[[int], hg.random_affine.AbstractRandomAffine] = lossy,
) -> hg.random_affine.AbstractRandomAffine:
    """Through a relay and directly."""
    return hg.model.with_direct_link(hg.amplify_and_forward([hop(0), hop(1)]), hop(2))


def system(node: str, structured: bool = True) -> hg.h_infinity.GrowthSystem:
    """What designs read; not `structured`: all of A x + phi(x) known by its growth |A| + |phi| alone."""
    shape = {"growth": GROWTH, "transition": ROTATION} if structured else {"growth": DAMPING + GROWTH}
    return hg.h_infinity.growth_system(
        STEPS, DISTURBANCE, [[0.0]], TARGET, channel(), output=OUTPUTS[node], initial_weight=WEIGHT, **shape
    )


def world(node: str) -> World:
    """The same for a search for the worst disturbance."""
    matrix = np.array(OUTPUTS[node])
    return World(
        dynamics,
        lambda x: jnp.asarray(matrix @ x),
        DISTURBANCE,
        np.zeros((1, 1)),
        TARGET,
        WEIGHT * np.eye(4),
        inputs("bias"),
    )


def draws(count: int, seed: int) -> Draws:
    """Arrivals of `count` runs as gains."""
    return relay_draws(ARRIVAL, NOISE_GAIN, (1.0, 1.0, 1.0), STEPS, count, seed)


def relay_draws(
    arrival: Sequence[float], noise_gain: Sequence[float], powers: Sequence[float], steps: int, count: int, seed: int
) -> Draws:
    """G and N of a scalar relay beside a direct link: sqrt(E1 E2) b1 b2 y + sqrt(E2) b2 n1 + n2, sqrt(E3) b3 y + n3."""
    first, second, direct = (np.random.default_rng(seed).random((count, steps, 3)) < arrival).astype(float).T
    first, second, direct = first.T, second.T, direct.T
    zero, item = np.zeros_like(first), np.ones_like(first)
    c, e = noise_gain, np.sqrt(powers)
    gain = np.stack([e[0] * e[1] * first * second, e[2] * direct], axis=-1)[..., None]
    relayed = np.stack([e[1] * second * c[0], c[1] * item, zero], axis=-1)
    straight = np.stack([zero, zero, c[2] * item], axis=-1)
    return Draws(gain, np.stack([relayed, straight], axis=-2))
