"""Measurement updates behind an uncertain channel: the gain that minimises a bound on the error covariance.

Notation inside: e is the prior error with covariance P, y = yhat + e_y the sensor's signal, z = G y + n the
measurement, M = E[G] by the nominal law, and D_v = E_v[G] - M the shift of the mean gain under another possible law v.
A "claim" says what a covariance is: exact, an upper bound of the errors' covariance, or nominal (what approximations
say).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian, from_covariance
from heliograph.filters.gaussian.signal_moments import ArrivedInnovation, Signal, condition_on_received
from heliograph.filters.gaussian.uncertain_channel_bounds import (
    Scalars,
    condition_by_young_bound,
    condition_by_zero_mean_bound,
    keep_where_unchanged,
    scalars_as_array,
    scalars_from_array,
)
from heliograph.model.estimate import Claim
from heliograph.numerics.check import array, fail
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Discrete
from heliograph.random_affine.moments.moment_tensors import symmetric_product
from heliograph.random_affine.moments.second_moment_map import QuadraticMap
from heliograph.random_affine.moments.second_moments import (
    SecondOrder,
    describe_second_moments,
    nominal_covariance,
    second_order,
)


@readable
class AbstractUpdate(Module):
    """Rule for bounding the effect of a channel's uncertainty, with the gain that minimises the bound."""

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Return the moments of z = G y + n that the update works by: called once, before any data.

        They are E G, and bounds of second moments of G and n over all laws that the channel's uncertain probabilities
        allow (a polytope).
        """
        return second_order(channel)

    def described(self) -> "AbstractUpdate":
        """Return the rule that corrects with an already described channel: this one, unless another corrects alike.

        `Interval` differs from `Polytope` only in `describe`, and returns a `Polytope` here. So filters with the same
        correction share one compiled program.
        """
        return self

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the gain K (n, m), and the bound (n, n) of the error covariance after the update.

        The update is linear in the innovation z - E z of what was received, z = G y + n, where the law of the channel
        (G, n) is known only within bounds. A rule of your own defines this or `condition` (which returns the
        posterior); each follows from the other. The library's rules define `condition`. Columns of K are zero for
        components that did not arrive.

        Args:
            prior: covariance (n, n) of the state before the update, `signal.prior`.
            signal: moments of the sensor's signal y: `mean`, `covariance`, `cross` = Cov(x, y), `second` = E[y y'].
            channel: moments of the channel, which `describe` returned: nominal mean, and bounds of second moments.
            present: which components of z arrived (m,).
        """
        # Neither is defined.
        if type(self).condition is AbstractUpdate.condition:
            raise unwritten(self, "correct")

        def update(innovation: jax.Array) -> tuple[jax.Array, Gaussian]:
            """Return the mean after an update with this innovation z - E z (m,), and the posterior."""
            z = ArrivedInnovation(innovation, present)
            nominal, _ = condition_on_received(signal, channel, z)  # the Kalman update by the nominal law
            after = self.condition(signal, channel, z, nominal)
            return jnp.asarray(after.mean), after

        # The mean is linear in the innovation, and its derivative is the gain.
        gain, after = jax.jacfwd(update, has_aux=True)(jnp.zeros(len(present)))
        return gain, jnp.asarray(after.covariance)

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Condition `signal.prior` on z - E z, with the gain and the covariance bound of `correct`.

        Args:
            signal: moments of the sensor's signal.
            channel: what `describe` returned.
            z: innovation z - E z, and which components of z arrived.
            nominal: the prior conditioned by the nominal law, the best update if that law is known to be true.
        """
        prior = signal.prior
        # `bound` is an upper bound of the error's covariance with this gain.
        gain, bound = self.correct(prior.covariance, signal, channel, z.present)
        mean = prior.mean + gain @ jnp.where(z.present, z.innovation, 0.0)
        after = from_covariance(mean, bound)
        return keep_where_unchanged(jnp.any(z.present), after, prior)

    def claim(self, uncertain: bool) -> Claim:
        """Return what the covariance after this update is: "exact", "upper" (a bound) or "nominal" (approximate).

        It is said for a filter in which all else is exact. A rule that does not say more is nominal.

        Args:
            uncertain: whether the channel's probabilities are known only up to a radius; else its law is known.
        """
        return "nominal"


class Polytope(AbstractUpdate):
    """Bound by Young's inequality over the exact worst case of the uncertain probabilities.

    e+ = e - K M e_y - K D_v y - K (zero mean given y) and, for every beta_1, beta_2 > 0,

    E[e+ e+'] <= (1 + beta_1) P - K M Pyx - (.)' + K Omega K', with
    Omega = spread(Y) + (1/beta_1 + 1/beta_2) shift(Y) + (1 + beta_2) M Pyy M'.

    No assumption on E[e y'] beyond Pxy. Where the law is known shift = 0, both scalars are 0 and the bound is the
    covariance itself.

    Args:
        scalars: beta_1 and beta_2; None, the default, minimises the trace over them at each step.

    Source: cubature fusion under amplify-and-forward relays, Theorems 1 and 2, with the worst cases taken exactly.
    """

    scalars: np.ndarray

    def __init__(self, scalars: Scalars | None = None):
        """Hold Young's scalars (beta_1, beta_2); None minimises the bound's trace over them at each step."""
        self.scalars = scalars_as_array(scalars)

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Return `nominal` behind a known law; else minimise the trace over K, and over the scalars unless fixed."""
        return condition_by_young_bound(signal, channel, z, self.scalars) if channel.uncertain else nominal

    def claim(self, uncertain: bool) -> Claim:
        """Return "upper" where the law is uncertain, else "exact"."""
        return "upper" if uncertain else "exact"


class ZeroMean(AbstractUpdate):
    """Tighter value that assumes E[e | data] = 0, hence E[e yhat'] = 0; it is no bound where that is not so.

    Then only e_y, not all of y, is correlated with e:

    E[e+ e+'] <= P + beta Pxy Pyy^-1 Pyx - K M Pyx - (.)' + K Omega K',
    Omega = power(Pyy) + shift(Pyy) / beta + spread(yhat yhat').

    The assumption holds only before the first correction: if the true law is not the nominal one, the estimate is
    biased given the data from then on. So with uncertain probabilities the claim is "nominal"; errors of four times the
    value were found.

    Args:
        scalar: beta > 0; None, the default, minimises the trace over beta at each step.

    Raises:
        ValueError: a scalar that is not positive.
    """

    scalar: np.ndarray

    def __init__(self, scalar: float | None = None):
        """Keep beta, the positive scalar of the bound; with None, stored as NaN, each step takes the best one."""
        self.scalar = np.full(1, np.nan) if scalar is None else array("scalar of the bound", [scalar], (1,))
        if np.any(self.scalar <= 0):
            raise fail("scalar of the bound", "a positive number", scalar)

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Return `nominal` behind a known law; else minimise the trace over K, and over beta unless it is fixed."""
        return condition_by_zero_mean_bound(signal, channel, z, self.scalar) if channel.uncertain else nominal

    def claim(self, uncertain: bool) -> Claim:
        """Return "nominal" where the law is uncertain, since E[e | data] is not 0 after a correction; else "exact"."""
        return "nominal" if uncertain else "exact"


class Interval(AbstractUpdate):
    """Young's bound with each hop's uncertainty as intervals of its moments, combined hop by hop.

    A hop's gain g has values v_i with probabilities that are known within radius_i. With m = E g, s = E g^2 by the
    nominal law, r = sum |v_i| radius_i and q = sum v_i^2 radius_i, var g <= s + q - max(|m| - r, 0)^2. An upper bound
    like `Polytope`, but looser, and for chains of scalar hops only.

    Args:
        scalars: beta_1 and beta_2 as in `Polytope`; None, the default, minimises the trace over them at each step.

    Source: cubature fusion under amplify-and-forward relays, equation (11), with the sign of its last term corrected.
    """

    scalars: np.ndarray

    def __init__(self, scalars: Scalars | None = None):
        """Hold Young's scalars (beta_1, beta_2); None minimises the bound's trace over them at each step."""
        self.scalars = scalars_as_array(scalars)

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """Return bounds of the second moments of the chain's gain, from the intervals of each hop's moments.

        Raises:
            ValueError: a channel that is not a chain of scalar hops.
        """

        def find_greatest_variance(hop: HopRange) -> float:
            """Return the greatest variance of a hop's gain: largest E g^2 less the square of the smallest |E g|."""
            smallest_mean = max(abs(hop.mean) - hop.mean_radius, 0.0)
            return hop.largest_second - smallest_mean**2

        return combine_hop_ranges(channel, find_greatest_variance)

    def described(self) -> AbstractUpdate:
        """Return `Polytope` with these scalars: with the described channel both correct alike."""
        return Polytope(scalars_from_array(self.scalars))

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Return `nominal` behind a known law; else minimise the trace over K, and over the scalars unless fixed."""
        return condition_by_young_bound(signal, channel, z, self.scalars) if channel.uncertain else nominal

    def claim(self, uncertain: bool) -> Claim:
        """Return "upper" where the law is uncertain, else "exact"."""
        return "upper" if uncertain else "exact"


class HopRange(NamedTuple):
    """Moments of one hop z = a g y + n of a chain, where the law of its random gain g is only known within bounds.

    `amplitude` is a, `mean` E g by the nominal law, `mean_radius` the largest distance of E g from it, `largest_second`
    the largest E g^2, and `noise` Cov n (m, m).
    """

    amplitude: float
    mean: float
    mean_radius: float
    largest_second: float
    noise: np.ndarray


def _describe_hop(hop: AbstractRandomAffine) -> HopRange:
    """Return the range of one hop's moments; raise if it is not one gain for all components, with zero-mean noise.

    The gain g has values v_i with probabilities p_i, each known within r_i.
    """
    if not isinstance(hop, GainAndNoise) or not _is_multiple_of_identity(hop.matrix) or np.any(hop.noise.mean):
        raise fail("interval bound", "a chain of hops, each one gain for all components and zero-mean noise", hop)
    # Probabilities p_i within r_i: E g within sum |v_i| r_i of its nominal value, E g^2 at most sum v_i^2 r_i above.
    law, mean_radius, second_radius = hop.law, 0.0, 0.0
    if isinstance(law, Discrete):
        mean_radius, second_radius = float(np.abs(law.values) @ law.radius), float(law.values**2 @ law.radius)
    return HopRange(
        amplitude=float(hop.matrix[0, 0]),
        mean=float(law.moment(1)),
        mean_radius=mean_radius,
        largest_second=float(law.moment(2)) + second_radius,
        noise=np.asarray(hop.noise.covariance),
    )


def _is_multiple_of_identity(matrix: jax.Array | np.ndarray) -> bool:
    """Return whether the matrix is a number times the identity: the hop treats all components alike."""
    return matrix.shape[0] == matrix.shape[1] and bool(np.all(matrix == matrix[0, 0] * np.eye(len(matrix))))


def combine_hop_ranges(channel: AbstractRandomAffine, variance: Callable[[HopRange], float]) -> SecondOrder:
    """Return the worst-case second moments of a chain of hops, from the range of possible moments of each hop's gain.

    Each hop multiplies by a g and adds noise of covariance Q: amplitude a, gain g of mean m up to +-r, the largest
    E g^2 being s. From V = 0, S = 1, N = 0, hop after hop: V <- var S + (|m| + r)^2 V bounds the variance of the
    product of the gains g, S <- s S its power E (g_1 g_2 ...)^2, and N <- (a^2 s) N + Q the noise's covariance.

    Args:
        channel: a chain of hops, each one gain for all components and noise of zero mean.
        variance: returns the bound `var` on the variance of a hop's g.
    """
    hops = [_describe_hop(hop) for hop in channel.in_series]
    # V (`spread`), S (`power`) and N (`noise`), hop after hop.
    spread, power, noise = 0.0, 1.0, np.zeros_like(hops[0].noise)
    for hop in hops:
        spread = variance(hop) * power + (abs(hop.mean) + hop.mean_radius) ** 2 * spread
        power *= hop.largest_second
        noise = hop.amplitude**2 * hop.largest_second * noise + hop.noise
    # How far the mean of the product may lie from the nominal one: prod (|m| + r) - prod |m|.
    amplitude = float(np.prod([hop.amplitude for hop in hops]))
    nominal = float(np.prod([abs(hop.mean) for hop in hops]))
    shift = float(np.prod([abs(hop.mean) + hop.mean_radius for hop in hops])) - nominal
    gain = amplitude * float(np.prod([hop.mean for hop in hops])) * np.eye(len(noise))

    def make_map(value: float, constant: np.ndarray) -> QuadraticMap:
        """Return the map Y -> amplitude^2 value E[y y'] + constant, for Y = E[(y, 1)(y, 1)'] and one gain for all of y.

        The map is a tensor: its result is sum_ab center[i, j, a, b] Y[a, b]. The constant multiplies Y's last entry,
        which is 1. `amplitude` is the product of the hops' fixed factors, and `value` a second moment of the gain. y
        has as many components as `noise` has rows.
        """
        center = np.zeros((len(noise), len(noise), len(noise) + 1, len(noise) + 1))
        center[..., :-1, :-1] = amplitude**2 * value * symmetric_product(np.eye(len(noise)), np.eye(len(noise)))
        center[..., -1, -1] = constant
        return QuadraticMap(center, np.zeros_like(center))

    # The gain's deviation from the nominal mean has a mean, at most `shift`, and a variance about it: together
    # the second moment shift^2 + spread, beside that of the noise n. The power E[G y y' G'] is the signal's alone.
    zero = np.zeros_like(noise)
    return describe_second_moments(
        mean=np.concatenate([gain, np.zeros((len(noise), 1))], axis=1),
        spread=make_map(spread + shift**2, noise),
        shift=make_map(shift**2, zero),
        power=make_map(power, zero),
        nominal=nominal_covariance(channel),
        uncertain=shift > 0,
    )
