"""Section IV's example as printed, but for v_s, which divides by zero there."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

STEPS = 16  # s = 0 ... 15
NODES = ("1", "2", "3", "4")
STATES = ("x1", "x2")
INPUTS = ("v", "s", "moving")

GROWTH = 0.7  # a, printed; false for differences of f
SENSING = (0.15, 0.2, 0.25, 0.3)  # h_i(x) = SENSING_i (x1 + x2)
FEEDTHROUGH = (0.3, 0.15, 0.1, 0.25)  # D_i
OUTPUT_GROWTH = tuple(np.sqrt(2) * c for c in SENSING)  # b_i
DISTURBANCE = np.array([[-0.15], [0.15]])  # B
WANTED = np.array([[0.05, 0.05]])  # M
START = np.array([2.0, 1.5])
GUESSES = np.array([[1.7, 1.6], [2.1, 1.4], [2.2, 1.7], [1.6, 1.3]])
WEIGHT = 15.0  # W
INITIAL = 10.0  # P_0
LEVELS = (1.8, 1.7, 1.8, 1.9)  # gamma_i

ARRIVAL = (0.8, 0.75, 0.7)  # sensor to relay, relay to filter, sensor to filter
POWERS = (1.0, 1.0, 2.0)  # E_1, E_2, E_3
NOISE_GAIN = (0.1, 0.1, 0.15)  # C_1, C_2, C_3

SEGMENTS, AMPLITUDE, DECAY, ZOOM = 40, 3.0, 0.6, 0.1  # p, d_0, varsigma, Q
PAPER_WEIGHTS = (0.2635, 0.2634, 0.2493, 0.2237)
PAPER_FUSED_LEVEL = 2.5419

_S = np.arange(STEPS)
DISTURBANCES = 0.4 * np.cos(0.8 * _S) / np.sqrt(_S + 1)  # v_s; printed with sqrt(s), infinite at s = 0
CHANNEL_NOISES = np.array([0.1, 0.15, 0.2]) / np.sqrt(_S + 1)[:, None]  # rho_1, rho_2, rho_3 of every node
INITIAL_VARIANCE = float(np.mean((START - GUESSES) ** 2))  # for filters that need one; the paper has none


def dynamics(s: float | jax.Array) -> Callable[[jax.Array], jax.Array]:
    """f at step s."""

    def f(x: jax.Array) -> jax.Array:
        return jnp.stack([0.7 * x[0] * jnp.cos(0.1 * x[1]), 0.7 * x[1] * jnp.sin(s * x[0])])

    return f


def inputs() -> np.ndarray:
    """(v, s, moving) of the step into x_k: the plant moves first, so that step 0 leaves x_0 where it is."""
    moving = np.minimum(_S, 1)
    return np.stack([np.roll(DISTURBANCES, 1) * moving, np.maximum(_S - 1, 0), moving], axis=1)


def plant(disturbed: bool = True, variance: float = 0.0) -> hg.Plant:
    """x+ = f(x, s) + B v; not `disturbed`: what filters believe, v a white noise of this `variance` to them."""

    def transition(x: jax.Array, u: jax.Array) -> jax.Array:
        following = dynamics(u[1])(x) + (DISTURBANCE[:, 0] * u[0] if disturbed else 0.0)
        return jnp.where(u[2] > 0, following, x)

    def noise(u: jax.Array) -> jax.Array:
        return jnp.asarray(u[2] * variance * (DISTURBANCE @ DISTURBANCE.T))

    spread = np.zeros((2, 2)) if disturbed else INITIAL_VARIANCE * np.eye(2)
    return hg.Plant(transition, noise, START, spread, STATES, INPUTS)


def sensor(node: int, noise: hg.Gaussian | float) -> hg.LinearSensor:
    """y = h_i(x) + noise."""
    return hg.LinearSensor(SENSING[node] * np.ones((1, 2)), noise)


def disturbed_sensor(node: int) -> hg.model.OverTime:
    """y = h_i(x) + D_i v_s, known to nobody."""
    return hg.model.over_time(
        [sensor(node, hg.Gaussian(np.zeros((1, 1)), [FEEDTHROUGH[node] * v])) for v in DISTURBANCES]
    )


Noise = float | hg.Gaussian
Constant = float | hg.model.OverTime  # of growth
Hop = Callable[[int, Noise], hg.random_affine.AbstractRandomAffine]  # of a link 0, 1, 2 and its noise


def lossy(link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
    """sqrt(E) beta y + noise, as printed."""
    return hg.hop(hg.random_affine.bernoulli(ARRIVAL[link]), noise, power=POWERS[link])


def lossless(link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
    """The same without losses."""
    return hg.hop(1.0, noise, power=POWERS[link])


def told(link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
    """The same, lost as often, and the receiver is told."""
    return hg.erasure(lossless(link, noise), ARRIVAL[link])


def channel(noises: Sequence[Noise], hop: Hop = lossy) -> hg.random_affine.AbstractRandomAffine:
    """(r, y_2): through the relay and directly, (3) to (5)."""
    links = [hop(link, noise) for link, noise in enumerate(noises)]
    return hg.with_direct_link(hg.amplify_and_forward(links[:2]), links[2])


def disturbed_channel(hop: Hop = lossy) -> hg.model.OverTime:
    """With the noises C rho_s of each step, known to nobody."""
    zero, gain = np.zeros((1, 1)), np.array(NOISE_GAIN)
    return hg.model.over_time([channel([hg.Gaussian(zero, [n]) for n in gain * rho], hop) for rho in CHANNEL_NOISES])


def unit_channel(hop: Hop = lossy) -> hg.random_affine.AbstractRandomAffine:
    """With noises C rho of unit rho: what designs read."""
    return channel([float(c**2) for c in NOISE_GAIN], hop)


def white_channel(hop: Hop = lossy) -> hg.random_affine.AbstractRandomAffine:
    """With white noises as strong as C rho_s in the mean over the horizon: what Kalman filters believe."""
    powers = np.array(NOISE_GAIN) ** 2 * np.mean(CHANNEL_NOISES**2, axis=0)
    return channel([float(p) for p in powers], hop)


def system(
    node: int, growth: Constant | tuple[Constant, Constant] = GROWTH, hop: Hop = lossy
) -> hg.h_infinity.GrowthSystem:
    """What the design of a node reads; `growth` as in `growth_system`."""
    return hg.h_infinity.growth_system(
        STEPS, DISTURBANCE, [[FEEDTHROUGH[node]]], WANTED, unit_channel(hop), growth, OUTPUT_GROWTH[node],
        initial_weight=WEIGHT,
    )  # fmt: skip
