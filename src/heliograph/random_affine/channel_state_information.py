"""Maps whose law depends on numbers told to the receiver with each message: gains, readings of gains, quality.

The world draws the numbers from a memory (`FreshNumbers`, a chain of modes); a told map is given them, and its receiver
is told them, or readings of them.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import eliminate
from heliograph.numerics.check import fail, scalar, show_value
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Bool, Float
from heliograph.random_affine.base import AbstractModal, AbstractRandomAffine, check_forgets
from heliograph.random_affine.hop import AbstractHop, GainAndNoise
from heliograph.random_affine.laws.gain_given_reading import gain_given_reading, require_density
from heliograph.random_affine.laws.law import AbstractLaw, CertainDiscrete, Constant, Discrete
from heliograph.random_affine.markov_chain_and_autoregression import (
    AbstractMemory,
    CertainChain,
    MarkovChain,
    MemoryStates,
    identify_memory,
)
from heliograph.random_affine.noise import FACTOR_TOLERANCE, AbstractNoise, Matrix

T = TypeVar("T")
Numbers = Float[jax.Array | np.ndarray, " told"]


class AbstractFreshDraw(AbstractMemory):
    """What is drawn anew at each step and told to the receiver, so that nothing is left to remember."""

    def move(self, state: jax.Array, key: jax.Array) -> jax.Array:
        """Draw the next state, whatever the last one was."""
        return self.begin(key)

    def nodes(self, degree: int) -> MemoryStates:
        """Raise ValueError: what a message tells is no hidden mode, whose states a filter would weigh."""
        expected = "a filter that takes what a message tells, such as linear_filter or extended_filter"
        raise fail("link whose gain or noise is told", expected, "what takes it for a mode that nobody is told")


class FreshNumbers(AbstractFreshDraw):
    """Numbers that are drawn anew at each step; a receiver is told all of them.

    Args:
        law: law of the numbers, of a gain for one of them; None where nobody knows it, and nothing can be simulated.
        count: how many.
        name: name by which links share the numbers; None for numbers of one link.
    """

    law: AbstractLaw | AbstractNoise | None
    count: int = eqx.field(static=True)
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(self, law: AbstractLaw | AbstractNoise | None, count: int, name: str | None = None):
        """Hold the joint law of `count` numbers and the name under which links share them."""
        self.law, self.count, self.name, self.identity = law, count, name, identify_memory(name)

    @property
    def announced(self) -> int:
        """Count of the numbers that are told: all of them."""
        return self.count

    def announce(self, state: int | float | jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        """Return the numbers."""
        return jnp.asarray(state)

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw the first numbers (count,) from their law; raise ValueError if there is none."""
        if self.law is None:
            raise fail("simulating what a message tells", "a law of the numbers: told(..., law=...)", "none")
        return jnp.reshape(self.law.sample(key), (self.count,))


class FreshReading(AbstractFreshDraw):
    """A gain that is drawn anew at each step, and its reading a = g + e, which alone the receiver is told.

    Args:
        law: law of the gain g.
        variance: of the error e of the reading, positive.
    """

    law: AbstractLaw
    variance: Float[Array, ""]
    name: str | None = eqx.field(static=True)
    identity: str = eqx.field(static=True)

    def __init__(self, law: AbstractLaw, variance: Float[Array, ""]):
        """Hold the law of the gain g and the variance of the reading error e."""
        self.law = require_density(law)
        self.variance = scalar("noise of a pilot", variance, np.finfo(float).tiny)
        self.name, self.identity = None, identify_memory(name=None)

    def announce(self, state: int | float | jax.Array | np.ndarray) -> jax.Array | np.ndarray:
        """Return the reading."""
        return jnp.asarray(state)[1:]

    def begin(self, key: jax.Array) -> jax.Array:
        """Draw (g, a) (2,), a gain g and its reading a = g + e, where the error e has the variance `variance`."""
        gain_key, error_key = jax.random.split(key)
        gain, error = self.law.sample(gain_key), jax.random.normal(error_key, dtype=float)
        return jnp.stack([gain, gain + jnp.sqrt(self.variance) * error])


