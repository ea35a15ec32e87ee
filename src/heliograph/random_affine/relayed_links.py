"""Links with delays in series, whose relays may store what they received."""

from collections.abc import Sequence
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_maps
from heliograph.random_affine.composite import AbstractMapWrapper
from heliograph.random_affine.delay import AbstractDelayLine, Delay, DelayedLink, place_on_delay_line, signal_size
from heliograph.random_affine.laws.law import Discrete
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.modes import Modes
from heliograph.random_affine.series_and_stack import Series


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
    """Links in series whose relays store signals: each stage but the first delays, at random, what the one before sent.

    stages: the links, first that of the sensor.
    """

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
        size = signal_size(self.stages[0])
        line_map = place_on_delay_line(self.stages[0])
        for stage in self.stages[1:]:
            line_map = Series([RelayStorage(line_map, size, stage.past), place_on_delay_line(stage)])
        return line_map

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the outputs that are angles: those of each stage's outputs go into the next stage."""
        return reduce(lambda angles, stage: stage.carry_angles(angles), self.stages, sent)

    @property
    def past(self) -> int:
        """Longest possible delay from the first link to the last, in steps: the sum of the stages' longest delays."""
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
