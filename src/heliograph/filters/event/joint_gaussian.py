"""Joint Gaussians of state, sender's reference and measurement: predicted, augmented, conditioned on a value."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, below_diagonal, join_columns, rounding_of
from heliograph.factors.factored_gaussian import (
    Gaussian,
    append_rows,
    condition_on_observation,
    from_columns,
    sum_unexplained,
    take_leading,
)
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.event.gaussian_sum import GaussianSum, concatenate_sums, merge_groups
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, find_transition_moments
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import Signal, factor_gain_noise, find_signal_moments
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.linalg import outer


class LinkMoments(NamedTuple):
    """Moments of a link z = G y + n.

    mean: E[(G, n)] (m, p + 1). gain_covariance: at [i, j, a, b] the covariance of G_ia and G_jb, with a last row and
    column for n where gain and noise are correlated (m, m, p + 1, p + 1). noise: columns of Cov n else.
    """

    mean: jax.Array
    gain_covariance: jax.Array
    noise: WeightedColumns

    def select_sender(self, sender: slice, m: int) -> "LinkMoments":
        """Return the moments of the outputs that carry a sender's components `sender` among the m of y.

        A sender of all m components has all outputs. Else each component has a sender and an output of its own.
        """
        rows = slice(None) if sender == slice(0, m) else sender
        noise = WeightedColumns(self.noise.matrix[rows], self.noise.weights)
        return LinkMoments(self.mean[rows], self.gain_covariance[rows, rows], noise)


def augment_by_signal(
    plant: AbstractPlant,
    sensor: AbstractSensor,
    transform: AbstractTransform,
    mixture: GaussianSum,
    initial_power: jax.Array,
) -> GaussianSum:
    """Return each Gaussian of (x, r) as one of (x, r, y), y = h(x) + v, for the sensor h with the noise v.

    x: the plant's state, r: the value that a sender compares with y. `initial_power` (n,): E[x_i^2] before any data,
    the size of numbers that rounding acts on.
    """

    def augment_one(joint: Gaussian) -> Gaussian:
        """Return one Gaussian of (x, r, y) from that of (x, r)."""
        signal = find_signal_moments(plant, sensor, transform, take_leading(joint, len(initial_power)), initial_power)
        return _append_signal(joint, signal)

    return mixture._replace(gaussian=jax.vmap(augment_one)(mixture.gaussian))


def _append_signal(joint: Gaussian, signal: Signal) -> Gaussian:
    """Return the Gaussian of (x, r, y) from that of (x, r), `joint`; the signal y depends on x alone, not on r."""
    length_of_r = len(joint.mean) - signal.slopes.shape[1]
    slopes = jnp.pad(signal.slopes, ((0, 0), (0, length_of_r)))
    noise = triangularise_noise(join_columns(signal.noise, rounding_of(signal.size)))
    return append_rows(joint, signal.mean, slopes, noise)


def predict_with_reference(
    plant: AbstractPlant, transform: AbstractTransform, joint: Gaussian, u: jax.Array, initial_power: jax.Array
) -> Gaussian:
    """Return the Gaussian of (f(x, u) + w, r) from that of (x, r), where r stays as it is.

    r is the value with which a sender compares its signal. `initial_power` (n,) is E[x_i^2] before any data, the size
    of the numbers that are rounded.
    """
    n = len(initial_power)
    length_of_r = len(joint.mean) - n
    image = find_transition_moments(plant, transform, take_leading(joint, n), u)
    noise = sum_unexplained(image, factor_process_noise(plant, u, initial_power))
    # The rows of x become those of f's slopes, and the rows of r stay. Only x has noise.
    slopes = jnp.concatenate([jnp.pad(image.slopes, ((0, 0), (0, length_of_r))), joint.root[n:]])
    noise_of_joint = WeightedColumns(jnp.pad(noise.matrix, ((0, length_of_r), (0, 0))), noise.weights)
    mean = jnp.concatenate([image.mean + plant.noise_mean(), joint.mean[n:]])
    return from_columns(mean, join_columns(WeightedColumns(slopes, joint.variances), noise_of_joint))


def set_known_components(x: Gaussian, indices: np.ndarray, values: jax.Array) -> Gaussian:
    """Return the Gaussian with the components at `indices` replaced by known values, independent of all others.

    The covariance is root diag(variances) root'. A known component gets the row of the identity in the root, and the
    variance 0 in its column.
    """
    root = x.root.at[indices].set(np.eye(len(x.mean))[indices])
    variances = x.variances.at[indices].set(0.0)
    return Gaussian(x.mean.at[indices].set(values), below_diagonal(root), variances)


def condition_parts_on_received(
    mixture: GaussianSum,
    z: jax.Array,
    arrived: jax.Array,
    link: LinkMoments,
    sender: slice,
    m: int,
    delivers: bool,
) -> GaussianSum:
    """Return each Gaussian of (x, r, y) given z = G y + n, its weight multiplied by the density of z.

    An event-triggered sender sends y if it differs enough from its reference r, the value sent last; x is the plant's
    state. The law of (x, r, y) is a sum of weighted Gaussians.

    Args:
        mixture: sum of Gaussians over (x, r, y).
        z: what was received from the sender (received,).
        arrived: which components of z arrived (received,).
        link: mean and covariance of gain G and noise n.
        sender: components of y that the sender sends.
        m: length of y.
        delivers: what arrives is y itself, all of it or nothing, so that y is known afterwards.
    """

    def update_one(x: Gaussian) -> tuple[Gaussian, jax.Array]:
        """Return one Gaussian of (x, r, y) given z, and log of the density of z."""
        return _condition_on_received(x, z, arrived, link, sender, m, delivers)

    # Update all Gaussians at once; by Bayes' rule each weight is multiplied by the density of z under its Gaussian.
    updated, log_density = jax.vmap(update_one)(mixture.gaussian)
    return GaussianSum(mixture.log_weight + log_density, updated, mixture.status)


def _condition_on_received(
    x: Gaussian, z: jax.Array, arrived: jax.Array, link: LinkMoments, sender: slice, m: int, delivers: bool
) -> tuple[Gaussian, jax.Array]:
    """Return one Gaussian `x` of (plant's state, reference r, signal y) given z = G y + n, and the log density of z.

    z is what a sender's message brought, and `arrived` says which of its numbers came. `link` holds the moments of G
    and n, `sender` the components of y (m,) that it sends. If `delivers`, z is y itself.
    """
    expected, slopes, noise = _transform_by_link(x, link.select_sender(sender, m), m)
    after, innovations = condition_on_observation(x, slopes, z - expected, noise, arrived)
    if delivers:  # conditioning has rounded y, which is z to the last digit
        size = len(x.mean)  # y are the last m components
        after = set_known_components(after, np.arange(size - m, size)[sender], jnp.where(arrived, z, 0.0))
    return after, innovations.log_density(arrived, jnp.abs(jnp.where(arrived, z, 0.0)))


def predict_received(x: Gaussian, link: LinkMoments, sender: slice, m: int) -> Gaussian:
    """Return the Gaussian of z = G y + n from each Gaussian of (x, r, y).

    x (K, ...) are K Gaussians of the plant's state, the reference r and the signal y (m,) of the senders. `link` holds
    the moments of G and n, and `sender` the components that are sent.
    """

    def receive_one(x: Gaussian) -> Gaussian:
        """Return the Gaussian of z = G y + n from one Gaussian x of (state, r, y)."""
        expected, slopes, noise = _transform_by_link(x, link.select_sender(sender, m), m)
        return from_columns(expected, join_columns(WeightedColumns(slopes, x.variances), noise))

    received: Gaussian = jax.vmap(receive_one)(x)
    return received


def predict_sent_value(sent: Sequence[GaussianSum], links: Sequence[LinkMoments], sender: slice, m: int) -> Gaussian:
    """Return the one Gaussian, with a leading axis of length 1, of the value z = G y + n that arrives.

    `sent`: for each mode of the link, Gaussians of (x, r, y) given that y is sent, with x the plant's state and r the
    reference; `links`: moments of G and n in each mode; `sender`: the components that are sent of y (m,).
    """
    received_by_mode = []
    for sum_of_mode, link in zip(map(merge_groups, sent), links, strict=True):
        received = predict_received(sum_of_mode.gaussian, link, sender, m)
        received_by_mode.append(GaussianSum(sum_of_mode.log_weight, received, jnp.zeros((1, 1))))
    return merge_groups(concatenate_sums(received_by_mode)).gaussian


def _transform_by_link(x: Gaussian, link: LinkMoments, m: int) -> tuple[jax.Array, jax.Array, WeightedColumns]:
    """Return the mean, the slopes and the noise of z = G y + n, where y are the last m components of x.

    With x = mean + root xi, y = mean_y + slopes_y xi. So z = E[G] mean_y + E n + E[G] slopes_y xi + noise, and the
    noise is (n - E n) + (G - E G) y: a random gain acts like noise with a covariance that depends on E[y y'].
    """
    mean_y, slopes_y = x.mean[-m:], x.root[-m:]
    gain = link.mean[:, :-1]  # E G
    offset = link.mean[:, -1]  # E n
    second_moment = WeightedColumns(slopes_y, x.variances).covariance + outer(mean_y, mean_y)  # E[y y']
    noise = join_columns(link.noise, factor_gain_noise(link.gain_covariance, second_moment, mean_y))
    return gain @ mean_y + offset, gain @ slopes_y, noise
