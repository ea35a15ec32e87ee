"""Second moments of a channel, bounded under every possible law."""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, columns_of
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import block_diagonal, is_traced, library, scatter, stack_parts
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets, check_maps, count_corners
from heliograph.random_affine.moments.gain_and_noise_covariances import (
    make_power_of_constant,
    pad_columns,
    split_off_noise,
)
from heliograph.random_affine.moments.interval_products import CORNERS
from heliograph.random_affine.moments.moment_bounds_of_sum import MomentBounds, bound_sum
from heliograph.random_affine.moments.moment_tensors import (
    Matrix,
    Tensor,
    drop_constant,
    symmetric_product,
)
from heliograph.random_affine.moments.monomials import MEMORY_LIMIT_ENTRIES, JointMoments
from heliograph.random_affine.moments.second_moment_map import (
    QuadraticMap,
    add_maps,
    map_of_known_law,
    place_on_diagonal,
    scale_map,
    signal_of_map,
)
from heliograph.random_affine.moments.uncertain_law_bounds import (
    PROPORTIONAL_TOLERANCE,
    bound_all_laws,
    bound_from_intervals,
    tensors_of_law,
)
from heliograph.random_affine.series_and_stack import Stack
from heliograph.random_affine.sum_of_maps import Superposed


class SecondOrder(Module):
    """Mean and second moments of z = G y + n; where several laws v are possible, bounds that hold for all of them.

    mean_gain, offset: M = E[G] and b = E[n] under the nominal law.
    spread: bound of E_v[((G - M) y + n - b)(...)'], the second moment about the nominal mean.
    shift: bound of ((M_v - M) y + b_v - b)(...)', which the mean under law v adds to it.
    power: bound of E_v[G y y' G'] (the last row and column of W are ignored).
    nominal: the spread under the nominal law itself, gain_covariance : W + Cov n.
    gain_covariance, noise: its two parts. Cov n = B diag(w) B' is kept as B and w, apart from the gain, so that a
        combination of outputs without noise stays without noise. If gain and noise are correlated, gain_covariance
        is all and noise zero.
    uncertain: True if several laws are possible.

    The four bounds take W = E[(y, 1) (y, 1)'] to a matrix (m, m): see `QuadraticMap` (center and radius).

    Shapes: mean_gain (m, p), offset (m,), gain_covariance (m, m, p + 1, p + 1), noise (m, m).
    """

    mean_gain: Matrix
    offset: Float[jax.Array | np.ndarray, " m"]
    spread: QuadraticMap
    shift: QuadraticMap
    power: QuadraticMap
    nominal: QuadraticMap
    gain_covariance: Tensor
    noise: WeightedColumns
    uncertain: bool = eqx.field(static=True)


def describe_second_moments(
    mean: Matrix, spread: QuadraticMap, shift: QuadraticMap, power: QuadraticMap, nominal: QuadraticMap, uncertain: bool
) -> SecondOrder:
    """Return mean and second moments of z = G y + n as a `SecondOrder`; the nominal spread is split in gain and noise.

    Args:
        mean: nominal [M, b] = E[(G, n)] (m, p + 1). The maps below take W = E[(y, 1) (y, 1)'] to a matrix (m, m).
        spread: W to a matrix above E_v[(z - M y - b) (z - M y - b)'] for every possible law v.
        shift: W to a matrix above the same with the mean M_v y + b_v under law v in place of z.
        power: W to a matrix above E_v[G y y' G'].
        nominal: W to the spread under the nominal law, split here in the share of G and the noise Cov n.
        uncertain: True if several laws are possible.
    """
    gain_covariance, noise = split_off_noise(nominal.center, columns_of)
    return SecondOrder(
        mean_gain=mean[:, :-1],
        offset=mean[:, -1],
        spread=spread,
        shift=shift,
        power=power,
        nominal=nominal,
        gain_covariance=gain_covariance,
        noise=noise,
        uncertain=uncertain,
    )


def has_random_gain(channel: AbstractRandomAffine, described: SecondOrder) -> bool:
    """Return whether the gain G of z = G y + n is random or uncertain, and not a known matrix.

    `described` is `second_order(channel)`. A law that JAX traces has no numbers to look at: it counts as random unless
    the channel says that its gain is known.
    """
    if described.uncertain:
        return True
    if is_traced(described.spread):
        return not channel.has_known_gain
    # Covariances of the entries of G with those of (G, n): the last index on this axis, left out, is that of n.
    center = described.spread.center[..., :-1, :]
    radius = described.spread.radius[..., :-1, :]
    size_of_covariances = np.abs(center) + np.abs(radius)
    return bool(np.any(size_of_covariances > 0)) and not channel.has_known_gain


