"""Delayed links: at step k arrives what was sent d steps before, with d constant, drawn or a chain, stamped or not."""

from typing import TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from heliograph.numerics.check import check_count, fail, instance, shown
from heliograph.random_affine.atoms import GainAndNoise, known
from heliograph.random_affine.base import AbstractOfOne, AbstractRandomAffine, as_maps
from heliograph.random_affine.chain import MarkovChain
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.modes import Modes
from heliograph.random_affine.moments.moments import Moments

Delay = int | Discrete | MarkovChain  # steps; their law at each step; a chain whose mode is the number of steps
T = TypeVar("T")


class AbstractOfLine(AbstractOfOne):
    """Map of the tapped delay line (y_k, y_{k-1}, ..., y_{k-past}), stacked."""

    @property
    def line(self) -> AbstractRandomAffine:
        """Return the same map as one without delay, whose input is the whole line."""
        raise NotImplementedError

    @property
    def inside(self) -> AbstractRandomAffine:
        """The map of the line."""
        return self.line

    def around(self, inside: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return another map of the line, as late."""
        return OfLine(inside, self.past)

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw the map of the line."""
        return self.line.draw(state, key)

    def moments(self, order: int) -> Moments:
        """Return the moments of the map of the line."""
        return self.line.moments(order)


class OfLine(AbstractOfLine):
    """A map that is given as one of the line."""

    plain: AbstractRandomAffine
    steps: int = eqx.field(static=True)

    @property
    def line(self) -> AbstractRandomAffine:
        """The map."""
        return self.plain

    @property
    def past(self) -> int:
        """Steps back that the line reaches."""
        return self.steps


class Delayed(AbstractOfLine):
    """Delayed link z_k = G_k y_{k-d} + n_k: at step k arrives what was sent d steps before.

    As a map of the line its mean gain is E[G] sum_d p_d S_d, where S_d selects y_{k-d}, and its spread that of the
    mixture. Before the first step zeros were sent.

    Args:
        link: the link without delay.
        delay: d in steps; a `Discrete` law from which d is drawn at each step; or a `MarkovChain` whose mode is d.
        timestamped: True if d is received too, as the last number; False unless given.

    Raises:
        ValueError: a delay that is no whole number of steps from 0, a law of it with other values, a link that is late
            itself (put links in series with `amplify_and_forward`).
    """

    link: AbstractRandomAffine
    delay: AbstractRandomAffine  # from the line to the link's input, and to d where it is stamped
    times: tuple[int, ...] = eqx.field(static=True)
    timestamped: bool = eqx.field(static=True)

    def __init__(self, link: AbstractRandomAffine, delay: Delay, timestamped: bool = False):
        (self.link,) = as_maps("delayed link", [link])
        if link.past:
            raise fail("delayed link", "one that is not late itself", f"one late by up to {link.past} steps")
        self.times, self.timestamped = _times(delay), instance("timestamped", timestamped, bool, "True or False")
        items = [_chosen(d, self.past, link.inputs, timestamped) for d in self.times]
        match delay:
            case Discrete():
                self.delay = Mixture(items, delay.probabilities, delay.radius)
            case MarkovChain():
                self.delay = Modes(delay, items)
            case _:
                self.delay = items[0]

    @property
    def line(self) -> AbstractRandomAffine:
        """The choice, then the link."""
        if not self.timestamped:
            return Series([self.delay, self.link])
        m = self.link.inputs
        rows = np.eye(m + 1)
        return Series([self.delay, Stack([Series([known(rows[:m]), self.link]), known(rows[m:])])])

    @property
    def past(self) -> int:
        """The longest delay."""
        return max(self.times)

    @property
    def constant(self) -> bool:
        """True if the delay never varies."""
        return isinstance(self.delay, GainAndNoise)

    def given(self, d: int) -> AbstractRandomAffine:
        """Return the map of the line for one delay d, without the time stamp."""
        return Series([_chosen(d, self.past, self.link.inputs, False), self.link])


def _times(delay: Delay) -> tuple[int, ...]:
    match delay:
        case Discrete():
            values = [int(d) if d == int(d) else float(d) for d in np.asarray(delay.values)]
        case MarkovChain():
            values = list(range(delay.modes))
        case int() | np.integer():
            values = [delay]
        case _:
            raise fail("delay", "a number of steps, a Discrete law or a MarkovChain of it", shown(delay))
    return tuple(check_count("delay", d, 0) for d in values)


def _chosen(d: int, longest: int, size: int, timestamped: bool) -> GainAndNoise:
    """S_d, and below it the number d."""
    rows = np.kron(np.eye(1, longest + 1, d), np.eye(size))
    if not timestamped:
        return known(rows)
    return known(np.pad(rows, ((0, 1), (0, 0))), np.append(np.zeros(size), float(d)))


def of_line(channel: T) -> T:
    """The channel (or all channels in a tree) as a plain map of the line."""

    def plain(part: object) -> object:
        return part.line if isinstance(part, AbstractOfLine) else part

    result: T = jax.tree.map(plain, channel, is_leaf=lambda part: isinstance(part, AbstractOfLine))
    return result


def sent(channel: AbstractRandomAffine) -> int:
    """Numbers that are sent to a channel at each step."""
    return channel.inputs // (1 + channel.past)


def of_part(channel: AbstractRandomAffine, total: int, start: int, past: int) -> AbstractRandomAffine:
    """The channel of y[start:start + sent] as one of all of y, and of a line at least as long as its own."""
    local, size = channel.past, sent(channel)
    rows = np.concatenate([t * total + start + np.arange(size) for t in range(local + 1)])
    chosen = Series([known(np.eye((1 + past) * total)[rows]), of_line(channel) if local else channel])
    return OfLine(chosen, past) if past else chosen