class AbstractToldMap(AbstractModal):
    """A map of which the receiver is told numbers with each message: `given` is the world's, `believed` the receiver's.

    names: names of the numbers. exogenous: whether they are independent of the state, so that they tell of the link
    alone. fresh: whether what they leave open is drawn anew with each message, whatever is lost.
    """

    names: eqx.AbstractVar[tuple[str, ...]]
    exogenous: eqx.AbstractVar[bool]
    fresh: eqx.AbstractVar[bool]

    @property
    def reason_for_no_claim(self) -> str:
        """Why no covariance is claimed from the told numbers ("depends on the state"); "" if one is claimed."""
        of_state = [] if self.exogenous else ["depends on the state"]
        of_past = [] if self.fresh else ["leaves open what is not drawn anew with each message"]
        return " and ".join(of_state + of_past)

    def _describe_told_numbers(self, what: str) -> str:
        """Return in brackets what is told, and what is not promised of it."""
        return f"(told {what}{', not exogenous' * (not self.exogenous)}{', not fresh' * (not self.fresh)})"

    @property
    def optional(self) -> bool:
        """True if z means something where the numbers are missing."""
        return False

    @property
    @abstractmethod
    def typical(self) -> Numbers:
        """Numbers as they may come, for sizes and claims."""

    @abstractmethod
    def believed(self, numbers: Numbers) -> AbstractRandomAffine:
        """Return the map without memory, as the receiver knows it given the numbers."""

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Decide whether numbers give a law; by default all that are finite do."""
        return jnp.all(jnp.isfinite(numbers))


class ToldMap(AbstractToldMap):
    """A map that is a function of the numbers that are told.

    Args:
        memory: draws the numbers.
        make: function of the numbers (count,) that returns a map, of the same sizes for all numbers.
        typical: numbers as they may come.
        names: names of the numbers.
        exogenous: whether they are independent of the state.
        fresh: whether what they leave open is drawn anew with each message.

    Raises:
        ValueError: a function that returns no map, or one that remembers, is late, or loses what the receiver sees.
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
        """Hold the memory that draws the numbers and the function `make(numbers)`; check `make(typical)`."""
        self.memory, self.make, self.example, self.names = memory, make, typical, names
        self.exogenous, self.fresh = exogenous, fresh
        link = in_float64(make)(typical)
        if not isinstance(link, AbstractRandomAffine):
            raise fail("link of what a message tells", "a function that returns a link", show_value(link))
        check_forgets("link of what a message tells", link)
        if link.past or link.erases:
            got = "one that is late" if link.past else "one that erases"
            raise fail("link of what a message tells", "one without delays and erasures, which go outside", got)
        self.sizes = link.outputs, link.inputs

    @property
    def outputs(self) -> int:
        """Length of z."""
        return self.sizes[0]

    @property
    def inputs(self) -> int:
        """Length of y."""
        return self.sizes[1]

    @property
    def typical(self) -> Numbers:
        """The numbers of a typical message: the example that was given."""
        return self.example

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractRandomAffine:
        """Return the map of the numbers that belong to this state."""
        return self.believed(self.memory.announce(state))

    def believed(self, numbers: Numbers) -> AbstractRandomAffine:
        """Return the map of these numbers."""
        return self.make(numbers)

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Decide whether the map of these numbers has finite entries only, and noises with valid covariances.

        A variance of zero is valid only if it is zero for typical numbers too. Else it means that the variance is not
        known. A told gain has no effect on the noise.
        """
        if isinstance(self.make, ToldGainHop):
            return super().numbers_give_law(numbers)
        link, typical_link = self.believed(numbers), self.believed(jnp.asarray(self.typical))
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(link) if eqx.is_array(leaf)]
        pairs = zip(_list_noise_covariances(link), _list_noise_covariances(typical_link), strict=True)
        valid = [_is_covariance(matrix, typical) for matrix, typical in pairs]
        return jnp.all(jnp.stack([*finite, *valid]))

    def in_words(self) -> str:
        """Return the map of typical numbers in words, and what is told."""
        return f"{self.believed(self.typical).in_words()} {self._describe_told_numbers(', '.join(self.names))}"


class ToldGainHop(eqx.Module):
    """The hop z = g A y + n of a gain g that is told."""

    matrix: Matrix
    noise: AbstractNoise

    def __call__(self, numbers: Numbers) -> GainAndNoise:
        """Return the hop of this gain."""
        return GainAndNoise(Constant(numbers[0]), self.matrix, self.noise)


class PilotedHop(AbstractHop, AbstractToldMap):
    """Hop z = g A y + n whose receiver is told a reading of its gain, as by a pilot: a = g + e.

    Args:
        memory: draws gain and reading.
        matrix: A (m, p).
        noise: law of n with m components.
        fresh: whether what a reading leaves open of the gain is drawn anew with each message.
    """

    memory: FreshReading
    matrix: Matrix
    noise: AbstractNoise
    names: tuple[str, ...] = eqx.field(static=True)
    exogenous: bool = eqx.field(static=True)
    fresh: bool = eqx.field(static=True)

    def __init__(self, memory: FreshReading, matrix: Matrix, noise: AbstractNoise, fresh: bool = True):
        """Hold the drawn gain with its reading, the matrix A and the law of the noise n."""
        self.memory, self.matrix, self.noise, self.names = memory, matrix, noise, ("pilot",)
        self.exogenous, self.fresh = True, fresh

    @property
    def optional(self) -> bool:
        """Always True: without a reading the gain has its own law."""
        return True

    @property
    def typical(self) -> Numbers:
        """The number that is told in a typical message: the mean gain."""
        numbers: Numbers = library(self.memory.law).stack([self.memory.law.moment(1)])
        return numbers

    def given(self, state: int | float | jax.Array | np.ndarray) -> GainAndNoise:
        """Return the hop of the gain that was drawn."""
        return GainAndNoise(Constant(jnp.asarray(state)[0]), self.matrix, self.noise)

    def numbers_give_law(self, numbers: Numbers) -> jax.Array:
        """Return True: without a reading the gain has its own law."""
        return jnp.asarray(True)

    def believed(self, numbers: Numbers) -> GainAndNoise:
        """Return the hop of the gain's law given the reading; its own law where none came."""
        law = gain_given_reading(self.memory.law, numbers[0], self.memory.variance)
        return GainAndNoise(law, self.matrix, self.noise)

    def in_words(self) -> str:
        """Return the hop in words, and what is told."""
        plain = GainAndNoise(self.memory.law, self.matrix, self.noise)
        return f"{plain.in_words()} {self._describe_told_numbers('a reading of its gain')}"


