"""Links with memory: fading in bursts, loss in bursts, gains that drift, and fading that several links share."""

from collections.abc import Sequence
from typing import cast

import numpy as np

from heliograph.model.channel import Channel, hop
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.numerics.check import array, check_count, fail, flag, scalar, text
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, check_maps
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.markov_chain_and_autoregression import Autoregression, MarkovChain
from heliograph.random_affine.memories_of_channels import memories, replace_memories
from heliograph.random_affine.modes import (
    Faded,
    ModeOutput,
    Modes,
    OneStepLate,
    is_memory_irrelevant_for_linear_filter,
    joint_modes,
    mix_maps_of_modes,
    mode_laws_over_time,
    redraw_modes_each_step,
)
from heliograph.random_affine.noises.noise import FiniteSupport, NoiseLike, as_noise, count_components
from heliograph.random_affine.series_and_stack import Stack
from heliograph.random_affine.sum_of_maps import split_terms_without_common_memory


def gilbert_elliott(
    good: AbstractRandomAffine,
    bad: AbstractRandomAffine,
    fail: ArrayLike,
    recover: ArrayLike,
    name: str | None = None,
) -> Modes:
    """Return a link that is `good` or `bad` for a while: it fails with a probability at each step, and then recovers.

    `good` and `bad` are any channels, also with losses: `erasure(link, arrival)` in each makes losses in bursts. The
    link starts in its stationary law. Links of one `name` are good and bad together.

    Args:
        good: channel at the steps at which the link is good.
        bad: channel at the others, of the same shape.
        fail: probability per step that a good link becomes bad.
        recover: probability per step that a bad link becomes good.
        name: links of one name share their state (default: none is shared).

    Raises:
        ValueError: probabilities outside [0, 1], both zero, or channels of different shapes.
    Source: Gilbert (1960), Elliott (1963).
    """
    # A Markov chain of the two states with the transition matrix [[1 - p, p], [q, 1 - q]]: p fails, q recovers.
    p, q = scalar("fail", fail, 0.0, 1.0), scalar("recover", recover, 0.0, 1.0)
    xp = library(p, q)
    transition = xp.stack([xp.stack([1 - p, p]), xp.stack([q, 1 - q])])
    return Modes(MarkovChain(transition, name=name), [good, bad])


def markov_fading(
    gains: Sequence[AbstractRandomAffine] | ArrayLike,
    transition: MarkovChain | ArrayLike,
    noise: NoiseLike | None = None,
    name: str | None = None,
) -> Modes:
    """Return a link whose gain moves as a Markov chain: numbers, with one `noise`, or a channel for each mode.

    A mode is a state of the chain. `transition` has P(next mode j | mode i now) at row i and column j, and starts in
    its stationary law; or it is a `MarkovChain`. Links of one `name`, or of chains of one name, are in the same mode at
    each step.

    Args:
        gains: numbers (modes,), or a channel for each mode.
        transition: probabilities (modes, modes), row i those after mode i; or a `MarkovChain`.
        noise: as for `hop`, where gains are numbers (default: none, for channels).
        name: links of one name share their mode (default: none is shared).

    Raises:
        ValueError: gains without a noise or channels with one, not one for each mode, rows that are no probabilities.
    """
    if isinstance(transition, MarkovChain) and name is not None:
        raise fail("name", "none beside a chain, which has its own", repr(name))
    chain = transition if isinstance(transition, MarkovChain) else MarkovChain(transition, name=name)
    # Gains are channels, or else numbers.
    channels = [gain for gain in gains if isinstance(gain, AbstractRandomAffine)] if isinstance(gains, Sequence) else []
    if channels:
        if noise is not None:
            raise fail("noise", "none beside channels, which have their own", "one")
        return Modes(chain, channels)
    if noise is None:
        raise fail("noise", "one for gains that are numbers", "none")
    numbers = array("gains of the modes", cast(ArrayLike, gains), (None,))
    return Modes(chain, [hop(gain, noise) for gain in numbers])


def autoregressive_fading(
    mean: Float[ArrayLike, ""],
    deviation: Float[ArrayLike, ""],
    correlation: Float[ArrayLike, ""],
    noise: NoiseLike,
    dimension: int = 1,
    name: str | None = None,
) -> Faded:
    """Return a link z = g y + n whose gain drifts: Gaussian, stationary, with `correlation` from one step to the next.

    The gain is g_k = mean + deviation s_k with s_k+1 = correlation s_k + noise, Var s = 1. z, y and n have one or more
    components, with the same g. Links of one `name` share s: they drift together, each with its own mean and deviation.

    Args:
        mean: mean of the gain.
        deviation: standard deviation of the gain, not negative.
        correlation: correlation of the gain from one step to the next, from -1 to 1.
        noise: law, covariance (m, m) or variance of n, in the unit of z squared.
        dimension: number of components where `noise` is a variance (default 1).
        name: links of one name drift together (default: none is shared).

    Raises:
        ValueError: a negative deviation, a correlation outside [-1, 1], a noise that is no covariance.
    """
    count = count_components(noise) or check_count("dimension of a hop", dimension)
    return Faded(Autoregression(correlation, name), mean, deviation, np.eye(count), as_noise("hop noise", noise, count))