def has_known_mean(described: SecondOrder) -> bool:
    """Return whether E[G] and E[n] of z = G y + n are the same under all possible laws, up to rounding.

    The bound `described.shift` of what other means add is then zero. False if parameters are traced by JAX.
    """
    if is_traced((described.shift, described.mean_gain, described.offset)):
        return False
    largest_gain = np.max(np.abs(described.mean_gain), initial=0.0)
    largest_offset = np.max(np.abs(described.offset), initial=0.0)
    size = largest_gain**2 + largest_offset**2  # the shift of the mean is a second moment, so its size is squared
    largest = max(np.max(np.abs(bound), initial=0.0) for bound in (described.shift.center, described.shift.radius))
    return bool(largest <= PROPORTIONAL_TOLERANCE**2 * size)


@cache_by_object
def second_order(channel: AbstractRandomAffine) -> SecondOrder:
    """Return mean and second moments of z = G y + n, bounded over the polytope of uncertain probabilities.

    G and n are the random gain and noise of the channel. The bounds are exact for a gain common to all components, else
    above. With one scalar gain g, mu its nominal mean and mu_v its mean under law v, the largest E_v (g - mu)^2,
    (mu_v - mu)^2 and E_v g^2 are at extreme laws (corners of the set of laws), since they are convex or multilinear.

    Args:
        channel: one without memory.

    Raises:
        ValueError: more corner laws than can be listed in a channel that is no series or stack, or one that remembers.
    """
    check_maps("channel of a filter", [channel])
    check_forgets("channel of a filter", channel)
    bounds = _bound_moments(channel)
    uncertain = count_corners(channel) != 1
    if uncertain or not channel.has_known_gain:
        return describe_second_moments(*bounds, uncertain)
    # A known gain has Cov G = 0, so the noise of the channel's parts suffices, and no tensor of all outputs is needed.
    return SecondOrder(
        mean_gain=bounds.mean[:, :-1],
        offset=bounds.mean[:, -1],
        spread=bounds.spread,
        shift=bounds.shift,
        power=bounds.power,
        nominal=bounds.nominal,
        gain_covariance=np.zeros(bounds.nominal.center.shape),
        noise=pad_columns(columns_of(_noise_covariance(channel))),
        uncertain=uncertain,
    )


