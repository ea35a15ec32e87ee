"""Maps that add up: independent maps of parts of y, or of all of it, whose sum is received with one noise."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import check_count, fail, instance, items, show_value
from heliograph.numerics.numpy_or_jax import library, scatter
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine, KnownGains, SameNoise, check_forgets, check_maps
from heliograph.random_affine.composite import describe_maps_side_by_side
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain
from heliograph.random_affine.moments.interval_products import Interval
from heliograph.random_affine.moments.mixture_components import AffineComponent
from heliograph.random_affine.moments.moments_of_sum import (
    add_independent_moments,
    assemble_moments,
    expand_map_moments,
    sum_moments_by_halves,
)
from heliograph.random_affine.moments.monomials import JointMoments, count_monomials, refuse_if_too_large
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Matrix, as_noise, noise_moment_vector
from heliograph.random_affine.series_and_stack import AbstractCombination, Corners, Series, Stack

Places = tuple[int, ...]  # indices of the components of y that a map takes


class Superposed(AbstractCombination):
    """Sum z = sum_i H_i y_i + n of independent maps, each of its own components y_i of y, which may be the same ones.

    The sum is a fixed row [I ... I] over the stack of the maps, but its moments need no moments of the stack:
    E[z^a | y] = sum_{b <= a} C(a, b) E[t^b | y] E[r^(a-b) | y] for a sum z = t + r of two halves, each done likewise.

    Args:
        maps: the maps, of one number of outputs.
        noise: law of n.
        places: of the components that each map takes.
        inputs: length of y.

    Raises:
        ValueError: maps of other numbers of outputs than the noise, places that are none of a map's inputs.
    """

    maps: tuple[AbstractRandomAffine, ...]
    noise: AbstractNoise
    places: tuple[Places, ...] = eqx.field(static=True)
    taken: int = eqx.field(static=True)

    def __init__(
        self, maps: Sequence[AbstractRandomAffine], noise: AbstractNoise, places: Sequence[Places], inputs: int
    ):
        """Hold the maps, the law of the noise n, and for each map the indices in y of its inputs (`places`)."""
        self.maps = check_maps("sum", maps)
        self.taken = check_count("inputs of a sum", inputs)
        self.noise = instance("noise of a sum", noise, AbstractNoise, "a law of a noise vector")
        self.places = tuple(
            tuple(check_count("place in the input of a sum", i, 0) for i in items("places of a map", chosen, "places"))
            for chosen in items("places of the maps of a sum", places, "places of each map")
        )
        # Places that are not distinct, or not below `inputs`, are fewer than the map's inputs.
        if [len({i for i in chosen if i < inputs}) for chosen in self.places] != [m.inputs for m in self.maps]:
            expected = f"distinct ones below {inputs}, as many as each map has inputs"
            raise fail("places of the maps of a sum", expected, show_value(places))
        if sizes := {m.outputs for m in self.maps} - {noise.dimension}:
            raise fail("sum", f"maps of {noise.dimension} outputs, as the noise has", f"maps of {sorted(sizes)}")

    @property
    def outputs(self) -> int:
        """Length of z: that of each map, as they add up."""
        return self.noise.dimension

    @property
    def inputs(self) -> int:
        """Length of the whole y, of which each map takes some components."""
        return self.taken

    @property
    def selection(self) -> np.ndarray:
        """Matrix S of zeros and ones with S y = (y_1, y_2, ...), y_i the components of y that map i takes."""
        indices = [i for indices_of_map in self.places for i in indices_of_map]
        rows: np.ndarray = np.eye(self.inputs)[indices]
        return rows

    @property
    def as_stack(self) -> Series:
        """The same map as a stack followed by the sum [I ... I] of its outputs, for code that has only stacks and hops.

        Each map of the stack first selects its components of y. The stack has larger moment matrices than the sum.
        """
        pairs = zip(self.maps, self.places, strict=True)
        maps_of_y = [Series([known(np.eye(self.inputs)[list(taken)]), affine]) for affine, taken in pairs]
        sum_matrix = np.tile(np.eye(self.outputs), (1, len(self.maps)))
        return Series([Stack(maps_of_y), GainAndNoise(Constant(1.0), sum_matrix, self.noise)])

    def sum_in_places(self, arrays: Mapping[int, jax.Array | np.ndarray], axes: int) -> jax.Array | np.ndarray:
        """Return the sum of arrays T_i of some of the maps, where index a of (y_i, 1) becomes its index in (y, 1).

        y_i are the components of y that map i takes. With one axis T_i (..., a) is such as E[(G_i, n_i)], with two
        T_i (..., a, b) is such as the covariances of its entries. Entries that no map has are zero.

        Args:
            arrays: T_i by the number i of the map.
            axes: number of last axes of T_i that have the length of (y_i, 1): 1 or 2.
        """
        size = self.inputs + 1  # of (y, 1)
        if not arrays:
            return np.zeros((self.outputs,) * axes + (size,) * axes)
        # For each entry of the last axes of T_i, flattened, its index a, or size a + b, in the result's, flattened.
        indices = [np.array([*self.places[i], self.inputs]) for i in arrays]
        if axes == 2:
            indices = [(size * of_map[:, None] + of_map).reshape(-1) for of_map in indices]
        flat = [array.reshape(*array.shape[:-axes], -1) for array in arrays.values()]
        values = library(flat).concatenate(flat, axis=-1)
        # `scatter` adds along the first axis, so that the flattened axis is first there, and then last again.
        values_by_index = values.transpose(-1, *range(values.ndim - 1))
        total = scatter((size**axes, *values.shape[:-1]), np.concatenate(indices), values_by_index)
        return total.transpose(*range(1, total.ndim), 0).reshape(*values.shape[:-1], *(size,) * axes)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and the noise; return the next state, and H = [[G, n], [0, 1]] of the sum on all of y.

        G has the gain of each map in the columns of the components of y that it takes; n adds up the maps' noises and
        the sum's own.
        """
        keys = jax.random.split(key, len(self.maps) + 1)
        map_keys, noise_key = keys[:-1], keys[-1]
        state, matrices = self._draw_each(state, map_keys)
        # The maps' gains are put side by side, and `selection` adds those on the same component of y.
        gains = jnp.concatenate([matrix[:-1, :-1] for matrix in matrices], axis=1) @ self.selection
        offset = sum((matrix[:-1, -1] for matrix in matrices), self.noise.sample(noise_key))
        top = jnp.concatenate([gains, offset[:, None]], axis=1)
        return state, jnp.concatenate([top, np.eye(1, self.inputs + 1, self.inputs)])

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^order(H)] of the sum, which takes monomials of (y, 1) to means of those of (z, 1)."""
        check_forgets("moments of a map", self)
        matrices = [affine.moments(order).matrix[None] for affine in self.maps]  # the nominal law counts as one corner
        (matrix,) = self._add_moments(matrices, order)
        return JointMoments(matrix, self.outputs, self.inputs, order)

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """Return E[Sym^order(H)] for each combination of one extreme law ("corner") of each map.

        Sym^order(H) maps the monomials of (y, 1) of this degree to those of (z, 1).
        """
        return self._add_moments([m.corner_moments(order) for m in self.maps], order)

    def _interval_of_parts(self, order: int) -> Interval:
        """Return an interval of each entry of E[Sym^order(H)], found for the equal map: a sum [I ... I] after a stack.

        Sym^order(H) maps the monomials of (y, 1) of this degree to those of (z, 1).
        """
        return self.as_stack.moment_interval(order)

    def covers_kind(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `actual` is a sum whose maps take the same components of y and are possible under those here.

        `same_noise` tests whether the noises of both sums agree.
        """
        if not isinstance(actual, Superposed) or actual.places != self.places:
            return False
        return same_noise(self.noise, actual.noise) and self.covers_maps(actual, same_noise)

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Return for each output whether its gain is known, which must hold in every summand.

        `known` says the same of each input.
        """
        pairs = zip(self.maps, self.places, strict=True)
        known_by_map = [affine.carry_known_gains(known[list(taken)]) for affine, taken in pairs]
        known_in_all: KnownGains = np.all(known_by_map, axis=0)
        return known_in_all

    def list_atoms(self) -> list[AffineComponent]:
        """Return the atoms of the equal map `as_stack`: all combinations of one atom of each map and of the noise."""
        return self.as_stack.list_atoms()

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [G, N], z = G y + N d with a disturbance d in place of the noises."""
        return self.as_stack.disturb_gain()

    def in_words(self) -> str:
        """Return the sum of the maps in words."""
        return f"sum of {describe_maps_side_by_side(self.maps)}"

    def detach_outliers(self) -> tuple[AbstractRandomAffine, AbstractNoise | None]:
        """Return the sum with only the mean of its own noise, and that noise, if the noise's law has outliers.

        The noise's `branches` are about its mean. Without outliers, return the sum unchanged and None.
        """
        if not self.noise.has_outliers:
            return self, None
        mean_alone = Gaussian(np.zeros((self.outputs, self.outputs)), self.noise.mean)
        return Superposed(self.maps, mean_alone, self.places, self.inputs), self.noise

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the sum with visit(name, hop, signal) in place of each hop, and the position unchanged.

        Each map is a link that takes some components of y, and names of its hops begin with "link" and its number.
        Links side by side are not hops of the chain, so that the position does not change.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        maps_and_positions = zip(position.number_maps(self.maps, "link"), self.places, strict=True)
        visited = [
            affine.visit_hops(visit, position_of_map.select_components(components))[0]
            for (affine, position_of_map), components in maps_and_positions
        ]
        return self.rebuilt(*visited), position

    def _add_moments(self, moments_by_map: Sequence[Corners], order: int) -> Corners:
        """Return E[Sym^order(H)] of z = sum_i H_i y_i + n for each combination of one extreme law of each map.

        Sym^order(H) takes the monomials of (y, 1) of this degree to those of (z, 1).

        Args:
            moments_by_map: E[Sym^order(H_i)] under each extreme law ("corner") of map i (corners, rows, columns).
            order: degree of the monomials.
        """
        columns = count_monomials(self.inputs + 1, order)
        refuse_if_too_large(count_monomials(self.outputs + 1, order), columns, f"moments of order {order}")
        summands = [
            expand_map_moments(matrix, self.outputs, components, order)
            for matrix, components in zip(moments_by_map, self.places, strict=True)
        ]
        # The noise is a summand that takes no component of y.
        noise_moments = noise_moment_vector(self.noise, order)[None, :, None]
        noise = expand_map_moments(noise_moments, self.outputs, components=(), order=order)
        moments = add_independent_moments(sum_moments_by_halves(summands, self.outputs), noise, self.outputs)
        return assemble_moments(moments, self.outputs, self.inputs, order)