def list_told_maps(channel: AbstractRandomAffine) -> list[AbstractToldMap]:
    """Return the maps in a channel whose numbers are told by messages, one map for each memory that draws numbers."""
    by_identity: dict[str, AbstractToldMap] = {}
    for leaf in jax.tree.leaves(channel, is_leaf=_is_told_map):
        if _is_told_map(leaf):
            by_identity.setdefault(leaf.memory.identity, leaf)
    return list(by_identity.values())


def list_told_numbers_of_outputs(channel: AbstractRandomAffine) -> Bool[np.ndarray, "outputs told"]:
    """Return for each output of a channel on which told numbers it depends: those that its own maps draw."""
    identities = [affine.memory.identity for affine in list_told_maps(channel) for _ in range(affine.memory.announced)]
    rows = list[list[bool]]()
    for parallel_map in channel.in_parallel:
        identities_of_map = {affine.memory.identity for affine in list_told_maps(parallel_map)}
        rows += [[identity in identities_of_map for identity in identities]] * parallel_map.outputs
    return np.array(rows)


def condition_on_told_numbers(channel: T, numbers: Numbers) -> T:
    """Return the channel as a receiver knows it that was told these numbers.

    Args:
        channel: a channel, whose other memories stay.
        numbers: the told numbers of all its maps, in the order of `list_told_maps`.
    """
    numbers_by_memory = _share_numbers_by_map(channel, numbers)

    def believe(leaf: object) -> object:
        """Return a told map as its receiver knows it given its numbers; return anything else unchanged."""
        return leaf.believed(numbers_by_memory[leaf.memory.identity]) if isinstance(leaf, AbstractToldMap) else leaf

    conditioned: T = jax.tree.map(believe, channel, is_leaf=_is_told_map)
    return conditioned


def numbers_give_law(channel: AbstractRandomAffine, numbers: Numbers) -> jax.Array:
    """Return whether the told numbers give a law of each of the channel's maps: finite numbers and valid covariances.

    Args:
        channel: a channel.
        numbers: the told numbers of all its maps, in the order of `list_told_maps`.
    """
    by_memory, told_maps = _share_numbers_by_map(channel, numbers), list_told_maps(channel)
    return jnp.all(jnp.stack([affine.numbers_give_law(by_memory[affine.memory.identity]) for affine in told_maps]))


def _share_numbers_by_map(channel: object, numbers: Numbers) -> dict[str, Numbers]:
    """Split the told numbers by map, and return them by the identity of each map's memory."""
    assert isinstance(channel, AbstractRandomAffine)
    numbers_by_memory, start = dict[str, Numbers](), 0
    for affine in list_told_maps(channel):
        numbers_by_memory[affine.memory.identity] = numbers[start : start + affine.memory.announced]
        start += affine.memory.announced
    return numbers_by_memory


def _list_noise_covariances(link: AbstractRandomAffine) -> list[jax.Array | np.ndarray]:
    """Return the covariances of all noises in a link."""
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
    """Return a link whose laws of finitely many gains or modes count as certain, even where their numbers are traced.

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
    """Return whether an object is a map of which numbers are told."""
    return isinstance(leaf, AbstractToldMap)
