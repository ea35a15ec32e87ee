"""Maps with channel side information: numbers reported to the receiver with each message, such as a gain.

The simulation draws the numbers from a memory (`FreshNumbers`, a chain of modes). A "told map" has a law that depends
on them, and each message tells its receiver the numbers, or readings of them with an error.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import eliminate
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Bool, Float
from heliograph.random_affine.base import AbstractModal, AbstractRandomAffine, check_forgets
from heliograph.random_affine.hop import AbstractHop, GainAndNoise
from heliograph.random_affine.laws.gain_given_reading import gain_given_reading
from heliograph.random_affine.laws.law import CertainDiscrete, Constant, Discrete
from heliograph.random_affine.markov_chain_and_autoregression import (
    AbstractMemory,
    CertainChain,
    MarkovChain,
)
from heliograph.random_affine.noises.factor_of_covariance import FACTOR_TOLERANCE
from heliograph.random_affine.noises.noise import AbstractNoise, Matrix
from heliograph.random_affine.reported_numbers import FreshReading

T = TypeVar("T")
Numbers = Float[jax.Array | np.ndarray, " told"]


class AbstractToldMap(AbstractModal):
    """A map whose law depends on numbers that each message reports to the receiver (channel side information).

    `given` returns the map as it is, from the drawn state of the memory. `believed` returns the map as the receiver
    knows it, from the reported numbers.

    names: names of the numbers. exogenous: whether they are independent of the plant's state, so that they say nothing
    about it. fresh: whether the map, given the numbers, is drawn independently with each message, whatever is lost.
    """

    names: eqx.AbstractVar[tuple[str, ...]]
    exogenous: eqx.AbstractVar[bool]
    fresh: eqx.AbstractVar[bool]

    @property
    def reason_for_no_claim(self) -> str:
        """Why a filter may not claim its covariance given the reported numbers; "" if it may.

        It may not if the numbers depend on the plant's state (not `exogenous`), since the filter takes them to say
        nothing about it. Nor may it if the unknown rest of the map is not drawn anew with each message (not `fresh`),
        since the filter takes messages to be independent given the state.
        """
        state_dependence = [] if self.exogenous else ["depends on the state"]
        time_dependence = [] if self.fresh else ["leaves open what is not drawn anew with each message"]
        return " and ".join(state_dependence + time_dependence)

    def _describe_told_numbers(self, what: str) -> str:
        """Return a text in brackets: what each message reports, and whether it is not exogenous or not fresh."""
        return f"(told {what}{', not exogenous' * (not self.exogenous)}{', not fresh' * (not self.fresh)})"

    @property
    def optional(self) -> bool:
        """True if a filter can use z even if the message's reported numbers are missing (NaN); by default False."""
        return False

    @property
    @abstractmethod
    def typical(self) -> Numbers:
        """An example of the numbers that a message reports.

        The map of these numbers, believed(typical), tells the shapes of the map, and what kind of law it has.
        """

    @abstractmethod
    def believed(self, numbers: Numbers) -> AbstractRandomAffine:
        """Return the law of the map given the reported numbers, a map without memory: what the receiver knows."""

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Return whether `believed` has a law for these numbers, a traced boolean; by default for all finite ones."""
        return jnp.all(jnp.isfinite(numbers))


class ToldMap(AbstractToldMap):
    """A map that is a function of the numbers that each message reports.

    Args:
        memory: draws the numbers.
        make: function of the numbers (count,) that returns a map, of the same sizes for all numbers.
        typical: an example of the numbers (count,).
        names: names of the numbers.
        exogenous: whether the numbers are independent of the plant's state.
        fresh: whether the map, given the numbers, is drawn independently with each message.

    Raises:
        ValueError: `make` returns no map, or a map with memory, delay or erasures.
    """

    memory: AbstractMemory
    make: Callable[[Numbers], AbstractRandomAffine]
    example: Numbers
    names: tuple[str, ...] = eqx.field(static=True)
    exogenous: bool = eqx.field(static=True)
    fresh: bool = eqx.field(static=True)
    sizes: tuple[int, int] = eqx.field(static=True)

    def __init__(
        self,
        memory: AbstractMemory,
        make: Callable[[Numbers], AbstractRandomAffine],
        typical: Numbers,
        names: tuple[str, ...],
        exogenous: bool = True,
        fresh: bool = True,
    ):
        """Hold a link z = G y + n whose law is make(numbers), for the numbers that `memory` draws at each step.

        `make` must return a map without memory, delay or erasures; make(typical), that of an example, is checked. A
        delay belongs outside, as a delay of this map: its numbers come with the message, and are of the same time.
        """
        self.memory, self.make, self.example, self.names = memory, make, typical, names
        self.exogenous, self.fresh = exogenous, fresh
        link = in_float64(make)(typical)  # for the checks and the sizes
        if not isinstance(link, AbstractRandomAffine):
            raise fail("link of what a message tells", "a function that returns a link", show_value(link))
        check_forgets("link of what a message tells", link)
        if link.past or link.erases:
            got = "one that is late" if link.past else "one that erases"
            raise fail("link of what a message tells", "one without delays and erasures, which go outside", got)
        self.sizes = link.outputs, link.inputs

    @property
    def outputs(self) -> int:
        """Length of z, that of the map of the example numbers."""
        outputs, _ = self.sizes
        return outputs

    @property
    def inputs(self) -> int:
        """Length of y, that of the map of the example numbers."""
        _, inputs = self.sizes
        return inputs

    @property
    def typical(self) -> Numbers:
        """The example of reported numbers (count,) that the constructor got."""
        return self.example

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractRandomAffine:
        """Return make(numbers), the link itself, for the numbers that a message reports of this memory state."""
        return self.believed(self.memory.announce(state))

    def believed(self, numbers: Numbers) -> AbstractRandomAffine:
        """Return make(numbers): the reported numbers determine the map, so that the receiver knows its law."""
        return self.make(numbers)

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Return whether make(numbers) has finite entries only, and noises with valid covariances.

        A variance of zero is valid only if it is zero for the example numbers too. Else it means that the variance is
        not known. A reported gain has no effect on the noise: it need only be finite.
        """
        if isinstance(self.make, ToldGainHop):
            return super().numbers_give_law(numbers)
        link = self.believed(numbers)
        typical_link = self.believed(jnp.asarray(self.typical))
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(link) if eqx.is_array(leaf)]
        pairs = zip(_list_noise_covariances(link), _list_noise_covariances(typical_link), strict=True)
        valid = [_is_covariance(matrix, typical) for matrix, typical in pairs]
        return jnp.all(jnp.stack([*finite, *valid]))

    def in_words(self) -> str:
        """Return the map of the example numbers in words, and the names of the reported numbers."""
        return f"{self.believed(self.typical).in_words()} {self._describe_told_numbers(', '.join(self.names))}"