def move_sensor_into_links(
    matrix: Matrix, noise: AbstractNoise, channel: AbstractRandomAffine
) -> AbstractRandomAffine | None:
    """Return a sum of links of y = C x + v as a sum of links of x, in which link i carries C_i x + v_i.

    C is the sensor's `matrix`, and C_i x + v_i are the components of y that link i takes. Return None if the parts v_i
    of the noise are not independent, or if the channel does not begin with a sum.
    """
    first, *later_maps = channel.in_series
    if not isinstance(first, Superposed) or (noises_of_links := noise.split(first.places)) is None:
        return None
    links = []
    for components, noise_of_link, link in zip(first.places, noises_of_links, first.maps, strict=True):
        sensor_of_link = GainAndNoise(Constant(1.0), np.asarray(matrix)[list(components)], noise_of_link)
        links.append(Series([sensor_of_link, link]))
    n = np.shape(matrix)[1]
    all_of_x = tuple(range(n))
    return Series([Superposed(links, first.noise, [all_of_x] * len(links), n), *later_maps])


class _MapsWithMemories(NamedTuple):
    """A group of maps of a sum. memories: identities of all memories inside them. maps: the maps' numbers."""

    memories: set[str]
    maps: list[int]


def split_terms_without_common_memory(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return maps that share no memory, independent of each other, whose sum is the channel; one if it is no sum.

    A channel may be a sum of random maps of parts of its input, as where transmitters share a medium. The maps of a sum
    that share a memory (a chain of modes, or a gain that drifts) stay together in one term, and so do the maps without
    any. So moments of the sum over time follow from those of its terms. The first term has the noise of the sum.
    """
    if not isinstance(channel, Superposed):
        return [channel]
    # Map after map: the groups that share a memory with it are joined, and so are groups without any memory.
    groups: list[_MapsWithMemories] = []
    for i, affine in enumerate(channel.maps):
        identities = set(memories(affine))  # of its memories
        numbers = [i]  # of the maps in the new group
        for group in list(groups):
            share_memory = bool(group.memories & identities)
            both_without_memory = not (group.memories or identities)
            if share_memory or both_without_memory:
                groups.remove(group)
                identities = identities | group.memories
                numbers = group.maps + numbers
        groups.append(_MapsWithMemories(identities, numbers))
    no_noise = as_noise("noise of a term", 0.0, channel.outputs)
    return [
        Superposed(
            maps=[channel.maps[i] for i in group.maps],
            noise=channel.noise if number == 0 else no_noise,
            places=[channel.places[i] for i in group.maps],
            inputs=channel.inputs,
        )
        for number, group in enumerate(groups)
    ]
