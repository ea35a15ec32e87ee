"""Maps made of independent maps: in series, and side by side."""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import stack_parts
from heliograph.numerics.types import Float, PyTree
from heliograph.random_affine.base import (
    AbstractRandomAffine,
    ArrivalOutcome,
    KnownGains,
    SameNoise,
    check_forgets,
    check_maps,
)
from heliograph.random_affine.composite import ARROW, AbstractComposite, describe_maps_side_by_side
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain, stack_on_shared_inputs
from heliograph.random_affine.moments.interval_products import (
    Interval,
    multiply_interval_polynomials,
    multiply_matrices,
)
from heliograph.random_affine.moments.mixture_components import AffineComponent, combine_atoms
from heliograph.random_affine.moments.monomials import (
    JointMoments,
    count_monomials,
    list_exponents,
    multiply_polynomials,
    position,
    refuse_if_too_large,
)
from heliograph.random_affine.moments.signal_path import ChannelPosition, SignalMoment, Visit
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent

OUTCOME_LIMIT = 1024  # sets of losses that are listed
Corners = Float[jax.Array | np.ndarray, "corner rows columns"]


class AbstractCombination(AbstractComposite):
    """Map made of several maps: its state is the tuple of theirs, and all of them move at each draw."""

    maps: eqx.AbstractVar[tuple[AbstractRandomAffine, ...]]

    @property
    def inputs(self) -> int:
        """Inputs of the first map."""
        return self.maps[0].inputs

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Return the tuple of the maps' initial states; () if the draws of all are independent over time."""
        keys = jax.random.split(key, len(self.maps))
        return tuple(m.init(k) for m, k in zip(self.maps, keys, strict=True)) if self.remembers else ()

    def degree_in(self, identity: str) -> int:
        """Return the degree of H in a memory's state: the largest of any map, since their H are not multiplied."""
        return max(affine.degree_in(identity) for affine in self.maps)

    def covers_maps(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `actual` is of this class, and each map inside it is possible under its counterpart here.

        A filter assumes the maps here; signals pass through those of `actual`. `same_noise` compares two noises.
        """
        if not isinstance(actual, AbstractCombination) or type(actual) is not type(self):
            return False
        pairs = list(zip(self.maps, actual.maps, strict=False))
        are_as_many = len(actual.maps) == len(self.maps)
        return are_as_many and all(assumed.covers(actual_map, same_noise) for assumed, actual_map in pairs)

    def _draw_each(
        self, state: PyTree[jax.Array], keys: Sequence[jax.Array] | jax.Array
    ) -> tuple[PyTree[jax.Array], list[jax.Array]]:
        """Draw each map by its key; return the next state, and the drawn H of each map.

        The state is the tuple of the maps' states, or () if the draws of all maps are independent over time.
        """
        states = state if self.remembers else ((),) * len(self.maps)
        draws = [affine.draw(map_state, key) for affine, map_state, key in zip(self.maps, states, keys, strict=True)]
        next_states = tuple(map_state for map_state, _ in draws) if self.remembers else ()
        return next_states, [matrix for _, matrix in draws]


def _join_outcomes(
    a: list[ArrivalOutcome],
    b: list[ArrivalOutcome],
    join: Callable[[ArrivalOutcome, ArrivalOutcome], tuple[AbstractRandomAffine, np.ndarray]],
) -> list[ArrivalOutcome]:
    """Return all pairs of an outcome of a and one of b, two independent parts; their probabilities are multiplied.

    An outcome is a set of losses. join(x, y) returns the map of both parts given these, and which outputs arrive.
    """
    if len(a) * len(b) > OUTCOME_LIMIT:
        raise fail("channel with erasures", f"at most {OUTCOME_LIMIT} sets of losses", f"{len(a) * len(b):,}")
    return [ArrivalOutcome(x.probability * y.probability, *join(x, y)) for x in a for y in b]


class Series(AbstractCombination):
    """Series of independent maps, z = H_last ... H_2 H_1 y; E[Sym^k] is the product of the E[Sym^k].

    Args:
        maps: the maps, first the one that takes y; each takes as many inputs as the one before has outputs.
    """

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        """Hold the maps in the order of their application; each takes the outputs of the map before it as inputs."""
        self.maps = check_maps("series", maps)
        for affine, next_affine in zip(self.maps, self.maps[1:], strict=False):
            if affine.outputs != next_affine.inputs:
                raise fail(
                    "series", f"a map that takes {affine.outputs} inputs", f"one that takes {next_affine.inputs}"
                )

    @property
    def outputs(self) -> int:
        """Outputs of the last map."""
        return self.maps[-1].outputs

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Return the next state, and H of the series, the product of all drawn H with that of the first map rightmost.

        Rows of lost outputs are NaN.
        """
        state, matrices = self._draw_each(state, jax.random.split(key, len(self.maps)))
        multiply = _compose_draws if self.erases else jnp.matmul
        return state, reduce(lambda product, matrix: multiply(matrix, product), matrices)

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^k(H2 H1)] = E[Sym^k(H2)] E[Sym^k(H1)]; Sym^k(H) maps monomials of (y, 1) to those of (z, 1)."""
        check_forgets("moments of a map", self)
        first_map, *later_maps = self.maps
        matrix = first_map.moments(order).matrix
        for affine in later_maps:
            matrix = affine.moments(order).matrix @ matrix
        return JointMoments(matrix, self.outputs, self.inputs, order)

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """Return E[Sym^k(H2 H1)] = E[Sym^k(H2)] E[Sym^k(H1)] for each combination of one extreme law of each map.

        k is `order`. The extreme law ("corner") of the first map varies slowest.
        """
        joint, *corners_of_later_maps = (affine.corner_moments(order) for affine in self.maps)
        for corners_of_map in corners_of_later_maps:
            products = corners_of_map @ joint[:, None]  # (joint corner of the maps before, corner, row, column)
            joint = products.reshape(-1, *products.shape[2:])
        return joint

    def _interval_of_parts(self, order: int) -> Interval:
        """Return an interval of each entry of E[Sym^k(H2 H1)], from those of E[Sym^k(H2)] and E[Sym^k(H1)]."""
        intervals = [m.moment_interval(order) for m in self.maps]
        return reduce(lambda product, factor: multiply_matrices(factor, product), intervals)

    @property
    def in_series(self) -> list[AbstractRandomAffine]:
        """Its maps, those of series within it too."""
        return [m for affine in self.maps for m in affine.in_series]

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Return for each output whether its gain is known behind all maps in turn, from the same of each input."""
        return reduce(lambda known_so_far, affine: affine.carry_known_gains(known_so_far), self.maps, known)

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the outputs that are angles behind each map in turn."""
        return reduce(lambda before, affine: affine.carry_angles(before), self.maps, sent)

    def degree_in(self, identity: str) -> int:
        """Return the degree of H in a memory's state: the sum of the maps' degrees, since their H are multiplied."""
        return sum(affine.degree_in(identity) for affine in self.maps)

    def condition_on_arrival(self) -> AbstractRandomAffine:
        """Return the same series of maps through which everything arrives."""
        return self.rebuilt(*(affine.condition_on_arrival() for affine in self.maps))

    def _outcomes(self) -> list[ArrivalOutcome]:
        """Return the sets of losses: an output is lost where a map loses it, or has a gain on what one before lost."""
        return reduce(partial(_join_outcomes, join=_join_outcomes_in_series), (m.list_outcomes() for m in self.maps))

    def list_atoms(self) -> list[AffineComponent]:
        """Return all combinations of one atom of each map, each as the series of these atoms."""
        return combine_atoms([affine.list_atoms() for affine in self.maps], AffineComponent.then)

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [G, N], z = G y + N d with a disturbance d in place of the noises."""
        return reduce(DisturbedGain.then, (affine.disturb_gain() for affine in self.maps))

    def in_words(self) -> str:
        """Return the maps in words, with arrows between them."""
        return ARROW.join(filter(None, (affine.in_words() for affine in self.maps)))

    def detach_outliers(self) -> tuple[AbstractRandomAffine, AbstractNoise | None]:
        """Return the series without its last map's noise, and that noise, if it has outliers; else itself and None."""
        *earlier_maps, last_map = self.maps
        last_without_noise, noise = last_map.detach_outliers()
        return (self, None) if noise is None else (Series([*earlier_maps, last_without_noise]), noise)

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the series with visit(name, hop, signal) in place of each hop, and the position behind it.

        Each map is visited with the second moment of the signal that reaches it, or None if it is not known.
        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        visited = list[AbstractRandomAffine]()
        signal = position.signal
        for i, affine in enumerate(self.maps):
            changed, position = affine.visit_hops(visit, position._replace(signal=signal))
            visited.append(changed)
            if signal is not None and i + 1 < len(self.maps):
                signal = affine.carry_signal(signal)
        return self.rebuilt(*visited), position

    def carry_signal(self, signal: SignalMoment) -> SignalMoment:
        """Return E[(z, 1) (z, 1)'] behind the last map and the probability that z arrives, from map to map."""
        return reduce(lambda signal_before, affine: affine.carry_signal(signal_before), self.maps, signal)


