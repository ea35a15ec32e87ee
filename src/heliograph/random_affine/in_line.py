"""Delayed links in series: constant delays add up, and relays with random delays store what they received."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine, AbstractWithBase, as_maps
from heliograph.random_affine.combine import Mixture, Series
from heliograph.random_affine.delay import AbstractOfLine, Delay, Delayed, of_line, sent
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.modes import Modes


class Held(AbstractWithBase):
    """Storage of a relay: received signals of this step and `steps` before, (r_k, ..., r_{k-steps}).

    A map of the line of what was sent. Draws are stored: a value that is forwarded twice has its gain and noise twice.
    Before the first step it holds zeros.
    """

    base: AbstractRandomAffine
    size: int = eqx.field(static=True)  # numbers that are sent at each step
    steps: int = eqx.field(static=True)

    @property
    def past(self) -> int:
        """Steps back that the line reaches."""
        return self.base.inputs // self.size - 1 + self.steps

    @property
    def outputs(self) -> int:
        """Number of values that are stored."""
        return self.base.outputs * (1 + self.steps)

    @property
    def inputs(self) -> int:
        """Length of the line."""
        return self.base.inputs + self.size * self.steps

    @property
    def remembers(self) -> bool:
        """Always True."""
        return True

    def _init(self, key: jax.Array) -> PyTree[jax.Array]:
        """Draw the state of the map, with zeros received before."""
        return self.base.init(key), jnp.zeros((self.steps, self.base.outputs, self.base.inputs + 1))

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw the present reception, and put it before the earlier ones."""
        inner, before = state
        inner, h = self.base.draw(inner, key)
        items = jnp.concatenate([h[None, :-1], before])
        rows = [
            jnp.pad(item[:, :-1], ((0, 0), (t * self.size, (self.steps - t) * self.size)))
            for t, item in enumerate(items)
        ]
        top = jnp.concatenate([jnp.concatenate(rows), items[..., -1].reshape(-1, 1)], axis=1)
        return (inner, items[:-1]), jnp.concatenate([top, np.eye(1, self.inputs + 1, self.inputs)])


class Relayed(AbstractOfLine):
    """Links in series, each but the first with a random delay of what the one before delivered."""

    stages: tuple[AbstractRandomAffine, ...]

    @property
    def remembers(self) -> bool:
        """Always True: relays store what they received."""
        return True

    @property
    def line(self) -> AbstractRandomAffine:
        """Return the stages in series, each fed by the storage of the one before."""
        size, result = sent(self.stages[0]), of_line(self.stages[0])
        for stage in self.stages[1:]:
            result = Series([Held(result, size, stage.past), of_line(stage)])
        return result

    @property
    def past(self) -> int:
        """The longest delay of all together."""
        return sum(stage.past for stage in self.stages)


def in_series(links: Sequence[AbstractRandomAffine]) -> AbstractRandomAffine:
    """Return links in series, each with its own delay; constant delays add up.

    A relay without memory that stores what it received for a constant d equals one that receives it d steps later:
    gains and noises are independent over time. One that stores it for a random time may forward one value twice, with
    one noise.

    Raises:
        ValueError: no links, time stamps on the way, memory before a delay.
    """
    links = as_maps("series", links)
    if not any(link.past for link in links):
        return Series(links)
    # A stage is a link with a random delay and all that follow it with constant ones.
    stages: list[list[AbstractRandomAffine]] = [[links[0]]]
    for link in links[1:]:
        if link.past and not isinstance(link, Delayed):
            raise fail("series", "links that are late each by itself", "a combination of late links")
        if isinstance(link, Delayed) and not link.constant:
            stages.append([link])
        else:
            stages[-1].append(link)
    # Only random delays after the first stage need storage.
    if len(stages) == 1:
        return _stage(stages[0])
    if any(isinstance(link, Delayed) and link.timestamped for link in links):
        raise fail("time stamps", "those of one link", "those of several in series")
    return Relayed(tuple(_stage(stage) for stage in stages))


def _stage(links: Sequence[AbstractRandomAffine]) -> AbstractRandomAffine:
    """Return links in series of which only the first may have a random delay."""
    delays = [link for link in links if isinstance(link, Delayed)]
    if not delays:
        return Series(links)
    if links[0].past and not isinstance(links[0], Delayed):
        raise fail("series", "links that are late each by itself", "a combination of late links")
    # The random delay comes first; constant ones are added to it.
    start, added = (delays[0], delays[1:]) if isinstance(links[0], Delayed) else (None, delays)
    timestamped = [link.timestamped for link in delays]
    if any(timestamped[:-1]) or (timestamped[-1] and len(delays) > 1 and start is not None):
        raise fail("time stamps", "those of one link", "those of several in series")
    last = max(i for i, link in enumerate(links) if isinstance(link, Delayed))
    for link in links[:last]:
        if link.remembers:
            raise fail("link before a delay", "one that forgets", f"{type(link).__name__}, which remembers")
    chain = Series([link.link if isinstance(link, Delayed) else link for link in links])
    more = sum(link.times[0] for link in added)
    return Delayed(chain, more if start is None else _longer(start, more), any(timestamped))


def _longer(link: Delayed, more: int) -> Delay:
    """The link's delay and so many steps, none after a chain."""
    match link.delay:
        case Mixture():
            times = np.array(link.times, dtype=float) + more
            return Discrete(times, link.delay.choice.probabilities, link.delay.choice.radius)
        case Modes():
            return link.delay.memory
    return link.times[0] + more