class ToldGainHop(eqx.Module):
    """Function from a reported gain g to the hop z = g A y + n."""

    matrix: Matrix
    noise: AbstractNoise

    def __call__(self, numbers: Numbers) -> GainAndNoise:
        """Return the hop z = g A y + n, g = numbers[0], `matrix` A, and `noise` the law of n."""
        return GainAndNoise(Constant(numbers[0]), self.matrix, self.noise)


class PilotedHop(AbstractHop, AbstractToldMap):
    """Hop z = g A y + n whose messages report a noisy reading of the gain g, as from a pilot signal: a = g + e.

    Args:
        memory: draws gain g and reading a.
        matrix: A (m, p).
        noise: law of n with m components.
        fresh: whether the gain, given its reading, is drawn independently with each message.
    """

    memory: FreshReading
    matrix: Matrix
    noise: AbstractNoise
    names: tuple[str, ...] = eqx.field(static=True)
    exogenous: bool = eqx.field(static=True)
    fresh: bool = eqx.field(static=True)

    def __init__(self, memory: FreshReading, matrix: Matrix, noise: AbstractNoise, fresh: bool = True):
        """Hold the memory, which draws the gain g and its reading a = g + e, the matrix A and the law of the noise n.

        The one reported number is named "pilot". It is exogenous: link and plant are independent. `fresh`: given its
        reading, the gain is drawn independently with each message.
        """
        self.memory = memory
        self.matrix = matrix
        self.noise = noise
        self.names = ("pilot",)
        self.exogenous, self.fresh = True, fresh

    @property
    def optional(self) -> bool:
        """Always True: a filter can use z without the reading, by the law of the gain before any reading."""
        return True

    @property
    def typical(self) -> Numbers:
        """An example of the number that each message reports, a reading a = g + e of the gain: (E[g],), shape (1,).

        It is used to find the shapes and the kind of the map, not as an estimate.
        """
        numbers: Numbers = library(self.memory.law).stack([self.memory.law.moment(1)])
        return numbers

    def given(self, state: int | float | jax.Array | np.ndarray) -> GainAndNoise:
        """Return the hop with the gain g that was drawn, from the state (g, a) of the memory."""
        return GainAndNoise(Constant(jnp.asarray(state)[0]), self.matrix, self.noise)

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Return True always: if the reading is missing, the gain has its law p(g) before any reading."""
        return jnp.asarray(True)

    def believed(self, numbers: Numbers) -> GainAndNoise:
        """Return the hop with the law p(g | a) of the gain given its reading a = g + e, or p(g) where a is NaN.

        `numbers` (1,) is the reading a, and `memory.variance` the variance of its error e.
        """
        reading, error_variance = numbers[0], self.memory.variance
        law = gain_given_reading(self.memory.law, reading, error_variance)
        return GainAndNoise(law, self.matrix, self.noise)

    def in_words(self) -> str:
        """Return the hop in words, and that a reading of its gain is reported."""
        plain = GainAndNoise(self.memory.law, self.matrix, self.noise)
        return f"{plain.in_words()} {self._describe_told_numbers('a reading of its gain')}"


def list_told_maps(channel: AbstractRandomAffine) -> list[AbstractToldMap]:
    """Return the maps in a channel of which messages report numbers, in order of appearance.

    Maps that share a memory, and so the numbers that it draws, are counted once: the first of them is returned.
    """
    by_identity: dict[str, AbstractToldMap] = {}
    for leaf in jax.tree.leaves(channel, is_leaf=_is_told_map):
        if _is_told_map(leaf):
            by_identity.setdefault(leaf.memory.identity, leaf)
    return list(by_identity.values())


def list_told_numbers_of_outputs(channel: AbstractRandomAffine) -> Bool[np.ndarray, "outputs told"]:
    """Return at (i, j) whether the law of output i of a channel depends on reported number j.

    It does if number j belongs to a map inside the one of the channel's parallel maps that has output i. Numbers are in
    the order of `list_told_maps`.
    """
    # The identity of the memory from which each reported number comes.
    memory_of_number = [
        affine.memory.identity for affine in list_told_maps(channel) for _ in range(affine.memory.announced)
    ]
    rows = list[list[bool]]()
    for parallel_map in channel.in_parallel:
        memories_of_map = {affine.memory.identity for affine in list_told_maps(parallel_map)}
        rows += [[identity in memories_of_map for identity in memory_of_number]] * parallel_map.outputs
    return np.array(rows)


def condition_on_told_numbers(channel: T, numbers: Numbers) -> T:
    """Return the channel's law given the numbers that a message reported.

    Each map with reported numbers becomes the map that its receiver knows given them. All else stays, memories of modes
    too.

    Args:
        channel: a channel.
        numbers: the reported numbers of all its maps, concatenated in the order of `list_told_maps`.
    """
    numbers_by_memory = _share_numbers_by_map(channel, numbers)

    def believe(leaf: object) -> object:
        """Return the law of a map with reported numbers given them; return anything else unchanged."""
        return leaf.believed(numbers_by_memory[leaf.memory.identity]) if isinstance(leaf, AbstractToldMap) else leaf

    conditioned: T = jax.tree.map(believe, channel, is_leaf=_is_told_map)
    return conditioned


def numbers_give_law(channel: AbstractRandomAffine, numbers: Numbers) -> jax.Array:
    """Return whether the reported numbers give each of the channel's maps a law: finite, with valid covariances.

    Args:
        channel: a channel.
        numbers: the reported numbers of all its maps, concatenated in the order of `list_told_maps`.
    """
    numbers_by_memory = _share_numbers_by_map(channel, numbers)
    valid = []  # for each map, whether its numbers give it a law
    for affine in list_told_maps(channel):
        valid.append(affine.numbers_give_law(numbers_by_memory[affine.memory.identity]))
    return jnp.all(jnp.stack(valid))


def _share_numbers_by_map(channel: object, numbers: Numbers) -> dict[str, Numbers]:
    """Split the concatenated reported numbers of all maps; return those of each, with its memory's identity as key."""
    assert isinstance(channel, AbstractRandomAffine)
    numbers_by_memory, start = dict[str, Numbers](), 0
    for affine in list_told_maps(channel):
        numbers_by_memory[affine.memory.identity] = numbers[start : start + affine.memory.announced]
        start += affine.memory.announced
    return numbers_by_memory


