"""Delayed links: at step k arrives what was sent d steps before; and such links in series, whose relays may store."""

from collections.abc import Sequence
from functools import reduce
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
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
    """Map of the tapped delay line (y_k, y_{k-1}, ..., y_{k-past}), stacked."""

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
        """Return E[Sym^order(H)] of `line`, the map of the stacked signals."""
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
        """Return the map with visit(name, hop, signal) in place of each hop of the link, which receives the line."""
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
        """Hold the link and, for each possible delay d, the selection S_d of y_{k-d} with its probability or mode."""
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
        """Longest delay in steps."""
        return max(self.times)

    @property
    def constant(self) -> bool:
        """True if the delay never varies."""
        return isinstance(self.delay, GainAndNoise)

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the angles of the link; a time stamp stands after them."""
        return self.link.carry_angles(sent)

    def in_words(self) -> str:
        """Return the link in words, and how late it is."""
        late = f"{'/'.join(map(str, self.times))} steps late{', timestamped' if self.timestamped else ''}"
        return f"{self.link.in_words() or DIRECT}, {late}"

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the map with visit(name, hop, signal) in place of each hop of the link, and the position behind it."""
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
    """Return the numbers that are sent to a channel at each step."""
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


class RelayStorage(AbstractMapWrapper):
    """Storage of a relay: the signals r that it received now and in the last `steps` steps, (r_k, ..., r_{k-steps}).

    r_k = H_k (y_k, ..., y_{k-q}), H_k drawn from `base`. So the storage is a map of the line (y_k, ..., y_{k-q-steps}).
    The draws are stored: a value that is forwarded twice has one gain and noise. Zeros are stored before the first.
    """

    base: AbstractRandomAffine
    size: int = eqx.field(static=True)  # numbers that are sent at each step
    steps: int = eqx.field(static=True)

    @property
    def past(self) -> int:
        """Number q + `steps` of past signals in the line (y_k, ..., y_{k-q-steps}); `base` takes 1 + q signals."""
        return self.base.inputs // self.size - 1 + self.steps

    @property
    def outputs(self) -> int:
        """Length of z = (r_k, ..., r_{k-steps}): the outputs of `base` for each of the 1 + `steps` receptions."""
        return self.base.outputs * (1 + self.steps)

    @property
    def inputs(self) -> int:
        """Length of the stacked line (y_k, ..., y_{k-q-steps}): the input of `base`, and `steps` signals more."""
        return self.base.inputs + self.size * self.steps

    @property
    def remembers(self) -> bool:
        """Always True: the gains and noises of past receptions are stored."""
        return True

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Draw the state of `base`; the stored rows [G, n] of past receptions are zero."""
        return self.base.init(key), jnp.zeros((self.steps, self.base.outputs, self.base.inputs + 1))

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw [G_k, n_k] of the present reception r_k; return the next state, and H of (r_k, ..., r_{k-steps}).

        The state holds the state of `base`, and the rows [G, n] of the last `steps` receptions, the newest first.
        """
        base_state, stored = state
        base_state, matrix = self.base.draw(base_state, key)
        # r_{k-t} = G_{k-t} (y_{k-t}, ..., y_{k-t-q}) + n_{k-t}: its gain stands t signals to the right in H.
        receptions = jnp.concatenate([matrix[None, :-1], stored])
        blocks = [
            jnp.pad(reception[:, :-1], ((0, 0), (t * self.size, (self.steps - t) * self.size)))
            for t, reception in enumerate(receptions)
        ]
        top = jnp.concatenate([jnp.concatenate(blocks), receptions[..., -1].reshape(-1, 1)], axis=1)
        return (base_state, receptions[:-1]), jnp.concatenate([top, np.eye(1, self.inputs + 1, self.inputs)])


class RelayedLinks(AbstractDelayLine):
    """Links in series, each but the first with a random delay of what the one before delivered."""

    stages: tuple[AbstractRandomAffine, ...]

    @property
    def remembers(self) -> bool:
        """Always True: relays store what they received."""
        return True

    @property
    def line(self) -> AbstractRandomAffine:
        """The stages in series as one map of the delay line (y_k, y_{k-1}, ...).

        A stage that delays takes past outputs of the stage before it, stored for stage.past steps.
        """
        size, line_map = signal_size(self.stages[0]), place_on_delay_line(self.stages[0])
        for stage in self.stages[1:]:
            line_map = Series([RelayStorage(line_map, size, stage.past), place_on_delay_line(stage)])
        return line_map

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the outputs that are angles: those of each stage's outputs go into the next stage."""
        return reduce(lambda angles, stage: stage.carry_angles(angles), self.stages, sent)

    @property
    def past(self) -> int:
        """The longest delay of all together."""
        return sum(stage.past for stage in self.stages)