def _join_outcomes_in_series(x: ArrivalOutcome, y: ArrivalOutcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Return the map y after x, and which of its outputs arrive: each must use no output that x lost."""
    received = known(np.diag(x.arrived.astype(float)))  # puts zero in place of what x lost
    gain_moments = np.asarray(y.map.moments(2).second)[..., :-1, :-1]
    uses = np.einsum("iiaa->ia", gain_moments) > 0  # E[G_ia^2]
    uses_lost = uses[:, ~x.arrived].any(axis=1)
    return Series([x.map, received, y.map]), y.arrived & ~uses_lost


def _compose_draws(second: jax.Array, first: jax.Array) -> jax.Array:
    """Return the product of two drawn H = [[G, n], [0, 1]], second after first, with rows of NaN for lost outputs.

    An output of the second map is lost too if it has a gain on a lost output of the first.
    """
    is_lost = jnp.isnan(first).any(axis=1)  # which outputs of the first map are lost
    is_lost_after = jnp.any((second != 0) & is_lost, axis=1) | jnp.isnan(second).any(axis=1)
    return jnp.where(is_lost_after[:, None], jnp.nan, second @ jnp.where(is_lost[:, None], 0.0, first))


class Stack(AbstractCombination):
    """Stack of independent maps of the same y, outputs one above the other; moments are products of polynomials."""

    maps: tuple[AbstractRandomAffine, ...]

    def __init__(self, maps: Sequence[AbstractRandomAffine]):
        """Hold the maps, all of which take the same y."""
        self.maps = check_maps("stack", maps)
        if len({m.inputs for m in self.maps}) != 1:
            raise fail("stack", "maps of one number of inputs", [m.inputs for m in self.maps])

    @property
    def outputs(self) -> int:
        """Sum of the maps' outputs."""
        return sum(m.outputs for m in self.maps)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw each map; return the next state, and H with the maps' rows [G, n] one above another, and (0, 1) last."""
        state, matrices = self._draw_each(state, jax.random.split(key, len(self.maps)))
        rows, last_row = [matrix[:-1] for matrix in matrices], np.eye(1, self.inputs + 1, self.inputs)
        return state, jnp.concatenate([*rows, last_row], axis=0)

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^order(H)]: row a has the coefficients of E[z^a | y] as a polynomial in (y, 1).

        z = (z1, z2, ...) are the outputs of the maps, independent given y, so that the polynomials are multiplied:
        E[z1^a z2^b | y] = E[z1^a | y] E[z2^b | y].
        """
        check_forgets("moments of a map", self)
        rows, columns = count_monomials(self.outputs + 1, order), count_monomials(self.inputs + 1, order)
        refuse_if_too_large(rows, columns, f"moments of order {order}")
        # For each map, the matrices E[Sym^k(H)] by degree k; that of degree 0 is not used.
        matrices_by_map = []
        for moments in [affine.moments(order) for affine in self.maps]:
            matrices_by_map.append([None, *(moments.lower(k) for k in range(1, order + 1))])
        matrix = stack_parts(multiply_moments_of_parts(self, order, matrices_by_map, multiply_polynomials))
        return JointMoments(matrix, self.outputs, self.inputs, order)

    def _interval_of_parts(self, order: int) -> Interval:
        """Return an interval of each entry of E[Sym^order(H)]; row a has the coefficients of E[z^a | y].

        This polynomial in (y, 1) is the product of one for each map, multiplied with intervals of coefficients.
        """
        # For each map, the intervals of E[Sym^k(H)] by degree k (2, rows, columns); that of degree 0 is not used.
        intervals_by_map = []
        for affine in self.maps:
            intervals = [stack_parts(affine.moment_interval(k)) for k in range(1, order + 1)]
            intervals_by_map.append([None, *intervals])
        rows = stack_parts(multiply_moments_of_parts(self, order, intervals_by_map, multiply_interval_polynomials))
        lowest, highest = rows[:, 0], rows[:, 1]
        return lowest, highest

    @property
    def in_parallel(self) -> list[AbstractRandomAffine]:
        """Its maps, those of stacks within it too."""
        return [m for affine in self.maps for m in affine.in_parallel]

    def covers_kind(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `actual` is a stack whose maps are possible under those of this one, one by one."""
        return self.covers_maps(actual, same_noise)

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Return for each output whether its gain is known, map after map, from the same of each input."""
        return np.concatenate([affine.carry_known_gains(known) for affine in self.maps])

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of outputs that are angles if the inputs `sent` are; the maps' outputs come in turn."""
        starts = np.cumsum([0, *(affine.outputs for affine in self.maps)])
        items = zip(starts, self.maps, strict=False)
        return tuple(int(start) + i for start, affine in items for i in affine.carry_angles(sent))

    def condition_on_arrival(self) -> AbstractRandomAffine:
        """Return the same stack of maps through which everything arrives."""
        return self.rebuilt(*(affine.condition_on_arrival() for affine in self.maps))

    def _outcomes(self) -> list[ArrivalOutcome]:
        """Return all combinations of one set of losses of each map; probabilities are multiplied."""
        return reduce(partial(_join_outcomes, join=_join_outcomes_in_stack), (m.list_outcomes() for m in self.maps))

    def list_atoms(self) -> list[AffineComponent]:
        """Return all combinations of one atom of each map, stacked one above another."""
        return combine_atoms([affine.list_atoms() for affine in self.maps], AffineComponent.above)

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [G, N], z = G y + N d with a disturbance d in place of the noises."""
        return stack_on_shared_inputs([affine.disturb_gain() for affine in self.maps], self.inputs)

    def in_words(self) -> str:
        """Return the maps in words, between bars."""
        return describe_maps_side_by_side(self.maps)

    def detach_outliers(self) -> tuple[AbstractRandomAffine, AbstractNoise | None]:
        """Return the stack without those noises of its maps that have outliers, and these noises joined in one.

        The joined noise is zero for a map that keeps its own noise. It is None if all maps keep theirs.
        """
        maps_and_noises = [affine.detach_outliers() for affine in self.maps]
        if all(noise is None for _, noise in maps_and_noises):
            return self, None
        maps = [affine for affine, _ in maps_and_noises]
        noises = [noise or Gaussian(np.zeros((affine.outputs, affine.outputs))) for affine, noise in maps_and_noises]
        return Stack(maps), Independent(noises)

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the stack with visit(name, hop, signal) in place of each hop, and the position unchanged.

        Names of the hops in a map begin with "part" and its number. Hops side by side do not lengthen the chain.
        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        maps_and_positions = position.number_maps(self.maps, "part")
        visited = [affine.visit_hops(visit, position_of_map)[0] for affine, position_of_map in maps_and_positions]
        return self.rebuilt(*visited), position


def _join_outcomes_in_stack(x: ArrivalOutcome, y: ArrivalOutcome) -> tuple[AbstractRandomAffine, np.ndarray]:
    """Return y below x, and which of the outputs of both arrive."""
    return Stack([x.map, y.map]), np.concatenate([x.arrived, y.arrived])


def multiply_moments_of_parts(
    channel: Stack, order: int, matrices_by_map: list[list[Any]], multiply: Callable[..., Any]
) -> list[Any]:
    """Return for each monomial z^a of (z, 1) the coefficients of E[z^a | y] as a polynomial in (y, 1).

    z = (z_1, z_2, ...) are the outputs of the maps, independent given y: E[z^a | y] = prod_m E[z_m^(a_m) | y]. So the
    polynomial of a monomial is a product of one polynomial per map.

    Args:
        channel: the stack of these maps.
        order: degree of the monomials of (z, 1), and of all polynomials that are returned.
        matrices_by_map: for map m and degree k the matrix E[Sym^k(H_m)] (..., rows, columns). Its row a has the
            coefficients of E[z_m^a | y], |a| = k. Entry 0 is not used, since the polynomial of degree 0 is 1.
        multiply: function of (coefficients a, degree of a, coefficients b, degree of b, number of variables), which
            returns the coefficients of the product.
    """
    variables, rows = channel.inputs + 1, []
    for powers in list_exponents(channel.outputs + 1, order):
        polynomial, degree = np.ones(1), 0
        start = 0  # first output of map m
        for affine, matrices in zip(channel.maps, matrices_by_map, strict=True):
            powers_of_map = powers[start : start + affine.outputs]  # a_m
            start, degree_of_map = start + affine.outputs, sum(powers_of_map)
            if degree_of_map:
                # E[z_m^(a_m) | y] is the row of the monomial z_m^(a_m) 1^0 of (z_m, 1).
                row = position(affine.outputs + 1, degree_of_map)[(*powers_of_map, 0)]
                polynomial_of_map = matrices[degree_of_map][..., row, :]
                polynomial = multiply(polynomial, degree, polynomial_of_map, degree_of_map, variables)
                degree += degree_of_map
        # Times 1^(order - |a|), whose only coefficient is that of the last monomial: all rows get the degree `order`.
        power_of_one = np.zeros(count_monomials(variables, powers[-1]))
        power_of_one[-1] = 1.0
        rows.append(multiply(polynomial, degree, power_of_one, powers[-1], variables))
    return rows
