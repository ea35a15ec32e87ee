"""Random affine maps z = G y + n: a sampler and joint moments of one matrix H = [[G, n], [0, 1]]."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

import jax
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import fail, items, show_value
from heliograph.numerics.module import Module, are_same, readable, unwritten
from heliograph.numerics.numpy_or_jax import is_traced, stack_parts
from heliograph.numerics.types import Bool, Float, PyTree
from heliograph.random_affine.memories_of_channels import (
    AbstractWithMemory,
    draw_with_shared_memories,
    init_with_shared_memories,
    memories,
)
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain
from heliograph.random_affine.moments.interval_products import CORNERS, Interval
from heliograph.random_affine.moments.mixture_components import AffineComponent
from heliograph.random_affine.moments.monomials import JointMoments, give_moments
from heliograph.random_affine.moments.signal_path import (
    ChannelPosition,
    SignalMoment,
    Visit,
    carry_by_moments,
    refuse_gain_on_angles,
)
from heliograph.random_affine.noises.noise import AbstractNoise

T = TypeVar("T")
KnownGains = Bool[np.ndarray, " m"]
SameNoise = Callable[[AbstractNoise, AbstractNoise], bool]


@readable
class AbstractRandomAffine(Module):
    """A random affine map z = G y + n, one at each step.

    Laws: `sample` and `moments` describe one distribution (heliograph.testing.check_random_affine compares them);
    (G, n) are independent of y, but not of each other: a shared hop makes them dependent.

    A map that forgets is drawn independently at each step: it defines `sample`. A map that remembers has a state, on
    which the next draw depends: it defines `init` and `draw`, and says so by `remembers`. A map that holds others
    passes their states on; but not those of modes (`AbstractModal`), each of which is drawn once here, however many
    maps inside share it. A class says its sizes, how it is drawn, and its moments, and whatever else it knows: the
    methods below answer for any map, or refuse.
    """

    formulas = "moments", "mean_gain", "list_atoms", "extremes", "list_outcomes"

    def __init_subclass__(cls, **options: object) -> None:
        """Wrap the class's own `moments`, which may return the matrix alone, so that it returns `JointMoments`."""
        super().__init_subclass__(**options)
        if (own_moments := cls.__dict__.get("moments")) is not None:
            type.__setattr__(cls, "moments", give_moments(own_moments))

    @property
    def outputs(self) -> int:
        """Length of z."""
        raise unwritten(self, "outputs")

    @property
    def inputs(self) -> int:
        """Length of y."""
        raise unwritten(self, "inputs")

    @property
    def erases(self) -> bool:
        """True if outputs can be NaN: lost, and the receiver knows; by default, if a map among the fields erases."""
        return any(affine.erases for affine in inner_maps(self))

    @property
    def past(self) -> int:
        """Largest delay in steps: the inputs are y_k, y_{k-1}, ..., y_{k-past}, stacked."""
        return max((affine.past for affine in inner_maps(self)), default=0)

    @property
    def remembers(self) -> bool:
        """True if a draw depends on earlier draws; by default, if a map among the fields remembers."""
        return any(affine.remembers for affine in inner_maps(self))

    def init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Draw the state before the first draw; it is () for a map whose draws are independent over time."""
        memories_inside = memories(self)  # the memories of links inside, by identity
        if not memories_inside:
            return self._init(key)
        # A key for each memory, which is drawn once even where several maps inside share it, and one for the maps.
        key_of_maps, *keys = jax.random.split(key, len(memories_inside) + 1)
        return init_with_shared_memories(self, key_of_maps, keys)

    def draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw the next state, of the same structure and shapes, and H = [[G, n], [0, 1]] (outputs + 1, inputs + 1)."""
        memories_inside = memories(self)
        if not memories_inside:
            return self._draw(state, key)
        # A key for each memory, which moves once even where several maps inside share it, and one for the maps.
        key_of_maps, *keys = jax.random.split(key, len(memories_inside) + 1)
        return draw_with_shared_memories(self, state, key_of_maps, keys)

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Draw the initial state of a map without memories inside; by default (), as of independent draws."""
        if self.remembers:
            raise fail(f"init of {type(self).__name__}", "one of its own, since it or a map inside remembers", "none")
        return ()

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw the next state and H of a map without memories inside; this default draws H by `sample`."""
        if self.remembers:
            raise fail(f"draw of {type(self).__name__}", "one of its own, since it or a map inside remembers", "none")
        if type(self).sample is AbstractRandomAffine.sample:
            raise unwritten(self, "sample")
        return state, self.sample(key)

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw H = [[G, n], [0, 1]] of shape (outputs + 1, inputs + 1).

        Raises:
            ValueError: the map remembers, so that there is no draw without its state.
        """
        if self.remembers:
            title = f"sample of {type(self).__name__}"
            raise fail(title, "a map that forgets", "one that remembers; use init and draw")
        _, matrix = self.draw((), key)
        return matrix

    def moments(self, order: int) -> JointMoments:
        """Return the nominal E[Sym^order(H)], which takes monomials of (y, 1) to means of those of (z, 1).

        Draws must be independent over time. A map of your own may return the matrix alone.

        Raises:
            ValueError: a matrix of more than the stated memory; a map that remembers, since the moments of one step
                then do not determine those of the next.
        """
        check_forgets("moments of a map", self)
        raise unwritten(self, "moments")

    # The laws that are possible where probabilities are known within a radius.

    def extremes(self) -> tuple["AbstractRandomAffine", ...]:
        """Return the maps with the extreme laws, vertices of the set of possible laws; itself if its law is known."""
        return (self,)

    def corner_count(self) -> int:
        """Return the number of maps that `extremes` lists."""
        return len(self.extremes())

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner rows columns"]:
        """Return E[Sym^order(H)] of each of the `extremes`."""
        return stack_parts([m.moments(order).matrix for m in self.extremes()])

    def moment_interval(self, order: int) -> Interval:
        """Return the lowest and highest value of each entry of E[Sym^order(H)] over the possible laws.

        Up to CORNERS corner (extreme) laws the ends are exact, since every entry is linear in each uncertain law. With
        more corners, or if they are not counted (None), intervals of the parts are multiplied: these may be too wide.
        """
        check_forgets("channel of a bound", self)
        corner_count = count_corners(self)
        if corner_count is None or corner_count > CORNERS:
            return self._interval_of_parts(order)
        matrices = self.corner_moments(order)
        return matrices.min(axis=0), matrices.max(axis=0)

    def _interval_of_parts(self, order: int) -> Interval:
        """Return an interval of each entry of E[Sym^order(H)], from those of the maps inside; by default, refuse."""
        raise fail("uncertain channel", f"at most {CORNERS} corner laws", count_corners(self))

    def mean_gain(self) -> "AbstractRandomAffine":
        """Return the map whose gains are constant at their means; noises stay."""
        raise unwritten(self, "mean_gain")

    # What comes through, from what goes in.

    @property
    def known_gains(self) -> KnownGains:
        """Which components of z = G y + n have a constant row of G (m,)."""
        return self.carry_known_gains(np.ones(self.inputs, dtype=bool))

    @property
    def has_known_gain(self) -> bool:
        """True if z = G y + n has a constant G."""
        return bool(np.all(self.known_gains))

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Find which outputs have a known gain, from which of the inputs have; by default none."""
        return np.zeros(self.outputs, dtype=bool)

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the components of z that are angles, from `sent`, the indices of the angles in y.

        Raises:
            ValueError: an angle of y is multiplied by a gain other than 1; in this default, any angle is sent.
        """
        if sent:
            raise refuse_gain_on_angles(type(self).__name__)
        return ()

    def carry_signal(self, signal: SignalMoment) -> SignalMoment:
        """Return the second moment E[(z, 1) (z, 1)'] of the output given that it arrives, and P(it arrives).

        `signal` holds the same of y. This default is for maps without losses: E[Sym^2(H)] gives the moment, and the
        probability stays. A relay behind this map transmits with a power that follows from the moment.

        Raises:
            ValueError: the map erases, so that this default does not know with which probability z arrives.
        """
        if self.erases:
            raise fail("transmitter behind a loss", "a chain that erases", type(self).__name__)
        return carry_by_moments(signal, self.moments(2))

    # What it is made of: memories, losses, atoms, noises.

    def degree_in(self, identity: str) -> int:
        """Return the degree of H as a polynomial in a memory's state: 1 for each map in series that it fades."""
        return sum(affine.degree_in(identity) for affine in inner_maps(self))

    def condition_on_arrival(self) -> "AbstractRandomAffine":
        """Return the map given that everything arrives, where losses are independent of gains.

        Raises:
            ValueError: losses that depend on gains; in this default, any losses.
        """
        if self.erases:
            raise fail("channel", "erasures of channels, not mixtures of them", type(self).__name__)
        return self

    def list_outcomes(self) -> list["ArrivalOutcome"]:
        """Return each combination of lost outputs of positive probability (one if nothing is lost), with its map."""
        check_forgets("channel with erasures", self)
        if not self.erases:
            return [ArrivalOutcome(1.0, self, np.ones(self.outputs, dtype=bool))]
        return [case for case in self._outcomes() if is_traced(case.probability) or case.probability > 0]

    def _outcomes(self) -> list["ArrivalOutcome"]:
        """Return the sets of losses of a map that erases; by default a refusal."""
        raise fail("channel with erasures", "erasures in series and stacks", type(self).__name__)

    def list_atoms(self) -> list[AffineComponent]:
        """Return all combinations of gains and noises, where these are finitely many; by default a refusal."""
        raise fail("mixture filter", "maps made of hops, series, stacks, sums and mixtures", type(self).__name__)

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [G, N], with which z = G y + N d for a disturbance d.

        An H-infinity design treats the noise n as N d, where d is any disturbance of finite energy. N is a root of the
        noise's covariance, R = N N', with rank(R) columns. Noises stand in the order in which the signal meets them.
        Uncertain probabilities count as nominal.

        Raises:
            ValueError: no d gives the noise's mean, N d = E[n]; or the moments are not known, as by default.
        """
        raise fail("channel", "hops, series, mixtures, stacks and sums of them", type(self).__name__)

    def detach_outliers(self) -> tuple["AbstractRandomAffine", AbstractNoise | None]:
        """Return the map with the mean of its last noise, and that noise, if it has outliers; else itself and None."""
        return self, None

    # How it is written: words, series, hops, and another map beside it.

    def in_words(self) -> str:
        """Return a text such as "Rician hop → hop 1.1" for messages; "" if z are unchanged components of y."""
        return type(self).__name__

    @property
    def in_series(self) -> list["AbstractRandomAffine"]:
        """The maps applied one after another, with z = H_last ... H_1 y; [self] unless the map is a `Series`."""
        return [self]

    @property
    def in_parallel(self) -> list["AbstractRandomAffine"]:
        """The maps of one y whose outputs are concatenated to z, at any depth; [self] unless the map is a `Stack`."""
        return [self]

    def covers(self, actual: "AbstractRandomAffine", same_noise: SameNoise) -> bool:
        """Return whether a filter that assumes this map is right for the `actual` map, through which signals pass.

        Both must be built alike, and all laws that the actual map may have must be possible under this one.
        `same_noise` tests whether two noises agree.
        """
        if are_same(self, actual):
            return True
        assumed_series, actual_series = self.in_series, actual.in_series
        if len(assumed_series) == 1 == len(actual_series):
            return assumed_series[0].covers_kind(actual_series[0], same_noise)
        pairs = zip(assumed_series, actual_series, strict=False)
        return len(assumed_series) == len(actual_series) and all(x.covers(y, same_noise) for x, y in pairs)

    def covers_kind(self, actual: "AbstractRandomAffine", same_noise: SameNoise) -> bool:
        """Return `covers(actual)` for two maps that are no series: by default, whether they are equal."""
        return are_same(self, actual)

    @property
    def is_silent(self) -> bool:
        """True if z = n whatever y is, as in a packet loss or in a mode without reception."""
        return False

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple["AbstractRandomAffine", ChannelPosition]:
        """Return the map with visit(name, hop, signal) in place of each hop, and the position behind the map.

        A hop is a transmitter with its link; a visit may list it or change its power.

        Args:
            visit: function of a hop's name, the hop and the second moment of what it receives, which returns a hop.
            position: where the map begins: prefix of names, number of hops before, second moment of the signal there.

        Raises:
            ValueError: a map whose transmitters are not known; in this default, every map.
        """
        expected = "hops in series, stacks, sums, mixtures, modes, losses and delays"
        raise fail("transmitters of a channel", expected, type(self).__name__)

    def example_input(self, generator: np.random.Generator) -> np.ndarray:
        """Return a point at which moments can be compared with samples (a lifted map takes only lifted points)."""
        return generator.normal(size=self.inputs)


def inner_maps(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return the maps among a map's fields, at any depth of containers and modules, but not those inside other maps."""
    return [leaf for leaf in _flatten_to_inner_maps(channel)[0] if isinstance(leaf, AbstractRandomAffine)]


def all_inner_maps(channel: AbstractRandomAffine) -> list[AbstractRandomAffine]:
    """Return the maps inside a map, and those inside them."""
    return [m for affine in inner_maps(channel) for m in (affine, *all_inner_maps(affine))]


def replace_inner_maps(channel: T, maps: Sequence[AbstractRandomAffine]) -> T:
    """Return the map with these maps in place of its `inner_maps`, or the map itself if they are the same objects."""
    leaves, tree = _flatten_to_inner_maps(channel)  # each inner map is a leaf
    next_map = iter(maps)
    changed = [next(next_map) if isinstance(leaf, AbstractRandomAffine) else leaf for leaf in leaves]
    are_unchanged = all(after is before for after, before in zip(changed, leaves, strict=True))
    result: T = channel if are_unchanged else jax.tree.unflatten(tree, changed)
    return result


def _flatten_to_inner_maps(channel: object) -> tuple[list[PyTree], jax.tree_util.PyTreeDef]:
    """Flatten a map as a JAX pytree, but keep the maps among its fields whole; return the leaves and the tree."""
    return jax.tree.flatten(channel, is_leaf=lambda x: x is not channel and isinstance(x, AbstractRandomAffine))


@cache_by_object
def count_corners(channel: AbstractRandomAffine) -> int | None:
    """Return the number of extreme laws ("corners") of a map's possible laws; None if there are too many to count."""
    try:
        return channel.corner_count()
    except ValueError:  # a law has too many uncertain atoms for a list of its corners
        return None


class ArrivalOutcome(NamedTuple):
    """With `probability` just the outputs in `arrived` arrive, by the random affine map `map`; the receiver sees it."""

    probability: float | jax.Array
    map: AbstractRandomAffine
    arrived: Bool[np.ndarray, " outputs"]


class AbstractModal(AbstractWithMemory, AbstractRandomAffine):
    """Random affine map whose law at each step depends on a state, such as a Markov chain's: the link's memory."""

    @property
    def remembers(self) -> bool:
        """Always True: the law of H depends on the state of the memory."""
        return True

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractRandomAffine:
        """Return the map z = G y + n that the link is while its memory has this state; it has no memory itself."""
        raise unwritten(self, "given")

    @property
    def memory_in_words(self) -> str:
        """Name of the memory and a colon, as a prefix of texts such as "'fading': hop"; "" if it has no name."""
        return "" if self.memory.name is None else f"{self.memory.name!r}: "

    def degree_in(self, identity: str) -> int:
        """Return the degree of H in the state of the memory of this `identity`: 1 for its own memory, else 0."""
        return int(self.memory.identity == identity)


def check_maps(name: str, maps: Sequence[AbstractRandomAffine]) -> tuple[AbstractRandomAffine, ...]:
    """Check that `maps` is a sequence of at least one random affine map, and return it as a tuple."""
    checked = tuple(items(name, maps, "random affine maps"))
    if not checked:
        raise fail(name, "at least one map", "none")
    for affine in checked:
        if not isinstance(affine, AbstractRandomAffine):
            raise fail(name, "random affine maps (hops, and maps made of them)", show_value(affine))
    return checked


def check_forgets(name: str, channel: AbstractRandomAffine) -> None:
    """Raise ValueError, about what is called `name`, unless the draws of the map are independent over time."""
    if channel.remembers:
        raise fail(name, "one that forgets", f"{type(channel).__name__}, which remembers")