def _bound_moments(channel: AbstractRandomAffine) -> MomentBounds:
    """Return M = E[(G, n)] under the nominal law, and bounds of second moments of z = G y + n under all laws v.

    A bound takes W = E[(y, 1) (y, 1)'] to a matrix that is above
    - the spread E_v[((G, n) - M) W ((G, n) - M)'], the second moment of z about its nominal mean;
    - the shift (M_v - M) W (M_v - M)' with M_v = E_v[(G, n)], the part of the spread that is due to another mean;
    - the power E_v[G y y' G'].
    The bounds are exact if the law is known: then there is one extreme law ("corner").
    """
    corner_count = count_corners(channel)  # None if there are too many to count
    if corner_count == 1:
        return _take_known_moments(channel)
    entries = (channel.inputs + 1) ** 2
    limit = min(CORNERS, MEMORY_LIMIT_ENTRIES // entries)
    can_list_corners = corner_count is not None and corner_count <= limit
    return _bound_uncertain_moments(channel, can_list_corners)


def _take_known_moments(channel: AbstractRandomAffine) -> MomentBounds:
    """Return the moments of z = G y + n of a channel of known law, which are their own bounds.

    With M = E[(G, n)]: `spread`, covariance of the entries of (G, n); `shift`, what other laws' means would add, here
    zero; `power`, E[G W G'] for W = E[y y'], which is the spread of G plus E[G] W E[G]'. Each maps W to a covariance.
    """
    # Maps in a sum or stack are independent. Their covariances give the spread without the channel's large moments.
    if isinstance(channel, Superposed | Stack):
        mean, covariance = _compute_mean_and_covariance(channel)
        spread = map_of_known_law(covariance)
        power_of_mean = map_of_known_law(drop_constant(symmetric_product(mean, mean)))
        return MomentBounds(
            mean=mean,
            spread=spread,
            shift=scale_map(spread, 0.0),  # no law has another mean
            power=add_maps(signal_of_map(spread), power_of_mean),
            nominal=spread,
        )
    moments = channel.moments(2)
    mean = moments.mean[:-1]  # E[(G, n)]: H without its last row (0, 1)
    covariance, shift, power = tensors_of_law(moments, mean)
    spread = map_of_known_law(_drop_known_gain(channel, covariance))
    return MomentBounds(
        mean=mean,
        spread=spread,
        shift=map_of_known_law(shift),
        power=map_of_known_law(power),
        nominal=spread,
    )


def _bound_uncertain_moments(channel: AbstractRandomAffine, can_list_corners: bool) -> MomentBounds:
    """Return the nominal mean of (G, n) of a channel z = G y + n of uncertain law, and bounds over all its laws.

    Bounded are the spread of z about its nominal mean, the shift of the mean, and the power E[G y y' G'].
    `can_list_corners` says whether the extreme laws ("corners") are few enough to be computed one by one.
    """
    if isinstance(channel, Superposed) and not can_list_corners:
        return bound_sum(channel, [_bound_moments(affine) for affine in channel.maps])
    nominal = channel.moments(2)
    mean = nominal.mean[:-1]  # E[(G, n)]: H without its last row (0, 1)
    # Bounds from the blocks of a stack, as maxima over the extreme laws, or from intervals of moments.
    if isinstance(channel, Stack):
        bounds = _bound_stacked_maps(channel)
    elif can_list_corners:
        laws = [JointMoments(matrix, nominal.outputs, nominal.inputs, 2) for matrix in channel.corner_moments(2)]
        # Spreads under all extreme laws, then their shifts, then their powers; each kind is bounded by one map.
        spreads, shifts, powers = zip(*(tensors_of_law(law, mean) for law in laws), strict=True)
        bounds = [bound_all_laws(stack_parts(tensors), mean) for tensors in (spreads, shifts, powers)]
    else:
        bounds = bound_from_intervals(channel, nominal, mean)
    spread, shift, power = bounds
    return MomentBounds(mean=mean, spread=spread, shift=shift, power=power, nominal=nominal_covariance(channel))


def nominal_covariance(channel: AbstractRandomAffine) -> QuadraticMap:
    """Return the map from W = E[(y, 1) (y, 1)'] to the covariance of z = G y + n about E[G] y + E[n], nominal law.

    Its center (m, m, p + 1, p + 1) has at [i, j, a, b] the covariance of entries (i, a) and (j, b) of (G, n), made
    symmetric in a and b.
    """
    moments = channel.moments(2)
    mean = moments.mean[:-1]  # of (G, n)
    covariance, _, _ = tensors_of_law(moments, mean)
    return map_of_known_law(_drop_known_gain(channel, covariance))


def _drop_known_gain(channel: AbstractRandomAffine, spread: Tensor) -> Tensor:
    """Return the covariances `spread` of the entries of (G, n), with exact zeros for the entries of G that are known.

    As differences of moments they have rounding there. `spread` has at [i, j, a, b] that of entries (i, a) and (j, b).
    """
    is_random = ~channel.known_gains
    gain_varies = np.outer(is_random, np.ones(channel.inputs))  # (m, p): 1 for a random entry of G
    varies = np.pad(gain_varies, ((0, 0), (0, 1)), constant_values=1.0)  # and for the noise, which always varies
    without_rounding: Tensor = library(spread).where(symmetric_product(varies, varies) > 0, spread, 0.0)
    return without_rounding


def _bound_stacked_maps(channel: Stack) -> list[QuadraticMap]:
    """Return bounds of spread, shift and power of a stack of independent maps z_i = H_i Y, Y = (y, 1), M_i = E[H_i].

    The spread is E_v[(H_i - M_i) Y Y' (H_j - M_j)'] under any possible law v. It is bounded for each map alone, and for
    different maps, which are independent, it is D_i Y Y' D_j', D_i = E_v[H_i] - M_i, with |D_i| at most the `reach` of
    map i in each entry. A bound has a center, and a radius for each entry.
    """
    mean = channel.moments(1).mean[:-1]  # E[(G, n)]: H without its last row (0, 1)
    spreads = list[QuadraticMap]()
    shifts = list[QuadraticMap]()
    powers = list[QuadraticMap]()
    reaches = []
    start = 0  # first output of the map
    for affine in channel.maps:
        moments, stop = second_order(affine), start + affine.outputs
        for bounds, bound in ((spreads, moments.spread), (shifts, moments.shift), (powers, moments.power)):
            bounds.append(place_on_diagonal(bound, start, channel.outputs))
        reaches.append(_find_reach_of_mean(affine, mean[start:stop]))
        start = stop
    part_of_output = np.repeat(np.arange(len(channel.maps)), [affine.outputs for affine in channel.maps])
    off_diagonal = (part_of_output[:, None] != part_of_output[None, :])[:, :, None, None]
    # Off-diagonal blocks: |D_i Y Y' D_j'| by the product of reaches; of the power (M_i + D_i) Y Y' (M_j + D_j)'.
    xp = library(mean, reaches)
    reach, size = xp.concatenate(reaches), xp.abs(mean)
    cross = symmetric_product(reach, reach)
    power_cross = drop_constant(symmetric_product(size, reach) + symmetric_product(reach, size) + cross)

    def join(blocks: list[QuadraticMap], center: Tensor | float, radius: Tensor) -> QuadraticMap:
        """Return the bound with these diagonal blocks, and with `center` and `radius` in all other entries."""
        return QuadraticMap(
            sum(q.center for q in blocks) + off_diagonal * center, sum(q.radius for q in blocks) + off_diagonal * radius
        )

    power_of_mean = drop_constant(symmetric_product(mean, mean))
    return [join(spreads, 0.0, cross), join(shifts, 0.0, cross), join(powers, power_of_mean, power_cross)]


def _find_reach_of_mean(affine: AbstractRandomAffine, mean: Matrix) -> Matrix:
    """Return the largest |E_v[(G, n)] - M| of each entry under any possible law v; M is the nominal `mean`."""
    low, high = affine.moment_interval(1)
    xp = library(low, high, mean)
    # `low` and `high` are of E[H], whose last row is (0, 1).
    to_high = high[:-1] - mean
    to_low = low[:-1] - mean
    reach: Matrix = xp.maximum(xp.abs(to_high), xp.abs(to_low))
    return reach


def _compute_mean_and_covariance(channel: AbstractRandomAffine) -> tuple[Matrix, Tensor]:
    """Return mean and spread of a map z = G y + n of known law; those of a stack or sum come from its parts.

    The mean is E[(G, n)] (m, p + 1). The spread has at [i, j, a, b] the covariance of entries (i, a) and (j, b).
    """
    if not isinstance(channel, Superposed | Stack):
        moments = channel.moments(2)
        mean = moments.mean[:-1]
        return mean, _drop_known_gain(channel, moments.second - symmetric_product(mean, mean))
    means, spreads = zip(*(_compute_mean_and_covariance(affine) for affine in channel.maps), strict=True)
    if isinstance(channel, Stack):
        return library(means).concatenate(means), _stack_covariances(spreads)
    # In a sum the spreads of the parts and of its own noise add up.
    mean_of_maps = channel.sum_in_places(dict(enumerate(means)), axes=1)
    size = channel.inputs + 1
    noise = channel.noise.covariance[..., None, None] * make_power_of_constant(size)
    spread: Tensor = channel.sum_in_places(dict(enumerate(spreads)), axes=2) + noise
    return mean_of_maps + channel.noise.mean[:, None] * np.eye(size)[-1], spread


def _noise_covariance(channel: AbstractRandomAffine) -> Float[jax.Array | np.ndarray, "m m"]:
    """Return Cov n of a channel z = G y + n whose gain G is known.

    For a stack the covariances of its maps are diagonal blocks, and for a sum they add up, so that no tensor of all
    outputs and inputs is needed.
    """
    covariance: Matrix
    if isinstance(channel, Stack):
        covariance = block_diagonal([_noise_covariance(affine) for affine in channel.maps])
    elif isinstance(channel, Superposed):
        covariance = sum((_noise_covariance(affine) for affine in channel.maps), channel.noise.covariance)
    else:
        covariance = _compute_mean_and_covariance(channel)[1][..., -1, -1]  # the spread's entry at the constant 1
    return covariance


def _stack_covariances(spreads: Sequence[Tensor]) -> Tensor:
    """Return the covariances of the entries of (G, n) of a stack, from those of its independent maps of one y.

    `spreads` has for each map the covariances (m, m, p + 1, p + 1) of its (G, n); they are diagonal blocks.
    """
    outputs_by_map = [len(spread) for spread in spreads]
    size = spreads[0].shape[-1]
    outputs = sum(outputs_by_map)
    # Places of the blocks' entries (i, j) in the flat (outputs, outputs).
    rows_by_map = np.split(np.arange(outputs), np.cumsum(outputs_by_map)[:-1])
    places = np.concatenate([(outputs * rows[:, None] + rows).reshape(-1) for rows in rows_by_map])
    entries = library(spreads).concatenate([spread.reshape(-1, size**2) for spread in spreads])
    stacked: Tensor = scatter((outputs**2, size**2), places, entries).reshape(outputs, outputs, size, size)
    return stacked