def _list_noise_covariances(link: AbstractRandomAffine) -> list[jax.Array | np.ndarray]:
    """Return the covariance of each noise inside a link, in the order of its leaves."""
    leaves = jax.tree.leaves(link, is_leaf=lambda leaf: isinstance(leaf, AbstractNoise))
    return [leaf.covariance for leaf in leaves if isinstance(leaf, AbstractNoise)]


def _is_covariance(matrix: jax.Array | np.ndarray, typical: jax.Array | np.ndarray) -> jax.Array:
    """Return whether a matrix is a covariance up to rounding, with variances of 0 only where `typical` has 0 too."""
    lower, pivots = eliminate(jnp.asarray(matrix))
    variances = jnp.diagonal(jnp.asarray(matrix))
    are_positive = (variances > 0) | (jnp.asarray(jnp.diagonal(jnp.asarray(typical)) == 0) & (variances == 0))
    residual = jnp.abs(lower @ jnp.diag(jnp.maximum(pivots, 0.0)) @ lower.T - matrix)  # 0 if L diag(d) L', d >= 0
    return jnp.all(are_positive) & jnp.all(residual <= FACTOR_TOLERANCE * jnp.sqrt(jnp.outer(variances, variances)))


def make_laws_certain(link: T) -> T:
    """Return a link in which the probabilities of finitely many gains, or of modes, count as certain.

    JAX may trace them, so that a test whether they are uncertain has no answer.

    Raises:
        ValueError: probabilities that may be off.
    """

    def certain(leaf: object) -> object:
        """Return a law of finitely many gains, or a map of modes, with certain probabilities; else the leaf."""
        if isinstance(leaf, Discrete):
            return CertainDiscrete(leaf)
        if isinstance(leaf, AbstractModal) and isinstance(leaf.memory, MarkovChain):
            return eqx.tree_at(lambda modal: modal.memory, leaf, CertainChain(leaf.memory))
        return leaf

    certain_link: T = jax.tree.map(certain, link, is_leaf=lambda leaf: isinstance(leaf, Discrete | AbstractModal))
    return certain_link


def _is_told_map(leaf: object) -> bool:
    """Return whether an object is a map of which messages report numbers."""
    return isinstance(leaf, AbstractToldMap)
