"""Joint Gaussians of state, sender's reference and measurement: predicted, augmented, conditioned on a value."""

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
from heliograph.filters.event.gaussian_sum import GaussianSum
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, find_transition_moments
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import Signal, factor_gain_noise, find_signal_moments
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.linalg import outer


class LinkMoments(NamedTuple):
    """Moments of z = G y + n: E[(G, n)] (m, p + 1), spread of the gain and noise as in `SecondOrder`."""

    mean: jax.Array
    gain_spread: jax.Array
    noise: WeightedColumns

    def select_sender(self, sender: slice, m: int) -> "LinkMoments":
        """Select the outputs that carry a sender's components: all, unless each component has its own sender.

        `sender`: its components among the m of y; a link of all components at once is not divided.
        """
        rows = slice(None) if sender == slice(0, m) else sender
        noise = WeightedColumns(self.noise.matrix[rows], self.noise.weights)
        return LinkMoments(self.mean[rows], self.gain_spread[rows, rows], noise)


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
    """Return the Gaussian of (x, r, y) from that of (x, r), `joint`: y = slopes x + noise, whatever r is."""
    length_of_r = len(joint.mean) - signal.slopes.shape[1]
    slopes = jnp.pad(signal.slopes, ((0, 0), (0, length_of_r)))
    noise = triangularise_noise(join_columns(signal.noise, rounding_of(signal.size)))
    return append_rows(joint, signal.mean, slopes, noise)


def predict_with_reference(
    plant: AbstractPlant, transform: AbstractTransform, joint: Gaussian, u: jax.Array, initial_power: jax.Array
) -> Gaussian:
    """Return the Gaussian of (f(x, u) + w, r): r stays; `initial_power` (n,) is E[x_i^2] before any data.

    r: the value that a sender compares with its signal. E[x_i^2] sets the size of numbers that rounding acts on.
    """
    n = len(initial_power)
    length_of_r = len(joint.mean) - n
    image = find_transition_moments(plant, transform, take_leading(joint, n), u)
    noise = sum_unexplained(image, factor_process_noise(plant, u, initial_power))
    # Rows of x by the slopes of f, rows of r as they are; noise of x alone.
    slopes = jnp.concatenate([jnp.pad(image.slopes, ((0, 0), (0, length_of_r))), joint.root[n:]])
    noise_of_joint = WeightedColumns(jnp.pad(noise.matrix, ((0, length_of_r), (0, 0))), noise.weights)
    mean = jnp.concatenate([image.mean + plant.noise_mean(), joint.mean[n:]])
    return from_columns(mean, join_columns(WeightedColumns(slopes, joint.variances), noise_of_joint))


def set_known_components(x: Gaussian, indices: np.ndarray, values: jax.Array) -> Gaussian:
    """Return the Gaussian with the components at `indices` replaced by known values, independent of all others.

    With the covariance root diag(variances) root' a known component has a column of its own, of variance 0, and as
    its row of the root that of the identity. The root is made lower triangular again.
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

    Args:
        mixture: the sum over state x, reference r and signal y of the sender.
        z: what was received from the sender.
        arrived: which components of z arrived.
        link: moments of G and n.
        sender: components of y that the sender sends.
        m: length of y.
        delivers: what arrives is y itself, all of it or nothing, so that y is known afterwards.
    """

    def update_one(x: Gaussian) -> tuple[Gaussian, jax.Array]:
        """Return one Gaussian of (x, r, y) given z, and log of the density of z."""
        return _condition_on_received(x, z, arrived, link, sender, m, delivers)

    after, density = jax.vmap(update_one)(mixture.gaussian)
    return GaussianSum(mixture.log_weight + density, after, mixture.label)


def _condition_on_received(
    x: Gaussian, z: jax.Array, arrived: jax.Array, link: LinkMoments, sender: slice, m: int, delivers: bool
) -> tuple[Gaussian, jax.Array]:
    """Return one Gaussian x of (state, r, y) given z = G y + n, and log of the density of z.

    z: what a sender's message brought, of which `arrived` came; `link`: moments of G and n; `sender`: its components
    of y (m,); `delivers`: what arrives is y itself.
    """
    expected, slopes, noise = _transform_by_link(x, link.select_sender(sender, m), m)
    after, innovations = condition_on_observation(x, slopes, z - expected, noise, arrived)
    if delivers:  # y is z, to the last digit
        size = len(x.mean)  # y are the last m components
        after = set_known_components(after, np.arange(size - m, size)[sender], jnp.where(arrived, z, 0.0))
    return after, innovations.log_density(arrived, jnp.abs(jnp.where(arrived, z, 0.0)))


def predict_received(x: Gaussian, link: LinkMoments, sender: slice, m: int) -> Gaussian:
    """Return the Gaussian of z = G y + n from each Gaussian of (x, r, y).

    x: the plant's state, r: the value that the sender compares with its signal y (m,). `link`: moments of G and n;
    `sender`: the components sent.
    """

    def receive_one(x: Gaussian) -> Gaussian:
        """Return the Gaussian of z = G y + n from one Gaussian x of (state, r, y)."""
        expected, slopes, noise = _transform_by_link(x, link.select_sender(sender, m), m)
        return from_columns(expected, join_columns(WeightedColumns(slopes, x.variances), noise))

    received: Gaussian = jax.vmap(receive_one)(x)
    return received


def _transform_by_link(x: Gaussian, link: LinkMoments, m: int) -> tuple[jax.Array, jax.Array, WeightedColumns]:
    """Return E z, the slopes of z in xi and its noise for z = G y + n, y the last m components of x: centre + rows xi.

    The mean gain makes the slopes; the gain's spread about it is noise beside n.
    """
    centre, rows = x.mean[-m:], x.root[-m:]
    gain, offset = link.mean[:, :-1], link.mean[:, -1]  # E G, E n
    second_moment = WeightedColumns(rows, x.variances).covariance + outer(centre, centre)
    noise = join_columns(link.noise, factor_gain_noise(link.gain_spread, second_moment, centre))
    return gain @ centre + offset, gain @ rows, noise
