"""Maps that add up: independent maps of parts of y, or of all of it, whose sum is received with one noise."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_arrays, cache_by_object
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
from heliograph.random_affine.moments.monomials import (
    JointMoments,
    count_monomials,
    factor_variables,
    list_exponents,
    place_monomials,
    plan_binomial_sums,
    position,
    refuse_if_too_large,
    times_one,
)
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Matrix, as_noise, noise_moment_vector
from heliograph.random_affine.series_and_stack import AbstractCombination, Corners, Series, Stack

Places = tuple[int, ...]  # of what a map takes, among the components of y


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
        self.maps, self.taken = check_maps("sum", maps), check_count("inputs of a sum", inputs)
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
        """Length of y."""
        return self.taken

    @property
    def selection(self) -> np.ndarray:
        """Matrix from y to (y_1, y_2, ...)."""
        rows: np.ndarray = np.eye(self.inputs)[[i for chosen in self.places for i in chosen]]
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

    def sum_in_places(self, parts: Mapping[int, jax.Array | np.ndarray], axes: int) -> jax.Array | np.ndarray:
        """Return the sum of arrays of some of the maps, each put at the places in (y, 1) of what its map takes.

        parts: arrays by number of the map, whose last `axes` (1 or 2) have the length of (y_i, 1).
        """
        size = self.inputs + 1
        # Places of each part's entries in the flat axis or axes of (y, 1).
        where = [np.array([*self.places[i], self.inputs]) for i in parts]
        if axes == 2:
            where = [(size * of_part[:, None] + of_part).reshape(-1) for of_part in where]
        if not parts:
            return np.zeros((self.outputs,) * axes + (size,) * axes)
        flat = [part.reshape(*part.shape[:-axes], -1) for part in parts.values()]
        values = library(flat).concatenate(flat, axis=-1)
        whole = scatter(
            (size**axes, *values.shape[:-1]), np.concatenate(where), values.transpose(-1, *range(values.ndim - 1))
        )
        return whole.transpose(*range(1, whole.ndim), 0).reshape(*values.shape[:-1], *(size,) * axes)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map and the noise; return the next state, and H = [[G, n], [0, 1]] of the sum on all of y."""
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
        """Return E[Sym^order(H)] of the sum, from those of the maps and the noise."""
        check_forgets("moments of a map", self)
        matrices = [affine.moments(order).matrix[None] for affine in self.maps]  # the nominal law counts as one corner
        (matrix,) = self._add_moments(matrices, order)
        return JointMoments(matrix, self.outputs, self.inputs, order)

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """Return E[Sym^order(H)] at every combination of the maps' corners."""
        return self._add_moments([m.corner_moments(order) for m in self.maps], order)

    def _interval_of_parts(self, order: int) -> Interval:
        """Return the interval of E[Sym^order(H)], that of the same map written as the sum of a stack."""
        return self.as_stack.moment_interval(order)

    def covers_kind(self, own: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `own` is a sum with the same places and noise, and with maps that are possible here."""
        if not isinstance(own, Superposed) or own.places != self.places or not same_noise(self.noise, own.noise):
            return False
        return self.covers_maps(own, same_noise)

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Return for each output whether its gain is known, which must hold in every summand.

        `known` says the same of each input.
        """
        pairs = zip(self.maps, self.places, strict=True)
        known_by_map = [affine.carry_known_gains(known[list(taken)]) for affine, taken in pairs]
        known_in_all: KnownGains = np.all(known_by_map, axis=0)
        return known_in_all

    def list_atoms(self) -> list[AffineComponent]:
        """Return the atoms of the sum of a stack."""
        return self.as_stack.list_atoms()

    def disturb_gain(self) -> DisturbedGain:
        """Return the joint moments of the sum of a stack."""
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
        """Return the sum with its hops visited; each map is a link with the components of y that it takes.

        The position does not change, since links side by side are not hops of the chain.
        """
        maps_with_places = zip(position.number_maps(self.maps, "link"), self.places, strict=True)
        visited = [affine.visit_hops(visit, at.select_components(place))[0] for (affine, at), place in maps_with_places]
        return self.rebuilt(*visited), position

    def _add_moments(self, parts: Sequence[Corners], order: int) -> Corners:
        """Return E[Sym^order(H)] of the sum from those of its maps in `parts`, each (corners, rows, columns).

        A corner of the sum is a combination of corners (extreme laws) of the maps.
        """
        columns = count_monomials(self.inputs + 1, order)
        refuse_if_too_large(count_monomials(self.outputs + 1, order), columns, f"moments of order {order}")
        terms = [
            _expand_map_moments(matrix, affine.outputs, taken, order)
            for matrix, affine, taken in zip(parts, self.maps, self.places, strict=True)
        ]
        # The noise is a map without inputs.
        noise_moments = noise_moment_vector(self.noise, order)[None, :, None]
        noise = _expand_map_moments(noise_moments, self.outputs, places=(), order=order)
        moments = _add_independent_moments(_sum_maps_by_halves(terms, self.outputs), noise, self.outputs)
        return _assemble_moments(moments, self.outputs, self.inputs, order)


class _SumMoments(NamedTuple):
    """Powers of a sum t of maps: E[t^a | y] at each corner, by degree |a|, homogeneous polynomials in (y, 1).

    places: of the components of y on which t depends, in order; by_degree: each (corners, monomials of t, monomials).
    """

    places: Places
    by_degree: list[Corners]


def _expand_map_moments(matrix: Corners, outputs: int, places: Places, order: int) -> _SumMoments:
    """Return the polynomials E[t^a | y] of one map t = H y from its E[Sym^order(H)] at each corner (extreme law).

    Args:
        matrix: E[Sym^order(H)] of the map (corners, rows, columns).
        outputs: number of its outputs.
        places: places of its inputs among all of y, in any order; polynomials have them sorted.
        order: order of the moments.
    """
    ordered, variables = tuple(sorted(places)), len(places) + 1
    # The place of each variable of the map in the sorted order; the constant 1 is last.
    sorted_place = np.array([ordered.index(i) for i in places] + [len(places)])
    by_degree = [library(matrix).ones((len(matrix), 1, 1))]
    for degree in range(1, order + 1):
        rows, columns = _find_monomials_of_degree(outputs, degree, order), times_one(variables, degree, order)
        # Places of monomials among those of the sorted variables. argsort gives the monomial that has each place.
        place_in_sorted = place_monomials(sorted_place[factor_variables(variables, degree)], variables)
        by_degree.append(matrix[:, rows[:, None], columns[np.argsort(place_in_sorted)]])
    return _SumMoments(ordered, by_degree)


@cache_arrays
def _find_monomials_of_degree(outputs: int, degree: int, order: int) -> np.ndarray:
    """Return the positions at `order` of the monomials of z alone of this degree, times powers of 1."""
    alone = factor_variables(outputs, degree)
    return place_monomials(np.pad(alone, ((0, 0), (0, order - degree)), constant_values=outputs), outputs + 1)


def _sum_maps_by_halves(terms: Sequence[_SumMoments], outputs: int) -> _SumMoments:
    """Return the moments E[t^a | y] of a sum t of independent terms, from those of its halves.

    Polynomials of few variables are so multiplied first, which is fastest.
    """
    if len(terms) == 1:
        return terms[0]
    middle = len(terms) // 2
    first_half = _sum_maps_by_halves(terms[:middle], outputs)
    second_half = _sum_maps_by_halves(terms[middle:], outputs)
    return _add_independent_moments(first_half, second_half, outputs)


def _add_independent_moments(a: _SumMoments, b: _SumMoments, outputs: int) -> _SumMoments:
    """Return the powers of a sum t + r of independent maps at each pair of corners, those of t slowest.

    E[(t + r)^c | y] = sum_{b <= c} C(c, b) E[t^b | y] E[r^(c-b) | y].
    """
    places = tuple(sorted({*a.places, *b.places}))
    size, corners = len(places) + 1, len(a.by_degree[0]) * len(b.by_degree[0])
    left_variables, right_variables = ((*(places.index(i) for i in part.places), size - 1) for part in (a, b))
    by_degree = [library(a.by_degree[0], b.by_degree[0]).ones((corners, 1, 1))]
    for degree in range(1, len(a.by_degree)):
        total: Corners = np.zeros((count_monomials(size, degree), count_monomials(outputs, degree), corners))
        # Terms with |b| = first: the places of c, b and c - b, and C(c, b).
        for first, (row, of_t, of_r, ways) in enumerate(_list_binomial_terms(outputs, degree)):
            left = a.by_degree[first][:, None, of_t, :, None] * ways[:, None, None]
            right = b.by_degree[degree - first][None, :, of_r, None, :]
            products = (left * right).reshape(corners, len(row), -1)
            where = _place_products(left_variables, right_variables, first, degree - first, size).reshape(-1)
            rows = scatter((count_monomials(outputs, degree), len(where), corners), row, products.transpose(1, 2, 0))
            total = total + scatter((count_monomials(size, degree), *rows.shape[::2]), where, rows.swapaxes(0, 1))
        by_degree.append(total.transpose(2, 1, 0))
    return _SumMoments(places, by_degree)


@cache_arrays
def _list_binomial_terms(outputs: int, degree: int) -> tuple[tuple[np.ndarray, ...], ...]:
    """Return terms of (t + r)^c = sum_b C(c, b) t^b r^(c-b) with |c| = degree, for |b| = 0, 1, ..., degree.

    For each |b| there are four columns: the places of c, of b and of c - b, each among monomials of its own degree, and
    C(c, b).
    """
    exponents = list_exponents(outputs + 1, degree)
    by_degree_of_b: list[list[tuple[int, ...]]] = [[] for _ in range(degree + 1)]
    for c, b, remainder, binomial in zip(*plan_binomial_sums(outputs, degree), strict=True):
        if not exponents[c][-1]:  # |c| = degree: no power of 1
            powers = [exponents[i][:-1] for i in (c, b, remainder)]
            places = [position(outputs, sum(power))[power] for power in powers]
            by_degree_of_b[sum(exponents[b][:-1])].append((*places, binomial))
    return tuple(tuple(np.array(column) for column in zip(*terms, strict=True)) for terms in by_degree_of_b)


@cache_arrays
def _place_products(a: Places, b: Places, first: int, second: int, size: int) -> np.ndarray:
    """Return the positions of products of monomials of degree `first` in variables a and of degree `second` in b.

    Entry (i, j) is the position of monomial i times monomial j among those of degree first + second in all `size`
    variables.
    """
    variables_a = np.array(a)[factor_variables(len(a), first)]
    variables_b = np.array(b)[factor_variables(len(b), second)]
    shape = len(variables_a), len(variables_b)
    of_a = np.broadcast_to(variables_a[:, None], (*shape, first))
    of_b = np.broadcast_to(variables_b, (*shape, second))
    return place_monomials(np.concatenate([of_a, of_b], axis=-1), size)


def _assemble_moments(powers: _SumMoments, outputs: int, inputs: int, order: int) -> Corners:
    """Return E[Sym^order(H)] at each corner (extreme law) from the polynomials of each degree.

    `powers`: of z, by degree |a| the polynomials E[z^a | y] in the components of y at their places, and 1.
    """
    size, corners = len(powers.places) + 1, len(powers.by_degree[0])
    names = np.array([*powers.places, inputs])
    xp = library(powers.by_degree)
    matrix: Corners = xp.zeros((corners, count_monomials(outputs + 1, order), count_monomials(inputs + 1, order)))
    for degree, polynomials in enumerate(powers.by_degree):
        rows = _find_monomials_of_degree(outputs, degree, order)
        # A row is z^a times powers of 1, a column a monomial of y times powers of 1: each of degree `order`.
        chosen = np.pad(names[factor_variables(size, degree)], ((0, 0), (0, order - degree)), constant_values=inputs)
        columns = place_monomials(chosen, inputs + 1)
        if xp is np:
            matrix[:, rows[:, None], columns] = polynomials
        else:
            matrix = jnp.asarray(matrix).at[:, rows[:, None], columns].set(polynomials)
    return matrix


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
    for taken, noise_of_link, link in zip(first.places, noises_of_links, first.maps, strict=True):
        sensor_of_link = GainAndNoise(Constant(1.0), np.asarray(matrix)[list(taken)], noise_of_link)
        links.append(Series([sensor_of_link, link]))
    n = np.shape(matrix)[1]
    all_of_x = tuple(range(n))
    return Series([Superposed(links, first.noise, [all_of_x] * len(links), n), *later_maps])


class _MapsWithMemories(NamedTuple):
    """Maps of a sum, by their numbers, and the names of the memories that they have."""

    memories: set[str]
    maps: list[int]


def split_terms_without_common_memory(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return maps that share no memory, independent of each other, whose sum is the channel; one if it is no sum.

    The maps of a sum that share a memory (a chain of modes, or a gain that drifts) stay together in one term, and so do
    those without any. The first term has the noise of the sum.
    """
    if not isinstance(channel, Superposed):
        return [channel]
    # Map after map: the groups that share a memory with it, or have none like it, are joined by it.
    groups: list[_MapsWithMemories] = []
    for i, affine in enumerate(channel.maps):
        held, members = set(memories(affine)), [i]
        for group in [group for group in groups if group.memories & held or not (group.memories or held)]:
            groups.remove(group)
            held, members = held | group.memories, group.maps + members
        groups.append(_MapsWithMemories(held, members))
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
