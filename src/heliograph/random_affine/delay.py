"""Delayed links: at step k arrives what was sent d steps before; and such links in series, whose relays may store."""

from collections.abc import Sequence
from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import check_count, fail, instance, show_value
from heliograph.numerics.module import unwritten
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_maps, replace_inner_maps
from heliograph.random_affine.composite import DIRECT, AbstractMapWrapper
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import Discrete
from heliograph.random_affine.markov_chain_and_autoregression import MarkovChain
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.modes import Modes
from heliograph.random_affine.moments.monomials import JointMoments
from heliograph.random_affine.moments.signal_path import ChannelPosition, SignalMoment, Visit
from heliograph.random_affine.series_and_stack import Series, Stack

# Steps; their law at each step; or a chain whose mode is the number of steps.
Delay = TypeAliasType("Delay", int | Discrete | MarkovChain)
T = TypeVar("T")


class AbstractDelayLine(AbstractMapWrapper):
    """Link with a delay, as a map of the delay line (y_k, y_{k-1}, ..., y_{k-past}) of the last signals, stacked."""

    @property
    def line(self) -> AbstractRandomAffine:
        """The same map without delay: its input is the stacked delay line (y_k, y_{k-1}, ..., y_{k-past})."""
        raise unwritten(self, "line")

    @property
    def parts(self) -> Sequence[AbstractRandomAffine]:
        """The one map inside: `line`, the map of the stacked signals."""
        return (self.line,)

    def rebuilt(self, *parts: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return a delay line of the same length with parts[0] as the map of the stacked signals."""
        return DelayLine(parts[0], self.past)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Return the next state and H of `line`, the map of the stacked signals."""
        return self.line.draw(state, key)

    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^order(H)] of `line`, the map of the stacked signals.

        Sym^order(H) maps the monomials of (y, 1) of this degree to those of (z, 1).
        """
        return self.line.moments(order)


class DelayLine(AbstractDelayLine):
    """Link that is given what was sent at this step and at the `past` steps before: z_k = G (y_k, ..., y_{k-past}) + n.

    A link that delivers the mean of the last two signals is `DelayLine(Series([known([[0.5, 0.5]]), link]), 1)`. Before
    the first step zeros were sent. The best linear filter estimates the past states too, and so knows all of it.

    Args:
        link: map of 1 + past signals one above the other, the newest first.
        past: steps back that it reaches, at least 1.

    Raises:
        ValueError: no map; fewer steps; inputs that are not those of so many signals.
    """

    link: AbstractRandomAffine
    steps: int = eqx.field(static=True)

    def __init__(self, link: AbstractRandomAffine, past: int):
        """Hold the link, a map of a line of 1 + `past` signals: the present one and past ones, the newest first."""
        check_maps("link", [link])
        self.link, self.steps = link, check_count("past", past)
        if link.inputs % (1 + past):
            raise fail("link", f"inputs of {1 + past} signals of one length", link.inputs)

    @property
    def line(self) -> AbstractRandomAffine:
        """The map of the stacked delay line (y_k, ..., y_{k-past}): the constructor's `link` takes just this input."""
        return self.link

    @property
    def past(self) -> int:
        """Number of past signals in the delay line (y_k, ..., y_{k-past})."""
        return self.steps

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the angles of the map, from the angles of what was sent at each of the steps that may arrive."""
        size = signal_size(self)
        return self.line.carry_angles(tuple(t * size + i for t in range(1 + self.past) for i in sent))

    def in_words(self) -> str:
        """Return the map in words, and how many signals it is given."""
        return f"{self.link.in_words() or DIRECT}, of the last {self.steps + 1} signals"

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map with visit(name, hop, signal) in place of each hop of the link, which receives the line.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        plain, position = self.link.visit_hops(visit, position.on_delay_line(self.inputs // signal_size(self)))
        return replace_inner_maps(self, [plain]), position


class DelayedLink(AbstractDelayLine):
    """Delayed link z_k = G_k y_{k-d} + n_k: at step k arrives what was sent d steps before.

    As a map of the line its mean gain is E[G] sum_d p_d S_d, where S_d selects y_{k-d}, and its spread that of the
    mixture. Before the first step zeros were sent.

    Args:
        link: the link without delay.
        delay: d in steps; a `Discrete` law from which d is drawn at each step; or a `MarkovChain` whose mode is d.
        timestamped: True if d is received too, as the last number; False unless given.
    """

    link: AbstractRandomAffine
    delay: AbstractRandomAffine  # from the line to the link's input, and to d where it is stamped
    times: tuple[int, ...] = eqx.field(static=True)
    timestamped: bool = eqx.field(static=True)

    def __init__(self, link: AbstractRandomAffine, delay: Delay, timestamped: bool = False):
        """Hold the link, and the delay as a map of its own from the line (y_k, y_{k-1}, ...) to the link's input.

        For a delay of d steps that map is the selection S_d, which takes y_{k-d} from the line. For a random delay it
        is a mixture of these with its probabilities, and for a chain one selection for each mode.
        """
        (self.link,) = check_maps("delayed link", [link])
        if link.past:
            raise fail("delayed link", "one that is not late itself", f"one late by up to {link.past} steps")
        self.times = _list_delays(delay)
        self.timestamped = instance("timestamped", timestamped, bool, "True or False")
        # The selection S_d of each possible delay, drawn by its law, by a chain, or certain.
        selections = [_make_delay_selection(d, self.past, link.inputs, timestamped) for d in self.times]
        match delay:
            case Discrete():
                self.delay = Mixture(selections, delay.probabilities, delay.radius)
            case MarkovChain():
                self.delay = Modes(delay, selections)
            case _:
                self.delay = selections[0]

    @property
    def line(self) -> AbstractRandomAffine:
        """The map from the delay line (y_k, ..., y_{k-past}): `delay` selects y_{k-d}, and the link transmits it.

        With time stamps the delay d is one more output, which does not pass through the link.
        """
        if not self.timestamped:
            return Series([self.delay, self.link])
        m = self.link.inputs
        signal_rows, stamp_row = np.split(np.eye(m + 1), [m])
        return Series([self.delay, Stack([Series([known(signal_rows), self.link]), known(stamp_row)])])

    @property
    def past(self) -> int:
        """Longest possible delay in steps, which is the number of past signals in the delay line."""
        return max(self.times)

    @property
    def constant(self) -> bool:
        """True if the delay is one number of steps, and not drawn from a law or given by a chain."""
        return isinstance(self.delay, GainAndNoise)

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the angles of the link; a time stamp stands after them."""
        return self.link.carry_angles(sent)

    def in_words(self) -> str:
        """Return the link in words, and how late it is."""
        late = f"{'/'.join(map(str, self.times))} steps late{', timestamped' if self.timestamped else ''}"
        return f"{self.link.in_words() or DIRECT}, {late}"

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map with visit(name, hop, signal) in place of each hop of the link, and the position behind it.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        link, position = self.link.visit_hops(visit, position)
        return replace_inner_maps(self, [link, self.delay]), position

    def carry_signal(self, signal: SignalMoment) -> SignalMoment:
        """Return E[(z, 1) (z, 1)'] behind the link, taking y_{k-d} to have the same moment `signal` as y_k."""
        return self.link.carry_signal(signal)

    def given(self, d: int) -> AbstractRandomAffine:
        """Return the map of the line for one delay d, without the time stamp."""
        return Series([_make_delay_selection(d, self.past, self.link.inputs, False), self.link])


