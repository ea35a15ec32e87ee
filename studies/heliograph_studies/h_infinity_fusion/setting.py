"""Section IV's example as printed, but for v_s, which divides by zero there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import fail
from heliograph_studies import check_fields
from heliograph_studies.h_infinity_fusion.worst_disturbance import Draws

NODES = ("1", "2", "3", "4")
STATES = ("x1", "x2")
INPUTS = ("v", "s", "moving")
PAPER_WEIGHTS = (0.2635, 0.2634, 0.2493, 0.2237)
PAPER_FUSED_LEVEL = 2.5419

Noise = float | hg.Gaussian
Constant = float | hg.model.OverTime  # of growth
Hop = Callable[[int, Noise], hg.random_affine.AbstractRandomAffine]  # of a link 0, 1, 2 and its noise


def dynamics(s: float | jax.Array) -> Callable[[jax.Array], jax.Array]:
    """f at step s."""

    def f(x: jax.Array) -> jax.Array:
        return jnp.stack([0.7 * x[0] * jnp.cos(0.1 * x[1]), 0.7 * x[1] * jnp.sin(s * x[0])])

    return f


@dataclass(frozen=True)
class Setting:
    """The example in the paper's letters.

    growth: a, false for differences of f. sensing, feedthrough: h_i(x) = sensing_i (x1 + x2), D_i. disturbance: B.
    target: M. guesses: first estimates. weight: W. initial: P_0. levels: gamma_i. arrival, powers, noise_gain: of the
    links from sensor to relay, relay to filter and sensor to filter. segments, amplitude, decay, zoom: p, d_0, varsigma
    and Q of the quantizers.
    """

    runs: int = 4_000
    seed: int = 0
    steps: int = 16  # s = 0 ... 15
    growth: float = 0.7
    sensing: tuple[float, ...] = (0.15, 0.2, 0.25, 0.3)
    feedthrough: tuple[float, ...] = (0.3, 0.15, 0.1, 0.25)
    disturbance: tuple[float, ...] = (-0.15, 0.15)
    target: tuple[float, ...] = (0.05, 0.05)
    start: tuple[float, ...] = (2.0, 1.5)
    guesses: tuple[tuple[float, float], ...] = ((1.7, 1.6), (2.1, 1.4), (2.2, 1.7), (1.6, 1.3))
    weight: float = 15.0
    initial: float = 10.0
    levels: tuple[float, ...] = (1.8, 1.7, 1.8, 1.9)
    arrival: tuple[float, ...] = (0.8, 0.75, 0.7)
    powers: tuple[float, ...] = (1.0, 1.0, 2.0)
    noise_gain: tuple[float, ...] = (0.1, 0.1, 0.15)
    segments: int = 40
    amplitude: float = 3.0
    decay: float = 0.6
    zoom: float = 0.1

    def __post_init__(self) -> None:
        check_fields(self, runs=100, steps=8, segments=2)  # with fewer runs a standard error means little
        for name, low, high in (("growth", 0, np.inf), ("weight", 0, np.inf), ("initial", 0, np.inf), ("decay", 0, 1)):
            if not low < getattr(self, name) < high:
                raise fail(name, f"a number between {low:g} and {high:g}", getattr(self, name))

    @property
    def B(self) -> np.ndarray:  # noqa: N802
        """The disturbance's column."""
        return np.array(self.disturbance)[:, None]

    @property
    def M(self) -> np.ndarray:  # noqa: N802
        """What is to be known, as a row."""
        return np.array([self.target])

    @property
    def disturbances(self) -> np.ndarray:
        """v_s; printed with sqrt(s), infinite at s = 0."""
        s = np.arange(self.steps)
        return np.asarray(0.4 * np.cos(0.8 * s) / np.sqrt(s + 1))

    @property
    def channel_noises(self) -> np.ndarray:
        """rho_1, rho_2, rho_3 of every node, (time, 3)."""
        return np.asarray(np.array([0.1, 0.15, 0.2]) / np.sqrt(np.arange(self.steps) + 1)[:, None])

    @property
    def initial_variance(self) -> float:
        """Of the first errors, for filters that need one; the paper has none."""
        return float(np.mean((np.array(self.start) - np.array(self.guesses)) ** 2))

    def output_growth(self, node: int) -> float:
        """b_i."""
        return float(np.sqrt(2) * self.sensing[node])

    def inputs(self) -> np.ndarray:
        """(v, s, moving) of the step into x_k: the plant moves first, so that step 0 leaves x_0 where it is."""
        s = np.arange(self.steps)
        moving = np.minimum(s, 1)
        return np.stack([np.roll(self.disturbances, 1) * moving, np.maximum(s - 1, 0), moving], axis=1)

    def plant(self, disturbed: bool = True, variance: float = 0.0) -> hg.Plant:
        """x+ = f(x, s) + B v; not `disturbed`: what filters believe, v a white noise of this `variance` to them."""
        B = self.B

        def transition(x: jax.Array, u: jax.Array) -> jax.Array:
            following = dynamics(u[1])(x) + (B[:, 0] * u[0] if disturbed else 0.0)
            return jnp.where(u[2] > 0, following, x)

        def noise(u: jax.Array) -> jax.Array:
            return jnp.asarray(u[2] * variance * (B @ B.T))

        spread = np.zeros((2, 2)) if disturbed else self.initial_variance * np.eye(2)
        return hg.Plant(transition, noise, self.start, spread, STATES, INPUTS)

    def sensor(self, node: int, noise: hg.Gaussian | float) -> hg.LinearSensor:
        """y = h_i(x) + noise."""
        return hg.LinearSensor(self.sensing[node] * np.ones((1, 2)), noise)

    def disturbed_sensor(self, node: int) -> hg.model.OverTime:
        """y = h_i(x) + D_i v_s, known to nobody."""
        zero, through = np.zeros((1, 1)), self.feedthrough[node]
        return hg.model.over_time([self.sensor(node, hg.Gaussian(zero, [through * v])) for v in self.disturbances])

    def lossy(self, link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
        """sqrt(E) beta y + noise, as printed."""
        return hg.hop(hg.random_affine.bernoulli(self.arrival[link]), noise, power=self.powers[link])

    def lossless(self, link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
        """The same without losses."""
        return hg.hop(1.0, noise, power=self.powers[link])

    def known(self, link: int, noise: Noise) -> hg.random_affine.AbstractRandomAffine:
        """The same, lost as often, and the receiver knows it."""
        return hg.erasure(self.lossless(link, noise), self.arrival[link])

    def channel(self, noises: Sequence[Noise], hop: Hop | None = None) -> hg.random_affine.AbstractRandomAffine:
        """(r, y_2): through the relay and directly, (3) to (5); links that lose unless given."""
        links = [(hop or self.lossy)(link, noise) for link, noise in enumerate(noises)]
        return hg.model.with_direct_link(hg.amplify_and_forward(links[:2]), links[2])

    def disturbed_channel(self, hop: Hop | None = None) -> hg.model.OverTime:
        """With the noises C rho_s of each step, known to nobody."""
        zero, scaled = np.zeros((1, 1)), np.array(self.noise_gain) * self.channel_noises
        return hg.model.over_time([self.channel([hg.Gaussian(zero, [n]) for n in row], hop) for row in scaled])

    def unit_channel(self, hop: Hop | None = None) -> hg.random_affine.AbstractRandomAffine:
        """With noises C rho of unit rho: what designs read."""
        return self.channel([float(c**2) for c in self.noise_gain], hop)

    def white_channel(self, hop: Hop | None = None) -> hg.random_affine.AbstractRandomAffine:
        """With white noises as strong as C rho_s in the mean over the horizon: what Kalman filters believe."""
        powers = np.array(self.noise_gain) ** 2 * np.mean(self.channel_noises**2, axis=0)
        return self.channel([float(p) for p in powers], hop)

    def draws(self, count: int, seed: int) -> Draws:
        """Arrivals of `count` runs as gains, sqrt(E1 E2) b1 b2 y + sqrt(E2) b2 n1 + n2 and sqrt(E3) b3 y + n3."""
        arrived = np.random.default_rng(seed).random((count, self.steps, 3)) < self.arrival
        first, second, direct = np.moveaxis(arrived.astype(float), -1, 0)
        zero, item = np.zeros_like(first), np.ones_like(first)
        c, e = self.noise_gain, np.sqrt(self.powers)
        gain = np.stack([e[0] * e[1] * first * second, e[2] * direct], axis=-1)[..., None]
        relayed = np.stack([e[1] * second * c[0], c[1] * item, zero], axis=-1)
        straight = np.stack([zero, zero, c[2] * item], axis=-1)
        return Draws(gain, np.stack([relayed, straight], axis=-2))

    def system(
        self, node: int, growth: Constant | tuple[Constant, Constant] | None = None, hop: Hop | None = None
    ) -> hg.h_infinity.GrowthSystem:
        """What the design of a node reads; `growth` as in `growth_system`, the paper's unless given."""
        return hg.h_infinity.growth_system(
            self.steps, self.B, [[self.feedthrough[node]]], self.M, self.unit_channel(hop),
            self.growth if growth is None else growth, self.output_growth(node), initial_weight=self.weight,
        )  # fmt: skip