def connect_in_series(links: Sequence[AbstractRandomAffine]) -> AbstractRandomAffine:
    """Return links in series, each with its own delay, as one channel; constant delays add up.

    A relay that stores what it received for d steps equals one that receives it d steps later, as gains and noises are
    independent over time. With a random d it may forward one value twice, with one noise, and so needs a store.
    """
    links = check_maps("series", links)
    if not any(link.past for link in links):
        return Series(links)
    # A stage is the first link or one with a random delay, and all links with constant ones that follow it.
    stages: list[list[AbstractRandomAffine]] = [[links[0]]]
    for link in links[1:]:
        if link.past and not isinstance(link, DelayedLink):
            raise fail("series", "links each delayed by itself", "a combination of delayed links")
        if isinstance(link, DelayedLink) and not link.constant:
            stages.append([link])
        else:
            stages[-1].append(link)
    # Only random delays after the first stage need storage.
    if len(stages) == 1:
        return _join_links_behind_delay(stages[0])
    if any(isinstance(link, DelayedLink) and link.timestamped for link in links):
        raise fail("time stamps", "those of one link", "those of several in series")
    return RelayedLinks(tuple(_join_links_behind_delay(stage) for stage in stages))


def _join_links_behind_delay(links: Sequence[AbstractRandomAffine]) -> AbstractRandomAffine:
    """Return links in series, of which only the first may have a random delay, as one series behind one delay.

    Links that are delayed become a chain of undelayed links behind the total delay. A constant delay may be moved
    before links without memory, since their gains and noises are independent over time.
    """
    # The delayed links; without any the links are a plain series.
    delays = [link for link in links if isinstance(link, DelayedLink)]
    if not delays:
        return Series(links)
    if links[0].past and not isinstance(links[0], DelayedLink):
        raise fail("series", "links each delayed by itself", "a combination of delayed links")
    # The first link's own delay, which may be random (None without one), and the constant ones that are added to it.
    first, added = (delays[0], delays[1:]) if isinstance(links[0], DelayedLink) else (None, delays)
    # A time stamp has to tell the whole delay. A stamp written before a later delay does not. Neither does the stamp of
    # a constant delay behind a first link with a delay of its own, which may be random.
    timestamped = [link.timestamped for link in delays]
    misses_later_delays = any(timestamped[:-1])
    misses_first_delay = timestamped[-1] and len(delays) > 1 and first is not None
    if misses_later_delays or misses_first_delay:
        raise fail("time stamps", "those of one link", "those of several in series")
    # All links before the last delay stand behind the joint delay in the result: allowed only if they have no memory.
    last_delay = max(i for i, link in enumerate(links) if isinstance(link, DelayedLink))
    for link in links[:last_delay]:
        if link.remembers:
            raise fail("link before a delay", "one that forgets", f"{type(link).__name__}, which remembers")
    # The links without delays behind one delay: the first link's own, and the constant ones.
    chain = Series([link.link if isinstance(link, DelayedLink) else link for link in links])
    constant_steps = sum(link.times[0] for link in added)
    delay = constant_steps if first is None else _lengthen_delay(first, constant_steps)
    return DelayedLink(chain, delay, timestamped=any(timestamped))


def _lengthen_delay(link: DelayedLink, added_steps: int) -> Delay:
    """Return a link's delay, longer by `added_steps`.

    `link.times` are the possible delays. `link.delay` is a mixture of selections if the delay is drawn at each step,
    and modes of selections if a Markov chain gives it. A chain is returned as it is: its mode is the number of steps.
    """
    match link.delay:
        case Mixture():
            times = np.array(link.times, dtype=float) + added_steps
            return Discrete(times, link.delay.choice.probabilities, link.delay.choice.radius)
        case Modes():
            return link.delay.memory
    return link.times[0] + added_steps
