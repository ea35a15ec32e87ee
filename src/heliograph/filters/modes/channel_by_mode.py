"""Moments of a channel at one step in each mode of its links, and the modes' transition from the step before."""

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, unstack, vary_over_steps
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import stack_parts
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.gain_and_noise_covariances import join_gain_and_noise, split_off_noise
from heliograph.random_affine.moments.second_moments import nominal_covariance


class ChannelByMode(Module):
    """A channel z = G y + n at one step, mode by mode: E[(G, n) | mode], and the covariance of (G, n) about it.

    transition: of the modes from the step before to this one; radius: bound on the error of each of its entries;
    gain_covariance and noise: as in `SecondOrder`, for each mode.

    Shapes: transition and radius (M, M), mean (M, m, p + 1), gain_covariance (M, m, m, p + 1, p + 1), noise (M, m, m).
    """

    transition: Float[Array, "M M"]
    radius: Float[Array, "M M"]
    mean: Float[Array, "M m p1"]
    gain_covariance: Float[Array, "M m m p1 p1"]
    noise: WeightedColumns

    @property
    def covariance(self) -> Float[Array, "M m m p1 p1"]:
        """Covariances Cov((G, n)_ik, (G, n)_jl | mode) as [mode, i, j, k, l], for z = G y + n."""
        covariance: Array = join_gain_and_noise(self.gain_covariance, self.noise)
        return covariance


def channels_by_mode(channel: Channel, beside: PyTree = ()) -> tuple[Float[Array, " M"], ChannelByMode | OverTime]:
    """Return the law of the modes at the first step, and the channel by mode; links without memory have one mode.

    `beside` holds a plant and a sensor that have modes. Joint modes are of plant, sensor and channel, in this order.
    """
    steps = [joint_modes(step, beside=beside) for step in unstack(channel)]
    steps_before = [steps[0], *steps[:-1]]
    models = [channel_by_mode(step, before) for step, before in zip(steps, steps_before, strict=True)]
    return steps[0].initial, vary_over_steps(models, channel)


def channel_by_mode(step: JointModes, step_before: JointModes) -> ChannelByMode:
    """Return the first two moments of (G, n) in z = G y + n, given each mode of the channel's links at one step.

    A joint mode is a combination of the modes of all links; the joint modes are one Markov chain. Given the mode, G and
    n are random still. Filters of the mode need these moments mode by mode, and the transition to this step.

    Args:
        step: the joint modes; `maps` has for each the random map (G, n) without memory.
        step_before: those of the step before. It holds the transition matrix from that step to this one, and `radius`,
            the largest error of each of its entries where the probabilities are uncertain.
    """
    # E[(G, n)] (m, p + 1): all rows but the last of the mean of [[G, n], [0, 1]].
    means = [affine.moments(1).mean[:-1] for affine in step.maps]
    # Cov(G, n) by the probabilities as given (nominal), split in the covariances of G and columns of Cov n.
    gains, noises = [], []
    for affine in step.maps:
        covariance_of_gain, columns_of_noise = split_off_noise(nominal_covariance(affine).center)
        gains.append(covariance_of_gain)
        noises.append(columns_of_noise)
    noise = WeightedColumns(
        stack_parts([noise.matrix for noise in noises]), stack_parts([noise.weights for noise in noises])
    )
    return ChannelByMode(
        transition=step_before.transition,
        radius=step_before.radius,
        mean=stack_parts(means),
        gain_covariance=stack_parts(gains),
        noise=noise,
    )
