"""One of several maps, drawn anew at each step."""

from collections.abc import Sequence
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.numpy_or_jax import library, stack_parts
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, SameNoise, check_forgets, check_maps
from heliograph.random_affine.composite import DIRECT, AbstractOneOfSeveralMaps, write_percentage
from heliograph.random_affine.hop import NOTHING_SENT, GainAndNoise
from heliograph.random_affine.laws.law import Constant, Discrete
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain, mix_gains
from heliograph.random_affine.moments.mixture_components import AffineComponent
from heliograph.random_affine.moments.monomials import JointMoments, product_table
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit
from heliograph.random_affine.noises.noise import Gaussian, Matrix
from heliograph.random_affine.series_and_stack import AbstractCombination, Corners


class Mixture(AbstractOneOfSeveralMaps, AbstractCombination):
    """Mixture of maps, one of them drawn at each step; moments are linear in the (possibly uncertain) weights.

    Args:
        maps: maps of one shape.
        weights: their probabilities (maps,).
        radius: how far each probability may be off; one number or (maps,), 0 unless given.
    """

    maps: tuple[AbstractRandomAffine, ...]
    choice: Discrete

    def __init__(
        self,
        maps: Sequence[AbstractRandomAffine],
        weights: "Float[ArrayLike, ' maps']",
        radius: "Float[ArrayLike, '*maps']" = 0.0,
    ):
        """Hold the maps and their probabilities `weights`, each uncertain by up to `radius`.

        `choice` is the law of the number of the map that is drawn.
        """
        self.maps = check_maps("mixture", maps)
        self.choice = Discrete(np.arange(len(self.maps)), weights, radius)
        self.check_shapes("mixture")

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw every map, so that all states move, and choose one map at random; return the next state and its H."""
        choice_key, *keys = jax.random.split(key, len(self.maps) + 1)
        state, matrices = self._draw_each(state, keys)
        chosen = self.choice.sample(choice_key).astype(int)
        return state, jnp.stack(matrices)[chosen]

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^order(H)] = sum_i p_i E[Sym^order(H_i)], p_i the probability of map i.

        Sym^order(H) maps the monomials of (y, 1) of this degree to those of (z, 1).
        """
        check_forgets("moments of a map", self)
        matrices = [affine.moments(order).matrix for affine in self.maps]
        probabilities = self.choice.probabilities
        mean = library(matrices, probabilities).tensordot(probabilities, stack_parts(matrices), axes=1)
        return JointMoments(mean, self.outputs, self.inputs, order)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Return one mixture for each extreme law of the choice and each combination of the maps' extremes."""
        extreme_choices = [law for law in self.choice.extremes() if isinstance(law, Discrete)]  # all of them are
        return tuple(
            Mixture(extreme_maps, law.probabilities)
            for law in extreme_choices
            for extreme_maps in product(*(affine.extremes() for affine in self.maps))
        )

    @cache_by_object
    def corner_moments(self, order: int) -> Corners:
        """Return E[Sym^order(H)] = sum_i w_i E[Sym^order(H_i)] under each extreme law ("corner") of the mixture.

        Sym^order(H) takes the monomials of (y, 1) of this degree to those of (z, 1). A corner combines an extreme law
        w of the choice with one extreme law of each map i. `weights` (corner, map) has the laws w. `corner_numbers`
        (map, combination) lists all combinations of one extreme law of each map.
        """
        corners_by_map = [affine.corner_moments(order) for affine in self.maps]
        weights = self.choice.corners()
        numbers_by_map = [range(len(corners_of_map)) for corners_of_map in corners_by_map]
        corner_numbers = np.array(list(product(*numbers_by_map))).T
        combined = stack_parts(
            [corners_of_map[numbers] for corners_of_map, numbers in zip(corners_by_map, corner_numbers, strict=True)]
        )
        # The axes are corner of the weights, combination, row and column. The first two become the mixture's corners.
        moments = library(weights, combined).tensordot(weights, combined, axes=1)
        by_corner: Matrix = moments.reshape(-1, *moments.shape[2:])
        return by_corner

    def corner_count(self) -> int:
        """Return the number of extreme laws of the choice, times that of combinations of extreme laws of the maps."""
        return len(self.choice.corners()) * super().corner_count()

    def covers_kind(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `actual` is a mixture whose choice and maps are possible under those of this one."""
        if not isinstance(actual, Mixture) or not self.choice.covers(actual.choice):
            return False
        return self.covers_maps(actual, same_noise)

    def list_atoms(self) -> list[AffineComponent]:
        """Return the atoms of all maps; the probability of each is multiplied by that of its map."""
        probabilities_and_maps = zip(self.choice.probabilities, self.maps, strict=True)
        return [
            atom._replace(weight=p * atom.weight)
            for p, affine in probabilities_and_maps
            for atom in affine.list_atoms()
        ]

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [G, N], the mixture's gain G and the noise roots N of all maps.

        In an H-infinity design z = G y + N d: with probability p_i, z = G_i y + N_i d_i, where N_i N_i' is the noise
        covariance of map i, and d_i a disturbance in place of its noise.
        """
        gains_of_maps = [affine.disturb_gain() for affine in self.maps]
        return mix_gains(gains_of_maps, np.asarray(self.choice.probabilities), self.inputs)

    def in_words(self) -> str:
        """Return the maps in words with their shares; a choice between a map and noise alone is an unnoticed loss."""
        maps_in_words = [affine.in_words() or DIRECT for affine in self.maps]
        shares = self.choice.probabilities
        if len(maps_in_words) == 2 and maps_in_words[1] == NOTHING_SENT:
            return f"{maps_in_words[0]}, {write_percentage(shares[1])} lost unnoticed"
        choices = (f"{words} ({write_percentage(p)})" for words, p in zip(maps_in_words, shares, strict=True))
        return f"({' or '.join(choices)})"

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the mixture with visit(name, hop, signal) in place of each hop, and the position behind it.

        If several maps can deliver a signal, each has transmitters of its own, and names of its hops begin with
        "choice" and its number. If all maps but one deliver only noise, the mixture is one link that may lose its
        signal, and its hops are hops of the chain like others.
        """
        if sum(not affine.is_silent for affine in self.maps) <= 1:
            return super().visit_hops(visit, position)
        maps_and_positions = position.number_maps(self.maps, "choice")
        visited = [affine.visit_hops(visit, position_of_map)[0] for affine, position_of_map in maps_and_positions]
        return self.rebuilt(*visited), position

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the map z = E[G] y + n, for a filter that takes the mean gain as the true one.

        The noise n is Gaussian with the mean and covariance of the mixture's noise, which is z at y = 0.
        """
        moments = self.moments(2)
        mean = moments.mean
        # Rows of the monomials z_i z_j in E[Sym^2(H)], at [i, j]; the last index, left out, is that of the constant 1.
        noise_products = product_table(self.outputs + 1, first=1, second=1)[:-1, :-1]
        second_moment = moments.matrix[noise_products, -1]  # E[n n'], the coefficients of the monomial 1
        offset = mean[:-1, -1]  # E[n], last column of H = [[G, n], [0, 1]]
        square_of_mean = offset[:, None] * offset
        noise = Gaussian(second_moment - square_of_mean, offset)
        return GainAndNoise(Constant(1.0), mean[:-1, :-1], noise)
