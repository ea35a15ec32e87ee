"""Law of the noise that may hold outliers, as it arrives behind a channel, and the channel without that noise."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.uncertain_channel_updates import Polytope
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at_each_step
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.mixture_components import GaussianBranches
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.random_affine.noises.noise import AbstractNoise, Independent
from heliograph.random_affine.noises.outlier_noise import StudentT

Vector = Float[jax.Array | np.ndarray, " m"]
Matrix = Float[jax.Array | np.ndarray, "m branches"]
REGULAR = 1e-7  # least eigenvalue of a noise's correlations: with less, there is no noise in some combination
TOLERANCE = 1e-12  # of correlations and of gains, that are zero but for rounding


class NoiseBranches(NamedTuple):
    """Noise of each received component as a mixture of Gaussians ("branches"), (m, branches) each.

    log_share: log probability of a branch. mean, variance: its moments. least: its variance without the spread of the
    gain, a lower bound of the innovation's variance.
    """

    log_share: jax.Array
    mean: jax.Array
    variance: jax.Array
    least: jax.Array

    def mean_and_variance(self) -> tuple[jax.Array, jax.Array]:
        """Return mean and variance (m,) of each component's noise, a mixture of Gaussians with shares p_j.

        The mean is sum_j p_j m_j, and the variance sum_j p_j (r_j + (m_j - mean)^2) for branches N(m_j, r_j).
        """
        share = jnp.exp(self.log_share)  # p_j
        mean = jnp.sum(share * self.mean, axis=1)
        second_about_mean = self.variance + (self.mean - mean[:, None]) ** 2
        return mean, jnp.sum(share * second_about_mean, axis=1)


class ReceivedNoise(Module):
    """Noise that may hold outliers in each of m received components: g times one output's noise, plus the last hop's.

    Its law is a mixture of Gaussian branches, (m, branches) each: `log_share` is the log of a branch's probability,
    `mean` and `variance` are those of the output's noise before the random gain g, and `late_mean` and `late_variance`
    are those of the last hop's noise, which is added behind the gain. `output` (m, p) has a 1 at the output whose noise
    the component carries. `gain` is E[g] and `power` E[g^2] (m,). `center` (m,) and `covariance` (m, m) are the moments
    of the noise without outliers, as it arrives. `degrees` (m,): Student's degrees of freedom, NaN of other laws.
    `least_degrees` (m,): the least of all Student noises in the component, infinity without one; up to two degrees
    there is no variance.
    """

    log_share: Matrix
    mean: Matrix
    variance: Matrix
    late_mean: Matrix
    late_variance: Matrix
    output: Float[jax.Array | np.ndarray, "m p"]
    gain: Vector
    power: Vector
    center: Vector
    covariance: Float[jax.Array | np.ndarray, "m m"]
    degrees: Vector
    least_degrees: Vector

    def find_branches(self, sensor_mean: jax.Array) -> NoiseBranches:
        """Return mean and variance of every branch as it arrives, for a sensor's signal of the mean `sensor_mean` (p,).

        Branch j of the output's noise has mean m_j and variance r_j, and y is the output's expected signal. Behind the
        random gain g, g (y + noise) has the mean E[g] (y + m_j) and the variance E[g^2] r_j + Var(g) (y + m_j)^2. The
        filter counts Var(g) y^2 with the signal, so the branch adds E[g] m_j and E[g^2] r_j + Var(g) m_j (m_j + 2 y),
        which may be negative: the sum with Var(g) y^2 is at least E[g^2] r_j. The last hop's noise is added to both.
        """
        gain = self.gain[:, None]
        power = self.power[:, None]
        mean = self.mean
        signal = (self.output @ sensor_mean)[:, None]  # y
        least = power * self.variance + self.late_variance
        # Var(g) m_j (m_j + 2 y), with Var(g) = E[g^2] - E[g]^2.
        squared_gain, twice_signal = gain**2, 2 * signal
        gain_variance = power - squared_gain
        mean_and_signal = mean + twice_signal
        by_gain_variance = gain_variance * mean * mean_and_signal
        return NoiseBranches(
            log_share=jnp.asarray(self.log_share),
            mean=jnp.asarray(gain * mean + self.late_mean),
            variance=jnp.asarray(least + by_gain_variance),
            least=jnp.asarray(least),
        )


def separate_outlier_noise(
    sensor: AnySensor, channel: Channel, independent: bool
) -> tuple[SecondOrder | OverTime, ReceivedNoise | OverTime]:
    """Describe the received z = G y + n by its moments without the last hop's outliers, and by the noise with outliers.

    A robust filter weighs the noise that may hold outliers by its full law, and all else by mean and covariance. The
    noise is that of the sensor and of the channel's last hop, as it arrives at the filter. A channel that varies over
    time gives a description for each step (`OverTime`).

    Args:
        sensor: gives the noise of y.
        channel: gives the random gain G and the noise n.
        independent: whether the components of the noise must be independent, as for a filter that uses them one after
            another.

    Raises:
        ValueError: components of the noise that are correlated or mixed by the channel, no noise that could be weighed.
    """

    def describe_without_outliers(step: AbstractRandomAffine) -> SecondOrder:
        """Return the moments of one step's channel without the last hop's noise, if that may hold outliers."""
        remaining_channel, _ = step.detach_outliers()
        return Polytope().describe(remaining_channel)

    def describe_noise(sensor: AbstractSensor, step: AbstractRandomAffine, moments: SecondOrder) -> ReceivedNoise:
        """Return the noise that may hold outliers at one step, as it arrives."""
        _, last_hop_noise = step.detach_outliers()
        return describe_outlier_noise(sensor.noise, last_hop_noise, moments, independent)

    # Once where sensor and channel are constant, else once for each step.
    moments: SecondOrder | OverTime = at_each_step(describe_without_outliers, channel)
    noise: ReceivedNoise | OverTime = at_each_step(describe_noise, sensor, channel, moments)
    return moments, noise


def describe_outlier_noise(
    sensed: AbstractNoise, late: AbstractNoise | None, plain: SecondOrder, independent: bool
) -> ReceivedNoise:
    """Return the noise that may hold outliers, as it arrives in m received numbers.

    The channel maps the sensor's y to z = G y + n with a random gain G. Each received number may carry the noise of one
    output, g times a mixture of Gaussians with g = G_ia, and that of the last hop. A filter that reweighs outliers
    needs their branches: the Gaussians of the mixtures.

    Args:
        sensed: noise of the sensor's p outputs.
        late: noise of the channel's last hop; None where that has no outliers.
        plain: the channel's first two moments without the noise of the last hop: E[G] (`mean_gain`, (m, p)) and
            E[H_ia H_jb] for H = (G, n) (`power.center[i, j, a, b]`).
        independent: whether correlated components are refused.

    Raises:
        ValueError: components that are correlated where they may not be, or mixed; no noise that could be weighed.
    """
    m, p = plain.mean_gain.shape
    # xp: numpy, or jax.numpy for numbers that are traced.
    rows, xp = np.arange(m), library(plain.power.center, sensed, late)
    squares = xp.stack([xp.diagonal(plain.power.center[i, i]) for i in range(m)])[:, :p]  # E[G_ia^2]
    # Moments of the noise without its outliers, as it arrives: Cov_ij = sum_ab E[G_ia G_jb] R_ab, with the gain G.
    base = sensed.without_outliers()  # R = base.covariance
    covariance = xp.einsum("ijab,ab->ij", plain.power.center[..., :p, :p], base.covariance)
    center = plain.mean_gain @ base.mean
    # Index of the sensor's output whose noise each received number carries, (m,).
    source = _find_noisy_outputs(squares, base.covariance)
    if late is not None:
        last = late.without_outliers()
        covariance, center = covariance + last.covariance, center + last.mean
    _check_weighable(covariance, independent)
    # Gaussian branches of the sensor's noise (m, branches); with a late noise one for each pair of a branch of each.
    log_share, mean, variance = (values[source] for values in sensed.branches())
    late_mean: Array = np.zeros(mean.shape)
    late_variance: Array = late_mean
    if late is not None:
        log_share, mean, variance, late_mean, late_variance = _pair_branches(
            GaussianBranches(log_share, mean, variance), late.branches()
        )
    return ReceivedNoise(
        log_share=log_share, mean=mean, variance=variance, late_mean=late_mean, late_variance=late_variance,
        output=np.eye(p)[source], gain=plain.mean_gain[rows, source], power=squares[rows, source],
        center=center, covariance=covariance, degrees=_student_degrees(sensed, late)[source],
        least_degrees=_find_least_degrees(sensed, late, source),
    )  # fmt: skip


def _find_noisy_outputs(squares: Array, covariance: Array) -> np.ndarray:
    """Return the sensor's output whose noise each received component carries, (m,).

    A channel brings z = G (y + noise) of m components, y of p outputs. A robust filter needs one noise in each
    component. Numbers that are traced by JAX cannot be compared: then component i carries the noise of output i.
    Gains up to TOLERANCE, 1e-12, of the largest one are zero but for rounding.

    Args:
        squares: E[G_ia^2] of the gain of output a in component i (m, p).
        covariance: of the sensor's noise (p, p).

    Raises:
        ValueError: a component that carries the noise of several outputs.
    """
    m, p = squares.shape
    if is_traced(squares, covariance):
        if m != p:
            raise fail("channel with free numbers before a robust filter", f"{p} outputs", m)
        return np.arange(m)
    # noise_variance[i, a] = E[G_ia^2] R_aa; count in each component i the outputs a whose share is more than rounding.
    noise_variance = np.asarray(squares) * np.diag(np.asarray(covariance))
    largest = np.max(noise_variance, axis=1, keepdims=True, initial=0.0)
    output_count = np.count_nonzero(noise_variance > TOLERANCE**2 * largest, axis=1)
    if np.any(output_count > 1):
        expected = "one that brings each received number the noise of one output of the sensor"
        raise fail(
            "channel of a robust filter",
            expected,
            f"{output_count.max()} outputs in number {int(output_count.argmax())}",
        )
    return np.asarray(np.argmax(noise_variance, axis=1))


def _check_weighable(covariance: Array, independent: bool) -> None:
    """Raise ValueError if a received number has no noise, or if components are correlated but must be `independent`.

    Each combination of the numbers must have noise too (correlations of full rank): a filter that weighs components
    differently would otherwise take a wrong combination for the one without noise.
    """
    if is_traced(covariance):
        return
    variance = np.diag(covariance)
    if np.any(variance <= 0):
        expected = "noise of the sensor (or a law with outliers in the last hop) in each received number"
        raise fail("noise of a robust filter", expected, f"variance {variance.min():g}")
    deviation = np.sqrt(variance)  # the product of two large variances may overflow
    correlations = covariance / np.outer(deviation, deviation)
    off = np.abs(correlations - np.eye(len(variance)))
    if independent and np.any(off > TOLERANCE):
        expected = "independent components (Huber, InverseMultiquadric, WoLF and Gate take correlated ones)"
        raise fail("noise of a robust filter", expected, f"a correlation of {off.max():.3g}")
    if (least := np.linalg.eigvalsh(correlations)[0]) < REGULAR:
        expected = "some in each combination of the received numbers"
        raise fail("noise of a robust filter", expected, f"correlations whose least eigenvalue is {least:.3g}")


def _pair_branches(sensed: GaussianBranches, last_hop: GaussianBranches) -> tuple[Array, ...]:
    """Return all pairs of a branch of the sensor and one of the last hop, (m, pairs) each.

    A branch is one Gaussian of a mixture. The results are the log probabilities of the pairs (sums of both branches'
    logs), the means and variances of the sensor's branches, and those of the last hop's.
    """
    xp = library(sensed, last_hop)
    shape = (len(sensed.mean), sensed.mean.shape[1], last_hop.mean.shape[1])

    def repeat(values: Array, axis: int) -> Array:
        """Return values (m, branches) for all pairs, the same along this axis of (m, sensor's, last hop's)."""
        pairs: Array = xp.broadcast_to(xp.expand_dims(values, axis), shape).reshape(shape[0], -1)
        return pairs

    log_share = repeat(sensed.log_share, axis=2) + repeat(last_hop.log_share, axis=1)
    sensed_moments = repeat(sensed.mean, axis=2), repeat(sensed.variance, axis=2)
    return log_share, *sensed_moments, repeat(last_hop.mean, axis=1), repeat(last_hop.variance, axis=1)


def _find_least_degrees(sensed: AbstractNoise, last_hop: AbstractNoise | None, source: np.ndarray) -> Vector:
    """Return the least degrees of freedom of Student's noises in each received number (m,); infinity without any.

    `last_hop` is the noise of the last hop, or None. `source` (m,) is the output whose noise each number carries.
    """
    laws = [_student_degrees(sensed, None)[source], *([] if last_hop is None else [_student_degrees(last_hop, None)])]
    xp = library(laws)
    finite = [xp.where(xp.isnan(degrees), xp.inf, degrees) for degrees in laws]
    least: Vector = xp.min(xp.stack(finite), axis=0)
    return least


def _student_degrees(sensed: AbstractNoise, last_hop: AbstractNoise | None) -> Vector:
    """Return the degrees of freedom of each output's Student noise; NaN where the noise has another law.

    `last_hop` is the noise of the last hop, or None. The sum of both noises would not have Student's law.
    """
    independent_noises = sensed.parts if isinstance(sensed, Independent) else (sensed,)
    values = [
        noise.degrees * np.ones(noise.dimension) if isinstance(noise, StudentT) and last_hop is None
        else np.full(noise.dimension, np.nan)
        for noise in independent_noises
    ]  # fmt: skip
    degrees: Vector = library(values).concatenate(values)
    return degrees