def _list_delays(delay: Delay) -> tuple[int, ...]:
    """Return the possible delays in steps, which are the modes of a chain; raise ValueError for anything else."""
    match delay:
        case Discrete():
            values = [int(d) if d == int(d) else float(d) for d in np.asarray(delay.values)]
        case MarkovChain():
            values = list(range(delay.modes))
        case int() | np.integer():
            values = [delay]
        case _:
            raise fail("delay", "a number of steps, a Discrete law or a MarkovChain of it", show_value(delay))
    return tuple(check_count("delay", d, least=0) for d in values)


def _make_delay_selection(d: int, longest: int, size: int, timestamped: bool) -> GainAndNoise:
    """Return the map S_d, which selects the signal of d steps ago from the delay line.

    The line holds the last `longest` + 1 signals, each with `size` numbers, the newest first. With time stamps the
    number d is appended to the signal.
    """
    rows = np.kron(np.eye(1, longest + 1, d), np.eye(size))
    if not timestamped:
        return known(rows)
    with_row_for_stamp = np.pad(rows, ((0, 1), (0, 0)))
    return known(with_row_for_stamp, offset=np.append(np.zeros(size), float(d)))


def place_on_delay_line(channel: T) -> T:
    """Return the channel, or tree of channels, with each channel that delays replaced by a map of the delay line.

    The line is (y_k, y_{k-1}, ...), the present signal and past ones. The map itself has no delay.
    """

    def take_line(leaf: object) -> object:
        """Return the map of the delay line for a channel with delays; return anything else unchanged."""
        return leaf.line if isinstance(leaf, AbstractDelayLine) else leaf

    replaced: T = jax.tree.map(take_line, channel, is_leaf=lambda leaf: isinstance(leaf, AbstractDelayLine))
    return replaced


def signal_size(channel: AbstractRandomAffine) -> int:
    """Return how many numbers are sent to a channel at each step: its inputs, without those of past signals."""
    return channel.inputs // (1 + channel.past)


def place_channel_of_part(channel: AbstractRandomAffine, total: int, start: int, past: int) -> AbstractRandomAffine:
    """Return a channel of the part y[start:start + size] as a channel of all of y (total,) with a delay line.

    The line (y_k, y_{k-1}, ...) has `past` past signals, at least as many as the channel's own line.
    """
    longest, size = channel.past, signal_size(channel)
    # The channel takes its part of each signal in the line, present and past.
    rows = np.concatenate([t * total + start + np.arange(size) for t in range(longest + 1)])
    on_line = Series([known(np.eye((1 + past) * total)[rows]), place_on_delay_line(channel) if longest else channel])
    return DelayLine(on_line, past) if past else on_line
