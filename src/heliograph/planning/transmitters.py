"""Transmitters of a channel: their names, the power that each sends, and channels in which they send other powers.

Every map z = g A y + n with a random gain or a noise is a hop, and its transmitter sends A y; what is known and without
noise is a wire. Transmitters are named by their place: "hop1", "hop2" along a chain, "part1.", "part2." in a stack,
"link1.", "link2." in a sum, "choice1." where a mixture chooses among several. A transmitter sends whether it is
received or not: of modes and mixtures in which it is silent it knows nothing. Behind an observed loss (an erasure) a
relay sends only what arrived.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail, items, show_value
from heliograph.numerics.numpy_or_jax import is_traced, is_zero, library, plain
from heliograph.numerics.types import Array, Bool, Float, Scalar
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import AbstractHop, GainAndNoise
from heliograph.random_affine.markov_chain_and_autoregression import find_stationary_law
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.moments.signal_path import ChannelPosition, Second, SignalMoment, Visit
from heliograph.simulation.node import Node

UNCHANGED_LAW = 1e-12  # change of a law in a step that counts as none


def require_plain_senders(what: str, nodes: Mapping[str, object]) -> None:
    """Raise ValueError unless all senders among the nodes transmit what they measure, at each step.

    One with a trigger is silent at times, one with an encoder sends words, which are rounded, and one with feedback
    sends a difference, whose power is that of an error: what is designed for what is measured is not true of them.

    Args:
        what: what needs such senders, for the message.
        nodes: nodes of a network by name.
    """
    for name, node in nodes.items():
        if not isinstance(node, Node):
            continue
        differences = {"a trigger": node.trigger, "words": node.encoder, "feedback": node.informed_by}
        for got, difference in differences.items():
            if difference is not None:
                raise fail(f"node {name!r} of {what}", "a sensor that sends what it measures at each step", got)


def visit_hops(channel: AbstractRandomAffine, visit: Visit, signal: SignalMoment | None = None) -> AbstractRandomAffine:
    """Return the channel with every hop replaced by visit(name, hop, signal).

    The signal, E (y, 1)(y, 1)' of what the hop receives, is followed through maps without memory.

    Args:
        channel: the channel.
        visit: function of the name of a hop, the hop, and the signal that it receives; returns what takes its place.
        signal: E (y, 1)(y, 1)' of the channel's input; None if it is not needed.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    visited, _ = channel.visit_hops(visit, ChannelPosition("", 0, signal))
    return visited


def transmitter_names(channel: AbstractRandomAffine) -> list[str]:
    """Return the names of the transmitters, in order of appearance.

    A transmitter in several modes or alternatives of the channel is listed once.
    """
    # A dict has each name once, like a set, but keeps the order.
    names: dict[str, None] = {}

    def note_name(name: str, hop: AbstractHop, signal: SignalMoment | None) -> AbstractHop:
        """Note the hop's name, and leave the hop as it is.

        Names are keys of the dict `names`, in the order in which they come.
        """
        names.setdefault(name)
        return hop

    visit_hops(channel, note_name)
    return list(names)


def select_transmitters(names: Sequence[str], chosen: Sequence[str], what: str) -> np.ndarray:
    """Return a mask (names,) of the chosen transmitters, named fully or by the part before a dot (the node).

    `what`: what is chosen, for messages.

    Raises:
        ValueError: a choice that matches no name.
    """
    chosen_mask = np.zeros(len(names), dtype=bool)
    for choice in chosen:
        is_meant = np.array([name == choice or name.startswith(f"{choice}.") for name in names])
        if not np.any(is_meant):
            raise fail(what, f"names of transmitters {list(names)}", repr(choice))
        chosen_mask |= is_meant
    return chosen_mask