def with_flag(
    channel: AbstractRandomAffine,
    probabilities: "Float[ArrayLike, 'modes flags'] | None" = None,
    chain: MarkovChain | None = None,
    late: bool = False,
) -> Stack:
    """Return the channel with side information on the mode of a chain: (z, flag), a flag being a class 0, 1, ...

    The flag is never lost with z.

    Args:
        channel: the channel, whose gain depends on a mode (such as good or bad) that moves by a Markov chain.
        probabilities: P(flag | mode), shape (modes, flags), as of a received strength or a modem's quality class.
            Without it, and without `chain`, the states of all memories are received after z: the number of a mode, the
            value of a drift.
        chain: the chain on which the flag depends; by default the one that the channel holds.
        late: True if each step receives the flag of the step before, and none at the first; False unless given.

    Raises:
        ValueError: rows that are no probabilities, or a channel that holds no memory, or several and `chain` not given.
    """
    late = flag("late", late)
    # Find the chain. `held`: all memories of the channel (chains, and gains that drift). Classes tell of the modes of a
    # single chain, so with several memories the chain must be given.
    held = list(memories(channel).values())
    are_classes = probabilities is not None
    is_undecided = not held or (are_classes and len(held) > 1)
    if chain is None and is_undecided:
        raise fail("chain", "one that the flag tells of, since the channel does not hold just one", "none")
    # Without classes the states themselves are received.
    if probabilities is None:
        outputs = [ModeOutput(m, channel.inputs) for m in (held if chain is None else [chain])]
        return Stack([channel, *(OneStepLate(output) if late else output for output in outputs)])
    memory = held[0] if chain is None else chain
    if not isinstance(memory, MarkovChain):
        raise fail("chain", "a MarkovChain, of whose modes classes tell", type(memory).__name__)
    # A flag is a received number without signal: gain 0, and a noise whose values are the classes 0, 1, ..., with a law
    # for each mode.
    laws = array("flags", probabilities, (memory.modes, None))
    no_signal, flags = np.zeros((1, channel.inputs)), np.arange(laws.shape[1])[:, None]
    classes = Modes(memory, [GainAndNoise(Constant(1.0), no_signal, FiniteSupport(flags, law)) for law in laws])
    return Stack([channel, OneStepLate(classes) if late else classes])


def shared(link: Channel, name: str) -> Channel:
    """Return the link as one of those that share its fading: all links of one name are in one state at each step.

    Two sensors behind one obstacle, for example, lose messages at the same time. Without a name a link is independent
    of all others, even if one object stands at several nodes or hops. The name comes from here, or from `name` of
    `gilbert_elliott`, `markov_fading` and so on. `Network.shared` and reports list the links that nodes share.

    Args:
        link: a link with memory, or a channel that contains some.
        name: name of what is shared; for a channel with several memories, it is followed by their numbers.

    Raises:
        ValueError: a channel without memory (nodes share its independent draws by `Network.sharing`), no name.
    """
    text("name of what is shared", name)
    check_maps("shared link", [first(link)])
    # A memory is the hidden state of a link, such as a Markov chain of its modes: copies of it get the name.
    memories_of_link = memories(link)
    if not memories_of_link:
        got = "one drawn anew at each step, which nodes share by Network.sharing"
        raise fail("shared link", "one with memory, such as gilbert_elliott(...)", got)
    named_copies = {}
    for i, (key, memory) in enumerate(memories_of_link.items()):
        # Each of several memories gets a number after the name.
        named_copies[key] = memory.named(name if len(memories_of_link) == 1 else f"{name} {i}")
    return replace_memories(link, named_copies)


def without_memory(channel: Channel) -> Channel:
    """Return the channel with its modes drawn anew at each step: what a filter assumes that knows no memory.

    Draws at different steps are independent. At each step they have the law that they have in the channel (in the long
    run if the channel is constant). A channel without memory is returned as it is.

    Args:
        channel: a channel with any memory by modes; it may vary over time.

    Raises:
        ValueError: a channel that remembers in a way of its own.
    """
    if not check_maps("channel", [first(channel)])[0].remembers:
        return channel
    if not isinstance(channel, OverTime):
        return redraw_modes_each_step(channel)
    modes_of_steps = [joint_modes(step, order=2) for step in unstack(channel)]
    laws_of_steps = mode_laws_over_time(modes_of_steps)
    return over_time([mix_maps_of_modes(modes, law) for modes, law in zip(modes_of_steps, laws_of_steps, strict=True)])


def memory_matters(channel: Channel) -> bool:
    """Return whether mean gains are correlated over time, so that a linear filter without memory claims too much.

    A channel draws a random map H_k = (G_k, n_k) at each step, whose law depends on the mode of a Markov chain (a
    fading). A linear filter without memory assumes Cov(E[H_k | mode], E[H_l | mode]) = 0 for steps k and l; where that
    is wrong, its covariance is too small. A sum of links may have independent fadings: this is tested for each group of
    links that share a fading, on its joint modes. Memory in only the variance of noise does not matter. A chain with
    uncertain transitions counts as one that matters, since some possible law may be correlated.

    Args:
        channel: the channel of a node; it may vary over time.

    Raises:
        ValueError: a channel with a memory of another kind.
    """
    if not check_maps("channel", [first(channel)])[0].remembers:
        return False
    if uncertain_chain(channel):
        return True
    # The channel is a sum of independent terms. A term is the list of its maps over all steps.
    terms_by_step = [split_terms_without_common_memory(step) for step in unstack(channel)]
    is_constant = not isinstance(channel, OverTime)
    for maps_of_term in zip(*terms_by_step, strict=True):
        modes_by_step = [joint_modes(step) for step in maps_of_term]
        if not is_memory_irrelevant_for_linear_filter(modes_by_step, is_constant):
            return True
    return False


def uncertain_chain(channel: Channel) -> bool:
    """Return whether a Markov chain in the channel has transition probabilities that are known only within bounds."""
    return any(memory.is_uncertain for memory in memories(channel).values())
