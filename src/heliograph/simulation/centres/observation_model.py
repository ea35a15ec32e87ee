"""Measurement models of nodes, as a fusion sees them: gain, offset and noise of what each node receives."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.signal_moments import augmented_second_moment
from heliograph.fusion.cross_covariance import JointObservation
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at, at_each_step, stack
from heliograph.model.sensor import AnySensor, LinearSensor, without_output_names
from heliograph.numerics.module import Module
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order


class ObservationModel(Module):
    """Measurement models of nodes of one structure, which share neither sensor nor channel: both stacked by node.

    `channel`: moments of the channels where all of it arrives.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime

    def observe(self, mean: jax.Array, covariance: jax.Array, k: jax.Array, size: int) -> JointObservation:
        """Return the nodes' measurement models at step k, with zero rows up to `size` components.

        `mean` (n,) and `covariance` (n, n): of the plant's state, on which the noise of a random gain depends.
        """

        def observe_one(sensor: AnySensor, channel: SecondOrder | OverTime) -> JointObservation:
            """Return the measurement model of one node."""
            return _linearise_observation(at(sensor, k), at(channel, k), mean, covariance)

        gain, offset, noise = eqx.filter_vmap(observe_one, in_axes=(eqx.if_array(0), eqx.if_array(0)))(
            self.sensor, self.channel
        )
        padding = (0, size - offset.shape[-1])
        return JointObservation(
            gain=jnp.pad(gain, ((0, 0), padding, (0, 0))),
            offset=jnp.pad(offset, ((0, 0), padding)),
            noise=jnp.pad(noise, ((0, 0), padding, padding)),
        )


def _linearise_observation(
    sensor: LinearSensor, channel: SecondOrder, mean: jax.Array, covariance: jax.Array
) -> JointObservation:
    """Return M, o and Cov(z - M x) of z = G (C x + v) + n with a random gain G, for a plant with these moments.

    M = E[G] C and o = E[G] E v + E n. Cov(z - M x) = E[G] Cov(v) E[G]' + Cov((G - E G) y + n), with y = C x + v.
    `mean` and `covariance`: of the plant's state x.
    """
    matrix, noise = jnp.asarray(sensor.matrix), jnp.asarray(sensor.noise.covariance)
    signal = matrix @ mean + sensor.noise.mean  # E y, y = C x + v
    # E (y, 1)(y, 1)', from which `evaluate_center` computes Cov((G - E G) y + n).
    second = matrix @ covariance @ matrix.T + noise + jnp.outer(signal, signal)
    signal_moments = augmented_second_moment(second, signal, last=1.0)
    gain = jnp.asarray(channel.mean_gain)
    all_arrive = jnp.ones(len(gain), dtype=bool)
    noise_of_random_gains = channel.nominal.evaluate_center(signal_moments, all_arrive)
    offset = gain @ sensor.noise.mean + channel.offset
    return JointObservation(gain=gain @ matrix, offset=offset, noise=gain @ noise @ gain.T + noise_of_random_gains)


class SeparateObservations(Module):
    """Measurement models of nodes that share nothing.

    Args:
        groups: of the nodes of one structure, stacked; None of nodes that measure nothing.
        order: brings the groups' nodes, one group after another, into the order of the nodes.
        size: length of the longest measurement, to which others are padded.
        counts: number of nodes in each group; needed where one measures nothing.
    """

    groups: tuple[ObservationModel | None, ...]
    order: np.ndarray
    size: int = eqx.field(static=True)
    counts: tuple[int, ...] = eqx.field(static=True, default=())

    def observe(self, mean: jax.Array, covariance: jax.Array, k: jax.Array) -> JointObservation:
        """Return gain (node, m, n), offset (node, m) and noise (node, m, m) of z_i = gain_i x + offset_i + noise_i.

        z_i is what node i of all nodes receives at step k, padded with zeros to m numbers, the length of the longest.
        `mean` (n,) and `covariance` (n, n): of the plant's state x, on which the noise of random gains depends.
        """
        m, n = self.size, len(mean)
        models_by_group = []
        for i, group in enumerate(self.groups):
            if group is None:  # nodes without a sensor, which measure nothing
                nodes = self.counts[i]
                nothing = JointObservation(
                    gain=jnp.zeros((nodes, m, n)), offset=jnp.zeros((nodes, m)), noise=jnp.zeros((nodes, m, m))
                )
                models_by_group.append(nothing)
            else:
                models_by_group.append(group.observe(mean, covariance, k, m))
        # The nodes of all groups, one group after another; then in the order of the nodes.
        gain, offset, noise = (jnp.concatenate(fields)[self.order] for fields in zip(*models_by_group, strict=True))
        return JointObservation(gain, offset, noise)


class SharedObservation(Module):
    """Measurement models of nodes that share a sensor and a channel, of whose outputs each node receives some.

    `rows` (node, size): which outputs of the channel each node receives, -1 beyond its own.
    """

    sensor: AnySensor
    channel: SecondOrder | OverTime
    rows: np.ndarray

    def observe(self, mean: jax.Array, covariance: jax.Array, k: jax.Array) -> JointObservation:
        """Return gain (node, size, n) and offset (node, size) of each node, and the noise's covariance of all.

        The covariance is (node, size, node, size). `mean` and `covariance`: of the plant's state. `self.rows` (node,
        size): the rows of each node in what the shared channel delivers, -1 where a shorter measurement is padded.
        """
        gain, offset, noise = _linearise_observation(at(self.sensor, k), at(self.channel, k), mean, covariance)
        # Add a last row of zeros, which index -1 takes.
        gain, offset = jnp.pad(gain, ((0, 1), (0, 0))), jnp.pad(offset, (0, 1))
        noise = jnp.pad(noise, (0, 1))
        return JointObservation(gain[self.rows], offset[self.rows], noise[self.rows[:, :, None, None], self.rows])


def stack_nodes(sensors: Sequence[AnySensor], channels: Sequence[Channel]) -> ObservationModel:
    """Return the measurement models of nodes of one structure, stacked along a first axis of nodes."""
    return ObservationModel(
        stack([without_output_names(sensor) for sensor in sensors]),
        stack([compute_channel_moments(channel) for channel in channels]),
    )


def compute_channel_moments(channel: Channel) -> SecondOrder | OverTime:
    """Return the second moments of the channel where all of it arrives, for each step where it varies."""
    moments: SecondOrder | OverTime = at_each_step(lambda step: second_order(step.condition_on_arrival()), channel)
    return moments
