"""Linear, extended and cubature filters with a factored covariance L D L': the form for single precision.

The spread of a random gain enters as a sum of squares: K_r with E[(H - E H) W (H - E H)'] = sum_r K_r W K_r'.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts, sized
from heliograph.filters.gaussian.factors import (
    Columns,
    Factors,
    columns_of,
    columns_of_known,
    decorrelated,
    factors_of,
    gram_schmidt,
    joined,
    measured,
    reciprocal,
    sum_of,
)
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.transform import Cubature, Function, Linearization
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.linear.linear import LinearFilter
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.premise import believing
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.angle import Angles, continued, nearest, wrapped
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.random_affine.noise import AbstractNoise


def gain_spread(channel: SecondOrder | OverTime) -> np.ndarray | OverTime:
    """Operators K_r (operators, m, p + 1) of z = G y + n, H = [G, n]; one set per step where the channel varies.

    A channel is described by E[(z - E z)(z - E z)' | y] alone, which leaves open how E[dH_ia dH_jb] divides between
    (a, b) and (b, a). Where one of the two is zero because an entry never varies, the other is all; else they are taken
    to be equal. A spread that then is no sum of squares is refused.
    """
    # One set of operators per step, padded with zeros to the same number.
    if isinstance(channel, OverTime):
        parts = [np.asarray(gain_spread(step)) for step in unstack(channel)]
        most = max(len(k) for k in parts)
        return OverTime(np.stack([np.pad(k, [(0, most - len(k)), (0, 0), (0, 0)]) for k in parts]))
    if channel.uncertain:
        raise fail("single precision", "a channel whose probabilities are known", "uncertain ones")
    # Entries of H that vary, and how a pair's moment divides between (a, b) and (b, a).
    tensor = np.asarray(channel.spread.center)
    m, p = tensor.shape[0], tensor.shape[2]
    varies = np.einsum("iiaa->ia", tensor) > 0
    straight = varies[:, None, :, None] & varies[None, :, None, :]  # (i, a) with (j, b)
    crossed = straight.swapaxes(2, 3)
    share = np.where(straight & crossed, 1.0, np.where(straight, 2.0, 0.0))
    same = np.eye(m, dtype=bool)[:, :, None, None] | np.eye(p, dtype=bool)
    # E[vec dH vec dH'] = sum_r vec K_r vec K_r'.
    whole = np.where(same, tensor, share * tensor).transpose(0, 2, 1, 3).reshape(m * p, m * p)
    try:
        root = columns_of_known(whole)
    except ValueError:
        expected = "a channel whose gain varies by a sum of squares (one gain for each output, or for all)"
        raise fail("single precision", expected, "outputs whose gains mix several inputs") from None
    return root.T.reshape(-1, m, p)


class Moments(NamedTuple):
    """A mean (n,) and the factors of its covariance."""

    mean: Float[jax.Array, " n"]
    factors: Factors


class FactoredBelief(NamedTuple):
    """Estimate, and the moments of the state before any data where the gain's spread acts on these (else None)."""

    estimate: Moments
    before_data: Moments | None


class Image(NamedTuple):
    """f(x) of x = m + L xi, Cov xi = diag(d): its mean, its slopes in xi (rows, n), and the part not linear in xi."""

    mean: jax.Array
    slopes: jax.Array
    curvature: list[Columns]


class FactoredFilter(AbstractSizedFilter):
    """A `GaussianFilter` or `LinearFilter` whose covariance is carried as L D L'.

    With y = H x + e and z = G y + n, M = E[G], K_r the operators of the gain's spread, the noise of z given x is the
    sum of squares of M (e, R) and of K_r (y, 1): its factors turn z into components with uncorrelated noises, which are
    used one after another. No covariance is a difference of others. For a cubature rule, the odd part of f at
    m +- sqrt(n) L_j is linear in xi, and the even part is one more noise: so f needs no other update than H x.
    Equal to the base in exact arithmetic, but for what that adds for its rounding. Claim: the base's.
    """

    plant: AnyPlant
    sensor: AnySensor
    mean_gain: Array | OverTime
    offset: Array | OverTime
    spread: Array | OverTime
    initial_mean: Array
    initial_covariance: Array
    cubature: bool = eqx.field(static=True)
    from_prior: bool = eqx.field(static=True)  # the spread acts on the state's moments before data
    random_gain: bool = eqx.field(static=True)
    angles: Angles = eqx.field(static=True)

    @in_float64
    def init(self) -> FactoredBelief:
        """Return the factored belief before any data."""
        root = columns_of(np.asarray(self.initial_covariance))
        start = Moments(jnp.asarray(self.initial_mean), factors_of(joined([root])))
        return FactoredBelief(start, start if self.from_prior else None)

    @predicts
    def predict(self, state: FactoredBelief, u: ArrayLike = (), k: Step = 0) -> FactoredBelief:
        """Mean and factors of f(x, u) + w."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        before_data = None if state.before_data is None else self._moved(plant, state.before_data, u)
        return FactoredBelief(self._moved(plant, state.estimate, u), before_data)

    @corrects
    def correct(self, state: FactoredBelief, z: ArrayLike, k: Step = 0) -> tuple[FactoredBelief, Innovation]:
        """Correct with the components of z that arrived."""
        mean_gain, offset, spread = (at(moment, k) for moment in (self.mean_gain, self.offset, self.spread))
        sensor, (mean, factors) = at(self.sensor, k), state.estimate
        signal = self._signal(sensor, state.estimate)
        # The noise of z given the state: what is not linear, the sensor's, and the spread of the gain.
        of_signal = [*signal.curvature, columns_of(_known(sensor.noise.covariance))]
        noise = [Columns(mean_gain @ columns.matrix, columns.weights) for columns in of_signal]
        noise += self._spread(spread, sensor, state, signal, of_signal)
        # Slopes of z and its innovation, zero rows for what did not arrive.
        expected = mean_gain @ signal.mean + offset
        z = nearest(jnp.asarray(z), expected, self.angles)
        present = ~jnp.isnan(z)
        rows = jnp.concatenate([mean_gain @ signal.slopes, jnp.where(present, z - expected, 0.0)[:, None]], axis=1)
        rows = jnp.where(present[:, None], rows, 0.0)
        # Decorrelate the noises: z is L^-1 z with uncorrelated components.
        masked = joined(noise)
        lower, variances = gram_schmidt(masked._replace(matrix=jnp.where(present[:, None], masked.matrix, 0.0)))
        rows = decorrelated(lower, rows)
        after = _used(mean, factors, rows, jnp.where(present, variances, 1.0))
        # Innovation covariance S = M H L D L' H' M' + noise.
        known = Columns(mean_gain @ signal.slopes, factors.variances)
        total = sum_of(joined([known, masked]))
        return FactoredBelief(after, state.before_data), gaussian_innovation(z, expected, total)

    @estimates
    def estimate(self, state: FactoredBelief) -> Estimate:
        """Mean of the estimate, angles between -pi and pi, and its covariance."""
        mean, factors = state.estimate
        return Estimate(wrapped(mean, first(self.plant).angles), factors.covariance(), self.claim)

    def _moved(self, plant: AbstractPlant, state: Moments, u: jax.Array) -> Moments:
        if isinstance(plant, LinearPlant):
            slopes = plant.transition_matrix(u) @ state.factors.matrix()
            moved = Image(plant.transition(state.mean, u), slopes, [])
        else:
            moved = self._image(plant.moves(u, state.mean), state)
        noise = plant.noise.covariance if isinstance(plant.noise, AbstractNoise) else plant.noise_covariance(u)
        linear = Columns(moved.slopes, state.factors.variances)
        return Moments(
            moved.mean + plant.noise_mean(), factors_of(joined([linear, *moved.curvature, columns_of(_known(noise))]))
        )

    def _signal(self, sensor: AbstractSensor, state: Moments) -> Image:
        if isinstance(sensor, LinearSensor):
            slopes = jnp.asarray(sensor.matrix) @ state.factors.matrix()
            image = Image(sensor.measure(state.mean), slopes, [])
        else:
            angles = first(self.plant).angles
            image = self._image(continued(sensor.measure, state.mean, angles, sensor.angles), state)
        return image._replace(mean=image.mean + sensor.noise.mean)

    def _image(self, function: Function, state: Moments) -> Image:
        return (cubature_image if self.cubature else linear_image)(function, state)

    def _spread(
        self, spread: Array, sensor: AbstractSensor, state: FactoredBelief, signal: Image, of_signal: list[Columns]
    ) -> list[Columns]:
        """Columns of K_r (y, 1), with y of the estimate or of the state before data."""
        corner = np.zeros(spread.shape[-1])
        corner[-1] = 1.0
        if not self.random_gain:
            return [Columns((spread @ corner).T, np.ones(len(spread)))]
        known, image = state.estimate, signal
        if state.before_data is not None:
            known = state.before_data
            image = self._signal(sensor, known)
        y = jnp.concatenate([image.mean, jnp.ones(1)])
        parts = [Columns(image.slopes, known.factors.variances), *of_signal]
        columns = [Columns((spread @ y).T, np.ones(len(spread)))]
        for source in parts:
            columns += [Columns(spread[r, :, :-1] @ source.matrix, source.weights) for r in range(len(spread))]
        return columns


def _known(covariance: Array) -> Array:
    return covariance if isinstance(covariance, jax.Array) else np.asarray(covariance)


def linear_image(function: Function, state: Moments) -> Image:
    """Linearise at the mean with the Jacobian J: slopes J L."""
    return Image(function(state.mean), jax.jacfwd(function)(state.mean) @ state.factors.matrix(), [])


def cubature_image(function: Function, state: Moments) -> Image:
    """Cubature at m +- sqrt(n d_j) L_j: the odd part over sqrt(n d_j) is the slope, the even part a noise."""
    n = len(state.mean)
    steps = jnp.sqrt(n * state.factors.variances)
    offsets = state.factors.matrix() * steps
    both = jnp.concatenate([state.mean[:, None] + offsets, state.mean[:, None] - offsets], axis=1)
    ahead, behind = jnp.split(jax.vmap(function, in_axes=1, out_axes=1)(both), 2, axis=1)
    middle = (ahead + behind) / 2
    mean = jnp.sum(middle, axis=1) / n
    slopes = (ahead - behind) / 2 * jnp.stack([reciprocal(step) for step in steps])
    return Image(mean, slopes, [Columns(middle - mean[:, None], np.full(n, 1 / n))])


def _used(mean: jax.Array, factors: Factors, rows: jax.Array, noise: jax.Array) -> Moments:
    """Update by one component after another: rows (slopes, innovation), whose noises are uncorrelated."""
    n, variances = len(mean), jnp.asarray(factors.variances)
    left, news = jnp.concatenate([factors.matrix(), rows[:, :-1]]), jnp.concatenate([mean, -rows[:, -1]])
    for i in range(len(rows)):
        row = n + i
        left, variances, gain = measured(left, variances, left[row], noise[i])
        news = news - gain * news[row]
    return Moments(news[:n], Factors(left[np.tril_indices(n, -1)], variances))


def factored(base: AbstractFilter) -> AbstractFilter:
    """Return the filter with a factored covariance, whose variances stay positive in single precision."""
    # Only filters whose update is linear in the state, or a cubature of it.
    expected = "a linear, extended or cubature filter, or a schedule of gains"
    if not isinstance(base, GaussianFilter | LinearFilter):
        raise fail("single precision", expected, type(base).__name__)
    plant, sensor = first(base.plant), first(base.sensor)
    linear = isinstance(plant, LinearPlant) and isinstance(sensor, LinearSensor)
    transform = None if isinstance(base, LinearFilter) else base.transform
    if not linear and not isinstance(transform, Cubature | Linearization):
        raise fail("single precision", expected, f"one with {type(transform).__name__}")
    # Operators K_r of the random gain, E[(G - M) Y (G - M)'] = sum_r K_r Y K_r'.
    spread = gain_spread(base.channel)
    operators = spread.values if isinstance(spread, OverTime) else spread
    random_gain = bool(np.any(operators[..., :-1]))
    described = base.channel
    over = isinstance(described, OverTime)
    whole: SecondOrder = described.values if isinstance(described, OverTime) else described
    # A linear filter weighs them by the state's moments before data, a Gaussian one by its estimate.
    by_prior = isinstance(base, LinearFilter)
    filter = FactoredFilter(
        plant=base.plant,
        sensor=base.sensor,
        mean_gain=OverTime(whole.mean_gain) if over else whole.mean_gain,
        offset=OverTime(whole.offset) if over else whole.offset,
        spread=spread,
        initial_mean=plant.initial_mean if isinstance(base, LinearFilter) else base.initial_mean,
        initial_covariance=plant.initial_covariance if isinstance(base, LinearFilter) else base.initial_covariance,
        cubature=isinstance(transform, Cubature),
        from_prior=by_prior and random_gain,
        random_gain=random_gain,
        angles=() if isinstance(base, LinearFilter) else base.observed_angles,
        **sized(base.claim, base, base.received),
    )
    return believing(filter, base.premise)