def compute_sent_powers(channel: AbstractRandomAffine, second: Second, step: int = 0) -> dict[str, Any]:
    """Return the power (mean square of what is sent) of each transmitter at a step, by name.

    The channel's modes have their law at this step, so the power is exact.

    Args:
        channel: the channel.
        second: E (y, 1)(y, 1)' of its input y.
        step: number of steps since the initial law of the modes.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    joint = joint_modes(channel, order=2)
    law = joint.initial @ library(joint.transition).linalg.matrix_power(joint.transition, step)
    return compute_powers_of_law(channel, second, law)


def compute_steady_powers(channel: AbstractRandomAffine, second: Second) -> dict[str, Any]:
    """Return {name: power} of each transmitter in the long run, under the stationary law of the channel's modes.

    If the initial law is stationary, it is used: with several closed classes, it says how probable each class is.
    `second`: E (y, 1)(y, 1)' of what goes into the channel.
    """
    joint = joint_modes(channel, order=2)
    starts_stationary = np.allclose(joint.initial @ joint.transition, joint.initial, rtol=0.0, atol=UNCHANGED_LAW)
    law = joint.initial if starts_stationary else find_stationary_law(joint.transition)
    return compute_powers_of_law(channel, second, law)


def compute_powers_of_law(channel: AbstractRandomAffine, second: Second, law: Float[Array, "modes"]) -> dict[str, Any]:
    """Return the power of each transmitter of a channel by name, if the channel's modes have this law.

    A channel without memory has one mode. The power is a mean over the modes in which the transmitter is received. In
    other modes it sends too, although nothing of it is received.

    Args:
        channel: the channel.
        second: E (y, 1)(y, 1)' of what goes into the channel.
        law: probability of each mode.
    """
    # For each transmitter: sums of P(mode) power, and of P(mode), over the modes in which it is received.
    sums: dict[str, Scalar] = dict.fromkeys(transmitter_names(channel), 0.0)
    probabilities = dict(sums)
    for probability, mode_map in zip(law, joint_modes(channel, order=2).maps, strict=True):
        for name, power in _list_powers(mode_map, second).items():
            sums[name] += probability * power
            probabilities[name] += probability
    return {name: _divide_by_probability(sums[name], probabilities[name]) for name in sums}


def _list_powers(channel: AbstractRandomAffine, second: Second) -> dict[str, Scalar]:
    """Return the power tr A E[y y'] A' that each hop of a channel of one mode sends, of those that are not silent.

    A is the matrix of the hop's transmitter and y what it receives; `second`: E (y, 1)(y, 1)' of the channel's input.
    """
    powers: dict[str, Scalar] = {}

    def note_power(name: str, hop: AbstractHop, signal: SignalMoment | None) -> AbstractHop:
        """Note the power that the hop sends in `powers`, and return the hop as it is.

        The power is P(arrives) tr(A E[y y'] A') with A = `hop.matrix`. `signal.arrives`: the probability that the hop
        has a signal to send. `signal.second`: E (y, 1)(y, 1)', whose last row and column belong to the constant 1.
        """
        assert signal is not None and isinstance(hop, GainAndNoise)
        if not hop.is_silent:
            powers[name] = signal.arrives * (hop.matrix @ signal.second[:-1, :-1] * hop.matrix).sum()
        return hop

    visit_hops(channel, note_power, SignalMoment(second, 1.0))
    return powers


def _divide_by_probability(total: Scalar, probability: Scalar) -> Scalar:
    """Return total / probability, a conditional mean, or 0 if the probability is 0."""
    if is_traced(probability):
        # JAX computes both branches, so that a division by 0 must be avoided.
        quotient: Scalar = total / library(probability).where(probability == 0, 1.0, probability)
        return quotient
    return 0.0 if is_zero(probability) else plain(total / probability)


def set_transmitter_powers(
    channel: AbstractRandomAffine, second: Second, powers: Mapping[str, float], step: int = 0
) -> AbstractRandomAffine:
    """Return the channel whose named transmitters send these powers: each amplifies what it receives to its power.

    Args:
        channel: the channel.
        second: E (y, 1)(y, 1)' of its input y.
        powers: {name: power} of the transmitters that change.
        step: the step, at which the channel's modes have their law.

    Raises:
        ValueError: a transmitter that receives nothing which it could amplify.
    """
    for name in transmitter_names(channel):  # in order: a relay receives what those before it send
        if name in powers:
            power_now = compute_sent_powers(channel, second, step)[name]
            if power_now <= 0 < powers[name]:  # silent so far: it sends what it receives, and is scaled then
                channel = amplify_transmitter(channel, name, factor=None)
                power_now = compute_sent_powers(channel, second, step)[name]
            if power_now <= 0 < powers[name]:
                raise fail(f"transmitter {name!r}", "a signal that can be amplified", "none")
            factor = np.sqrt(powers[name] / power_now) if power_now > 0 else 0.0
            channel = amplify_transmitter(channel, name, factor)
    return channel


def amplify_transmitter(channel: AbstractRandomAffine, name: str, factor: float | None) -> AbstractRandomAffine:
    """Return the channel in which a transmitter amplifies by this factor more; None: it sends just what it receives.

    Args:
        channel: the channel.
        name: name of the transmitter.
        factor: by which its amplitude is multiplied, or None.
    """

    def amplify(hop_name: str, hop: AbstractHop, signal: SignalMoment | None) -> AbstractHop:
        """Return the hop called `name` with its matrix times `factor`, and any other hop as it is.

        If `factor` is None, its matrix becomes I, so that it sends just what it receives.
        """
        if hop_name != name:
            return hop
        matrix = np.eye(*np.shape(hop.matrix)) if factor is None else np.asarray(hop.matrix) * factor
        changed: AbstractHop = eqx.tree_at(lambda h: h.matrix, hop, matrix)
        return changed

    return visit_hops(channel, amplify)


def find_free_transmitters(
    names: Sequence[str], free: Sequence[str] | Mapping[str, object] | None
) -> Bool[np.ndarray, "hop"]:
    """Return which transmitters are free: those named in `free`, or all if it is None.

    Raises:
        ValueError: numbers instead of names, or no transmitter is left.
    """
    if isinstance(free, Mapping):
        expected = "names of transmitters (numbers are free of a function that returns a network)"
        raise fail("free", expected, show_value(free))
    wanted = names if free is None else tuple(items("free", [free] if isinstance(free, str) else free, "names"))
    chosen = select_transmitters(names, wanted, "free")
    if not np.any(chosen):
        raise fail("free", f"at least one transmitter of {list(names)}", "none: nothing is free")
    return chosen
