"""Moments of the signal that a sensor sends, and conditioning on the measurement that a channel makes of it.

Notation: the prior is x = m + L xi, with uncorrelated xi of variances d. The sensor's signal is y = E y + slopes xi +
v, where v is its noise plus the part of h(x) that is not linear in xi. z = G y + n is the measurement behind a channel,
with M = E[G].
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from heliograph.factors.covariance_factors import (
    WeightedColumns,
    columns_with_derivatives,
    eliminate,
    join_columns,
    rounding_of,
)
from heliograph.factors.factored_gaussian import Gaussian, Innovations, condition_on_observation
from heliograph.factors.pivots import square_root, unit_of
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, linear_image
from heliograph.model.estimate import Innovation
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.angles.angle import Angles, continue_angles, wrap_near
from heliograph.numerics.linalg import contract, diagonal, where
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.trace_settings import keep_for_derivatives, writes_for_derivatives
from heliograph.numerics.types import Array
from heliograph.random_affine.moments.second_moments import SecondOrder

LOST = 100  # eps of its variance: the rounding by elimination of a combination of outputs without a random gain


class ArrivedInnovation(NamedTuple):
    """Innovation z - E z (m,), and which components of z arrived (m,).

    The flags are needed: an innovation may be NaN, by an E z that is no number, though its z arrived.
    """

    innovation: jax.Array
    present: jax.Array


class Signal(NamedTuple):
    """Moments of the sensor's signal y = E y + slopes xi + v under the prior x = m + L xi.

    `mean` is E y (p,), `slopes` are (p, n), and `noise` has the columns of Cov v (p, columns). `second` is E[y y']
    (p, p). `size` (p,) bounds E[y_i^2] of the numbers from which y is computed: their rounding is a share of it.
    """

    prior: Gaussian
    mean: jax.Array
    slopes: jax.Array
    noise: WeightedColumns
    second: jax.Array
    size: jax.Array

    @property
    def covariance(self) -> jax.Array:
        """Cov y = slopes diag(d) slopes' + Cov v (p, p), d the variances of xi in the prior x = m + L xi."""
        return join_columns(WeightedColumns(self.slopes, self.prior.variances), self.noise).covariance

    @property
    def cross(self) -> jax.Array:
        """Cross-covariance Cov(x, y) = L diag(d) slopes' (n, p) of state and signal."""
        return jnp.asarray((self.prior.root * self.prior.variances) @ self.slopes.T)

    def about_mean(self) -> "Signal":
        """Return the moments of y - E y. Gain and covariance behind a known gain depend on these alone, not on data."""
        return self._replace(mean=jnp.zeros_like(self.mean), second=self.covariance)


def find_signal_moments(
    plant: AbstractPlant,
    sensor: AbstractSensor,
    transform: AbstractTransform,
    prior: Gaussian,
    initial_power: jax.Array,
    noise: WeightedColumns | None = None,
) -> Signal:
    """Return the moments of the sensor's signal y = h(x) + v under the prior of x.

    Args:
        plant: the plant, whose states may be angles or attitudes.
        sensor: the sensor, with h and the law of v.
        transform: rule that finds moments of a nonlinear h, such as cubature.
        prior: the law of x = m + L xi, a Gaussian.
        initial_power: E[x_i^2] before any data (n,): the size of the numbers that are rounded.
        noise: columns of Cov v, in place of the sensor's; the mean of v is the sensor's.
    """
    law = sensor.noise
    # h(x) = image.mean + slopes xi + c, c the part that is not linear: `image.explained` is the covariance of slopes
    # xi, and `image.curvature` Cov c, zero for a linear sensor. Angles are continued, so that they do not jump at half
    # a turn.
    if isinstance(sensor, LinearSensor):
        image = linear_image(sensor.matrix, sensor.measure(prior.mean), prior)
    else:
        measure = continue_angles(sensor.measure, prior.mean, plant.angles, sensor.angles)
        image = transform.image(plant.manifold.chart(measure, prior.mean), prior)
    # E y, and the columns of the covariance of c + v, which acts as the noise of the signal.
    mean = image.mean + law.mean
    signal_noise = join_columns(law.columns if noise is None else noise, image.curvature)
    # E[y y'] = Cov y + E y E y'. The size of the numbers bounds their rounding.
    second = join_columns(image.explained, signal_noise).covariance + jnp.outer(mean, mean)
    size = bound_signal_power_at_start(sensor, initial_power) if isinstance(sensor, LinearSensor) else diagonal(second)
    return Signal(prior=prior, mean=mean, slopes=image.slopes, noise=signal_noise, second=second, size=size)


def bound_signal_power_at_start(sensor: LinearSensor, initial_power: jax.Array) -> jax.Array:
    """Return a bound of E[y_i^2] (p,) at the start, for y = H x + v: (|H| sqrt(E[x_i^2]) + |E v|)^2 + Var v.

    `initial_power` (n,) is E[x_i^2] at the start; at later steps these moments, without data, may grow without limit.
    The noise counts without its outliers, since Student's law of at most two degrees of freedom has no variance.
    """
    law = sensor.noise
    size_of_state_terms = lax.abs(jnp.asarray(sensor.matrix)) @ square_root(initial_power)
    bound = size_of_state_terms + lax.abs(jnp.asarray(law.mean))
    power: jax.Array = bound**2 + diagonal(law.without_outliers().covariance)
    return power


def make_received_noise(signal: Signal, channel: SecondOrder) -> WeightedColumns:
    """Return columns of the noise covariance of z given the state, Cov(M v + (G - M) y + n) plus rounding.

    Moments of the gain G are those of its nominal law. The columns of M v and n are made orthogonal, so that a
    combination of components without noise is known to eps. What the random gain adds, E[(G - M) y y' (G - M)'], is
    formed as a matrix and eliminated, which leaves some hundred eps in a combination without a random gain.
    """
    return noise_behind_gain(signal, jnp.asarray(channel.mean_gain), channel.gain_covariance, take_link_noise(channel))


def take_link_noise(channel: SecondOrder) -> WeightedColumns:
    """Return columns W and weights w of Cov n = W diag(w) W' of a channel z = G y + n.

    Where the program is differentiated by parameters of the noise (its law is traced), the columns are found anew, so
    that they have derivatives by them also where a variance is 0.
    """
    if not (writes_for_derivatives() and is_traced(channel.noise)):
        return channel.noise
    # Index -1 is that of the constant 1 in (y, 1), whose factor in z is n.
    of_noise_and_gain = channel.nominal.center[..., -1, -1]
    return columns_with_derivatives(of_noise_and_gain - channel.gain_covariance[..., -1, -1])


def noise_behind_gain(
    signal: Signal, gain: jax.Array, gain_covariance: Array, link: WeightedColumns
) -> WeightedColumns:
    """Return the columns of Cov(M v + (G - M) y + n), the noise of z = G y + n behind the mean gain M.

    v is the noise of the signal y. `gain_covariance` is Cov G, and `link` holds columns of Cov n. `signal.size` bounds
    E[y_i^2], which gives the rounding of M y.
    """
    rounding = rounding_of((lax.abs(gain) @ square_root(signal.size)) ** 2)
    without_gain_noise = keep_for_derivatives(
        triangularise_noise(join_columns(signal.noise.through(gain), link, rounding))
    )
    return join_columns(without_gain_noise, factor_gain_noise(gain_covariance, signal.second, signal.mean))


def factor_gain_noise(gain_covariance: Array, second: jax.Array, mean: jax.Array) -> WeightedColumns:
    """Return columns of E[(G - M) y y' (G - M)'] (m, m), the noise that a random gain G of mean M makes of y.

    Args:
        gain_covariance: Cov of the entries of (G, n), (m, m, p + 1, p + 1): entry [i, j, a, b] is Cov(G_ia, G_jb). The
            last a and b, p, stand for the constant 1 below y, whose factor is the noise n.
        second: E[y y'] (p, p).
        mean: E[y] (p,).
    """
    Y = augmented_second_moment(second, mean, 1.0)  # of (y, 1)
    return factor_covariance(contract(gain_covariance, Y))  # sum_ab Cov(G_ia, G_jb) Y_ab


def factor_covariance(covariance: jax.Array) -> WeightedColumns:
    """Return L and d of a covariance P = L diag(d) L' (m, m) that was computed as a matrix.

    Each d_j is raised to at least LOST (100) eps of P_jj: so large is the rounding of a combination of components that
    has no variance.
    """
    return eliminate(covariance, LOST * unit_of(covariance))


def factor_link_noise(channel: SecondOrder, second: jax.Array, mean: jax.Array) -> WeightedColumns:
    """Return columns of Cov(z given y) = Cov n + E[(G - M) y y' (G - M)'], for z = G y + n.

    To a receiver who knows y, this is the covariance of what the link adds: of its noise n, and of the random gain G
    about its mean M. `second` is E[y y'] (p, p) and `mean` E y (p,). Moments of G are those of its nominal law.
    """
    return join_columns(take_link_noise(channel), factor_gain_noise(channel.gain_covariance, second, mean))


def condition_on_received(signal: Signal, channel: SecondOrder, z: ArrivedInnovation) -> tuple[Gaussian, Innovations]:
    """Condition the prior of x on the components of z = G y + n that arrived, G by its nominal law.

    `signal` has the moments of y and the prior of x, `channel` those of G and n, and `z` the innovation z - E z.
    """
    slopes = jnp.asarray(channel.mean_gain) @ signal.slopes
    return condition_on_observation(signal.prior, slopes, z.innovation, make_received_noise(signal, channel), z.present)


def condition_on_measurement(
    x: Gaussian, slopes: jax.Array, noise: WeightedColumns, z: jax.Array, expected: jax.Array, angles: Angles = ()
) -> tuple[Gaussian, Innovation]:
    """Condition x = m + L xi on the linear measurement z = expected + slopes xi + noise: Kalman's update.

    Args:
        x: the prior.
        slopes: of z in xi (m, n): H L for z = H x + noise.
        noise: columns of the noise's covariance.
        z: measurement (m,), NaN where a component did not arrive.
        expected: E z (m,).
        angles: components of z that are angles; they are taken within half a turn of what was expected.

    Returns:
        The posterior, and the innovation z - E z with its covariance (NaN in rows and columns of missing components)
        and its Gaussian log-likelihood.
    """
    present = ~jnp.isnan(z)
    z = wrap_near(z, expected, angles)
    value = z - expected
    after, innovations = condition_on_observation(x, slopes, value, noise, present)
    covariance = join_columns(WeightedColumns(slopes, x.variances), noise).covariance
    log_likelihood = innovations.log_density(present, lax.abs(z) + lax.abs(expected))
    covariance = where(present[:, None] & present, covariance, jnp.nan)
    return after, Innovation(value, covariance, log_likelihood)


def innovation_covariance(signal: Signal, channel: SecondOrder) -> jax.Array:
    """Return Cov z = M Cov(y) M' + E[((G - M) y + n - b)(...)'] under the nominal law (m, m).

    z = G y + n of a channel with M = E G and b = E n; y is the sensor's signal.
    """
    slopes = jnp.asarray(channel.mean_gain) @ signal.slopes
    of_state = WeightedColumns(slopes, signal.prior.variances)
    return join_columns(of_state, make_received_noise(signal, channel)).covariance


def augmented_second_moment(second: jax.Array, mean: jax.Array, last: float) -> jax.Array:
    """Return E[(y, 1)(y, 1)'] (p + 1, p + 1) from E[y y'] (p, p) and E[y] (p,).

    Moments of a channel z = G y + n are maps of this matrix: the 1 is multiplied by n. Its last entry E[1] is `last`:
    1, or 0 where the noise n is counted elsewhere.
    """
    top = jnp.concatenate([second, mean[:, None]], axis=1)
    bottom = jnp.concatenate([mean, jnp.full(1, last, mean.dtype)])
    return jnp.concatenate([top, bottom[None]])
