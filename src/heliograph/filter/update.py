"""Measurement updates that know the channel: the gain that minimises a bound on the error covariance, and the bound.

Notation inside: e prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n what arrives,
M = E[G] nominal, D_v = E_v[G] - M the shift under a possible law v.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.check import array, fail
from heliograph.linalg import psd_solve, symmetrize
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Series
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.second_order import QuadraticMap, SecondOrder, second_order, symmetric_product

SWEEPS = 200  # most alternations between gain and scalars; each lowers the jointly convex trace
SETTLED = 1e-8  # relative change of the scalars; the trace is flat there, so its error is of second order
SMALLEST_SCALAR = 1e-12  # keeps 1/beta finite where nothing is gained by a larger one


class Signal(NamedTuple):
    """The sensor's signal as the filter sees it before the measurement.

    mean (m,), covariance (m, m) with sensor noise, cross = E[e e_y'] (n, m), second = E[y y'] (m, m).
    """

    mean: jax.Array
    covariance: jax.Array
    cross: jax.Array
    second: jax.Array


class Scalars(eqx.Module):
    """Fixed positive scalars (beta_1, beta_2) of Young's inequality, as published bounds use them.

    Raises:
        ValueError: a scalar that is not positive.
    """

    values: np.ndarray

    def __init__(self, first: float, second: float):
        self.values = array("scalars of the bound", [first, second], (2,))
        if np.any(self.values <= 0):
            raise fail("scalars of the bound", "two positive numbers", (first, second))


class AbstractUpdate(eqx.Module):
    """How a channel's uncertainty is bounded, and the gain that minimises the bound."""

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """The channel's mean gain and its worst cases, computed once before any data."""
        raise NotImplementedError

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Gain K (n, m) and bound (n, n) after the update; the columns of absent components are zero."""
        raise NotImplementedError


class Polytope(AbstractUpdate):
    """Bound by Young's inequality over the exact worst case of the uncertain probabilities.

    e+ = e - K M e_y - K D_v y - K (zero mean given y) and, for every beta_1, beta_2 > 0,
    E[e+ e+'] <= (1 + beta_1) P - K M Pyx - (.)' + K Omega K', with
    Omega = spread(Y) + (1/beta_1 + 1/beta_2) shift(Y) + (1 + beta_2) M Pyy M'.
    No assumption on E[e y'] beyond Pxy. Where the law is known shift = 0, both scalars are 0 and the bound is the
    covariance itself. `scalars` None: the trace is minimised over them at each step.

    Source: cubature fusion under amplify-and-forward relays, Theorems 1 and 2, with the worst cases taken exactly.
    """

    scalars: Scalars | None = None

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Worst cases over the polytope."""
        return second_order(channel)

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Minimise the trace over K, and over the scalars unless they are fixed."""
        return young_correction(prior, signal, channel, present, self.scalars)


class ZeroMean(AbstractUpdate):
    """A tighter bound that trusts the filter's premise E[e | data] = 0, hence E[e yhat'] = 0.

    Then only e_y, not all of y, is correlated with e:
    E[e+ e+'] <= P + beta Pxy Pyy^-1 Pyx - K M Pyx - (.)' + K Omega K',
    Omega = power(Pyy) + shift(Pyy) / beta + spread(yhat yhat').

    `scalar` None: the trace is minimised over beta at each step.
    """

    scalar: np.ndarray | None

    def __init__(self, scalar: float | None = None):
        self.scalar = None if scalar is None else array("scalar of the bound", scalar, ())
        if self.scalar is not None and self.scalar <= 0:
            raise fail("scalar of the bound", "a positive number", scalar)

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Worst cases over the polytope."""
        return second_order(channel)

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Minimise the trace over K, and over beta unless it is fixed."""
        m = signal.mean.shape[0]
        known_part = homogeneous(signal.second - signal.covariance, signal.mean)
        own = homogeneous(signal.covariance, jnp.zeros(m)).at[m, m].set(0.0)
        base = channel.power(own, present) + channel.spread(known_part, present) + absent(present)
        cross = jnp.where(present[:, None], channel.gain @ signal.cross.T, 0.0)
        if not channel.uncertain:
            return gain_and_bound(prior, cross, base)
        shift = channel.shift(own, present)
        explained = symmetrize(signal.cross @ psd_solve(signal.covariance, signal.cross.T))

        def omega(beta: jax.Array) -> jax.Array:
            return base + shift / beta

        def refine(beta: jax.Array) -> jax.Array:
            k = psd_solve(omega(beta), cross).T
            return jnp.maximum(jnp.sqrt(jnp.trace(k @ shift @ k.T) / jnp.trace(explained)), SMALLEST_SCALAR)

        beta = settle(refine, jnp.asarray(0.1)) if self.scalar is None else jnp.asarray(self.scalar)
        gain, bound = gain_and_bound(prior, cross, omega(beta))
        return gain, bound + beta * explained


class Interval(AbstractUpdate):
    """Young's bound with each hop's uncertainty as intervals of its moments, combined hop by hop.

    With m, s = E g, E g^2 and radii r = sum |v_i| radius_i, q = sum v_i^2 radius_i of each hop:
    var g <= s + q - max(|m| - r, 0)^2. Sound, looser than `Polytope`, and for chains of scalar hops only.

    Source: cubature fusion under amplify-and-forward relays, equation (11), with the sign of its last term corrected.
    """

    scalars: Scalars | None = None

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Worst cases from intervals.

        Raises:
            ValueError: a channel that is not a chain of scalar hops.
        """
        return _interval_description(channel, lambda hop: hop.second - max(abs(hop.mean) - hop.mean_radius, 0.0) ** 2)

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Minimise the trace over K, and over the scalars unless they are fixed."""
        return young_correction(prior, signal, channel, present, self.scalars)


class LooseInterval(AbstractUpdate):
    """`Interval` with the squared mean added where it should be subtracted: var g <= s + q + (m - r)^2.

    As published. A bound still, but of the power of g instead of its variance, so it trusts a good channel too little:
    with a perfect channel it does not become the filter without one.

    Source: cubature fusion under amplify-and-forward relays, equation (11) as printed.
    """

    scalars: Scalars | None = None

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Worst cases from intervals.

        Raises:
            ValueError: a channel that is not a chain of scalar hops.
        """
        return _interval_description(channel, lambda hop: hop.second + (hop.mean - hop.mean_radius) ** 2)

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Minimise the trace over K, and over the scalars unless they are fixed."""
        return young_correction(prior, signal, channel, present, self.scalars)


class _HopRange(NamedTuple):
    """One hop's amplitude, E g with its radius, the largest E g^2, and noise covariance."""

    amplitude: float
    mean: float
    mean_radius: float
    second: float
    noise: np.ndarray


def _hop_range(hop: AbstractRandomAffine) -> _HopRange:
    if not isinstance(hop, GainAndNoise) or not _is_scalar(hop.matrix) or np.any(hop.noise.mean):
        raise fail("interval bound", "a chain of hops, each one gain for all components and zero-mean noise", hop)
    radius, law = (0.0, 0.0), hop.gain
    if isinstance(law, Discrete):
        radius = (float(np.abs(law.values) @ law.radius), float(law.values**2 @ law.radius))
    amplitude = float(hop.matrix[0, 0])
    return _HopRange(amplitude, law.moment(1), radius[0], law.moment(2) + radius[1], hop.noise.covariance)


def _is_scalar(matrix: np.ndarray) -> bool:
    return matrix.shape[0] == matrix.shape[1] and bool(np.all(matrix == matrix[0, 0] * np.eye(len(matrix))))


def _interval_description(channel: AbstractRandomAffine, variance: Callable[[_HopRange], float]) -> SecondOrder:
    """Combine hops: V <- var S + (|m| + r)^2 V for the spread, S <- s S for the power, N <- (a^2 s) N + Q for noise."""
    hops = [_hop_range(hop) for hop in (channel.maps if isinstance(channel, Series) else (channel,))]
    spread, power, noise = 0.0, 1.0, np.zeros_like(hops[0].noise)
    for hop in hops:
        spread = variance(hop) * power + (abs(hop.mean) + hop.mean_radius) ** 2 * spread
        power *= hop.second
        noise = hop.amplitude**2 * hop.second * noise + hop.noise
    amplitude = float(np.prod([hop.amplitude for hop in hops]))
    nominal = float(np.prod([abs(hop.mean) for hop in hops]))
    shift = float(np.prod([abs(hop.mean) + hop.mean_radius for hop in hops])) - nominal
    gain = amplitude * float(np.prod([hop.mean for hop in hops])) * np.eye(len(noise))

    def scaled(value: float, constant: np.ndarray) -> QuadraticMap:
        center = np.zeros((len(noise), len(noise), len(noise) + 1, len(noise) + 1))
        center[..., :-1, :-1] = amplitude**2 * value * symmetric_product(np.eye(len(noise)), np.eye(len(noise)))
        center[..., -1, -1] = constant
        return QuadraticMap(center, np.zeros_like(center))

    zero = np.zeros_like(noise)
    parts = scaled(spread + shift**2, noise), scaled(shift**2, zero), scaled(power, zero)
    return SecondOrder(gain, np.zeros(len(noise)), *parts, shift > 0)


def young_correction(
    prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array, scalars: Scalars | None
) -> tuple[jax.Array, jax.Array]:
    """The update of `Polytope` for any description of the channel."""
    w = homogeneous(signal.second, signal.mean)
    mean_part = jnp.where(present[:, None] & present[None, :], channel.gain @ signal.covariance @ channel.gain.T, 0.0)
    base = channel.spread(w, present) + absent(present)
    cross = jnp.where(present[:, None], channel.gain @ signal.cross.T, 0.0)
    if not channel.uncertain:
        return gain_and_bound(prior, cross, base + mean_part)
    shift = channel.shift(w, present)

    def omega(beta: jax.Array) -> jax.Array:
        return base + (1 / beta[0] + 1 / beta[1]) * shift + (1 + beta[1]) * mean_part

    def refine(beta: jax.Array) -> jax.Array:
        k = psd_solve(omega(beta), cross).T
        moved = jnp.trace(k @ shift @ k.T)
        ratios = jnp.stack([moved / jnp.trace(prior), moved / jnp.trace(k @ mean_part @ k.T)])
        return jnp.maximum(jnp.sqrt(jnp.nan_to_num(ratios, posinf=0.0)), SMALLEST_SCALAR)

    beta = settle(refine, jnp.asarray([0.1, 0.1])) if scalars is None else jnp.asarray(scalars.values)
    gain, bound = gain_and_bound(prior, cross, omega(beta))
    return gain, bound + beta[0] * prior


def settle(refine: Callable[[jax.Array], jax.Array], start: jax.Array) -> jax.Array:
    """Apply `refine` until its values stop changing."""

    def moving(carry: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        beta, previous, sweeps = carry
        return (sweeps < SWEEPS) & jnp.any(jnp.abs(beta - previous) > SETTLED * beta)

    def sweep(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        beta, _, sweeps = carry
        return refine(beta), beta, sweeps + 1

    beta: jax.Array = jax.lax.while_loop(moving, sweep, (refine(start), start, jnp.asarray(1)))[0]
    return beta


def homogeneous(second: jax.Array, mean: jax.Array) -> jax.Array:
    """E[(y, 1)(y, 1)'] from E[y y'] and E[y]."""
    top = jnp.concatenate([second, mean[:, None]], axis=1)
    return jnp.concatenate([top, jnp.append(mean, 1.0)[None, :]], axis=0)


def absent(present: jax.Array) -> jax.Array:
    """Unit variance for components that did not arrive, so that the reduced system keeps its full size."""
    return jnp.diag(jnp.where(present, 0.0, 1.0))


def gain_and_bound(prior: jax.Array, cross: jax.Array, omega: jax.Array) -> tuple[jax.Array, jax.Array]:
    """K = C' Omega^-1 and P - C' Omega^-1 C, which minimise P - K C - C' K' + K Omega K'."""
    gain = psd_solve(omega, cross).T
    return gain, symmetrize(prior - gain @ cross)
