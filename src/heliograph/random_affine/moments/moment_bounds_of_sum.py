"""Bounds of the second moments of a sum of independent maps under every possible law, from those of its maps."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from heliograph.numerics.numpy_or_jax import is_zero, library
from heliograph.random_affine.moments.gain_and_noise_covariances import make_power_of_constant
from heliograph.random_affine.moments.moment_tensors import Matrix, drop_constant, symmetric_product
from heliograph.random_affine.moments.second_moment_map import (
    QuadraticMap,
    add_maps,
    map_of_known_law,
    scale_map,
    signal_of_map,
    size_of_map,
)
from heliograph.random_affine.sum_of_maps import Superposed


class MomentBounds(NamedTuple):
    """Moments of z = G y + n, bounded over all possible laws; `SecondOrder` says what each bound is of.

    mean: nominal E[(G, n)] (m, p + 1). spread, shift, power: the bounds. nominal: the spread under the nominal law.
    """

    mean: Matrix
    spread: QuadraticMap
    shift: QuadraticMap
    power: QuadraticMap
    nominal: QuadraticMap


def bound_sum(channel: Superposed, parts: Sequence[MomentBounds]) -> MomentBounds:
    """Return bounds of the second moments of z = sum_i H_i Y + n, Y = (y, 1), from the bounds `parts` of each map H_i.

    `SecondOrder` defines spread, shift and power. The maps are independent, but D_i = E_v[H_i] - E[H_i], the shift of a
    mean from the nominal law to law v, adds cross products D_i W D_j', W = E[Y Y']. With weights w_i > 0 of sum 1
    - the shift of the sum is (sum_i D_i) W (sum_i D_i)' <= sum_i D_i W D_i' / w_i;
    - its spread is at most Cov n + sum_i Spread_i + (1 / w_i - 1) D_i W D_i'.
    The w_i are in proportion to the sizes of the D_i W D_i'.
    """
    every = range(len(parts))  # numbers i of the maps
    mean, noise = _sum_means_and_noise(channel, [bounds.mean for bounds in parts])
    power_of_mean = map_of_known_law(drop_constant(symmetric_product(mean, mean)))  # M y y' M'
    spread = add_maps(_sum_maps(channel, {i: (parts[i].spread, 1.0) for i in every}), noise)
    sizes = [size_of_map(bounds.shift) for bounds in parts]
    total = sum(sizes)
    if is_zero(total):  # the means are the same under all laws, D_i = 0: spreads add up
        return MomentBounds(
            mean=mean,
            spread=spread,
            shift=scale_map(noise, 0.0),
            power=add_maps(signal_of_map(spread), power_of_mean),
            nominal=spread,
        )
    inverse_weights = {i: total / sizes[i] for i in every if not is_zero(sizes[i])}  # 1 / w_i, where D_i is not 0
    shift = _sum_maps(channel, {i: (parts[i].shift, inverse) for i, inverse in inverse_weights.items()})
    cross = _sum_maps(channel, {i: (parts[i].shift, inverse - 1) for i, inverse in inverse_weights.items()})
    # Power E_v[G y y' G']: the variance, and that of the mean m shifted by d, for which
    # (m + d)^2 <= (1 + d / m) m^2 + (1 + m / d) d^2.
    mean_size = size_of_map(power_of_mean)
    ratio = total / library(mean_size).where(mean_size > 0, mean_size, 1.0)  # d / m
    widened_mean = scale_map(power_of_mean, 1 + ratio)
    widened_shift = scale_map(signal_of_map(shift), 1 + 1 / ratio)
    return MomentBounds(
        mean=mean,
        spread=add_maps(spread, cross),
        shift=shift,
        power=add_maps(signal_of_map(spread), widened_mean, widened_shift),
        nominal=add_maps(_sum_maps(channel, {i: (parts[i].nominal, 1.0) for i in every}), noise),
    )


def _sum_means_and_noise(channel: Superposed, means: Sequence[Matrix]) -> tuple[Matrix, QuadraticMap]:
    """Return the nominal mean E[(G, n)] of a sum of maps and a noise, and Cov n as a map of E[(y, 1) (y, 1)'].

    `means` has E[H_i] of each map. The noise stands at the constant 1, in the last column of (G, n).
    """
    size = channel.inputs + 1
    mean_of_maps = channel.sum_in_places(dict(enumerate(means)), axes=1)
    noise = map_of_known_law(channel.noise.covariance[..., None, None] * make_power_of_constant(size))
    return mean_of_maps + channel.noise.mean[:, None] * np.eye(size)[-1], noise


def _sum_maps(channel: Superposed, weighted: Mapping[int, tuple[QuadraticMap, Any]]) -> QuadraticMap:
    """Return sum_i w_i Q_i, the second-moment maps Q_i of some of the summands z_i = H_i (y_i, 1) of a channel.

    `weighted` holds (Q_i, w_i) by the summand's number i. Q_i acts on E[(y_i, 1) (y_i, 1)'] of the components y_i of y
    that summand i takes. The sum acts on E[(y, 1) (y, 1)'], with the entries of each Q_i at these components.
    """
    scaled = {i: scale_map(moment_map, weight) for i, (moment_map, weight) in weighted.items()}
    centers = {i: moment_map.center for i, moment_map in scaled.items()}
    radii = {i: moment_map.radius for i, moment_map in scaled.items()}
    return QuadraticMap(channel.sum_in_places(centers, axes=2), channel.sum_in_places(radii, axes=2))
