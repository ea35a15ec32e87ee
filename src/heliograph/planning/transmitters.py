"""Transmitters of a channel: their names, the power that each sends, and channels in which they send other powers.

Every map z = g A y + n with a random gain or a noise is a hop, and its transmitter sends A y; what is known and without
noise is a wire. Transmitters are named by their place: "hop1", "hop2" along a chain, "part1.", "part2." in a stack,
"link1.", "link2." in a sum, "choice1." where a mixture chooses among several. A transmitter sends whether it is
received or not: of modes and mixtures in which it is silent it knows nothing. Behind an observed loss (an erasure) a
relay sends only what arrived.
"""

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, is_zero, library, plain
from heliograph.numerics.types import Array, Float, Scalar
from heliograph.random_affine.base import AbstractRandomAffine, fold, inner_maps, replace_inner_maps
from heliograph.random_affine.chain import stationary
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.delay import Delayed, DelayLine, signal_size
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.hop import AbstractHop, GainAndNoise
from heliograph.random_affine.law import Constant
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.modes import ModeOutput, Modes, OneStepLate, joint_modes
from heliograph.random_affine.moments.tensors import second_moment_tensor
from heliograph.random_affine.rotation import Rotation
from heliograph.random_affine.superposed import Superposed

UNCHANGED = 1e-12  # change of a law in a step that counts as none

Second = Float[Array, "p p"]  # E (y, 1)(y, 1)'


class Signal(NamedTuple):
    """Second moment of what a map receives, and the probability that it arrives."""

    second: Second
    arrives: Scalar


Visit = Callable[[str, AbstractHop, Signal | None], AbstractRandomAffine]


class Position(NamedTuple):
    """Position in a channel: prefix of names, number of hops before it along the chain, and the signal there."""

    prefix: str
    hops: int
    signal: Signal | None


def transmits(hop: AbstractHop) -> bool:
    """Decide whether a hop transmits, rather than passes its input on by a wire."""
    return not (_gain_is_one(hop) and is_zero(hop.noise.covariance))


def _gain_is_one(hop: AbstractHop) -> bool:
    return (
        isinstance(hop, GainAndNoise)
        and isinstance(hop.law, Constant)
        and not is_traced(hop.law.value)
        and float(hop.law.value) == 1.0
    )


def is_silent(channel: AbstractRandomAffine) -> bool:
    """Decide whether a channel delivers noise alone, as a loss or a mode without reception does."""
    return isinstance(channel, GainAndNoise) and is_zero(channel.matrix) and _gain_is_one(channel)


def visit_hops(channel: AbstractRandomAffine, visit: Visit, signal: Signal | None = None) -> AbstractRandomAffine:
    """Channel with every hop replaced by visit(name, hop, signal); the signal is followed through maps without memory.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    return _visit(channel, visit, Position("", 0, signal))[0]


def _visit(channel: AbstractRandomAffine, visit: Visit, position: Position) -> tuple[AbstractRandomAffine, Position]:
    """The changed channel, and the position behind it; its signal is set by the series that the channel is in."""
    inside = inner_maps(channel)
    match channel:
        # A hop that transmits is visited; a wire is not.
        case AbstractHop():
            if not transmits(channel):
                return channel, position
            after = position._replace(hops=position.hops + 1)
            return visit(f"{position.prefix}hop{after.hops}", channel, position.signal), after
        case Series():
            visited, position = _visit_chain(inside, visit, position)
        case Stack():
            visited = [_visit(affine, visit, at)[0] for affine, at in _number_maps(inside, position, "part")]
        case Superposed():
            places = _number_maps(inside, position, "link")
            parts = zip(places, channel.places, strict=True)
            visited = [_visit(affine, visit, _taking(at, chosen))[0] for (affine, at), chosen in parts]
        case Mixture() | Modes():
            # Modes of a link have the same transmitters, as have a hop and its loss; others each theirs.
            several = isinstance(channel, Mixture) and sum(not is_silent(affine) for affine in inside) > 1
            choices = _number_maps(inside, position, "choice") if several else [(affine, position) for affine in inside]
            pairs = [_visit(affine, visit, at) for affine, at in choices]
            visited = [affine for affine, _ in pairs]
            position = position if several else max((at for _, at in pairs), key=lambda at: at.hops)
        case ModeOutput() | Rotation():
            return channel, position
        # What wraps a link: inside it; the line of past signals goes into a map of the line.
        case Erasure() | OneStepLate() | Delayed() | DelayLine():
            if isinstance(channel, DelayLine) and position.signal is not None:
                line = _line(position.signal.second, channel.inputs // signal_size(channel))
                position = position._replace(signal=position.signal._replace(second=line))
            link, position = _visit(inside[0], visit, position)
            visited = [link, *inside[1:]]
        case _:
            expected = "hops in series, stacks, sums, mixtures, modes, losses and delays"
            raise fail("transmitters of a channel", expected, type(channel).__name__)
    return replace_inner_maps(channel, visited), position


def _number_maps(
    maps: Sequence[AbstractRandomAffine], position: Position, word: str
) -> list[tuple[AbstractRandomAffine, Position]]:
    """Maps side by side, each with its position: names begin with the word and the map's number."""
    at = [position._replace(prefix=f"{position.prefix}{word}{i}.", hops=0) for i in range(1, len(maps) + 1)]
    return list(zip(maps, at, strict=True))


def _taking(position: Position, places: Sequence[int]) -> Position:
    """The position at a link that takes the components at these places."""
    if position.signal is None:
        return position
    chosen = np.array([*places, -1])
    return position._replace(signal=position.signal._replace(second=position.signal.second[chosen[:, None], chosen]))


def _visit_chain(
    maps: Sequence[AbstractRandomAffine], visit: Visit, position: Position
) -> tuple[list[AbstractRandomAffine], Position]:
    """The changed maps of a series, each of which receives what comes through those before it."""
    parts, signal = list[AbstractRandomAffine](), position.signal
    for i, affine in enumerate(maps):
        changed, position = _visit(affine, visit, position._replace(signal=signal))
        parts.append(changed)
        if signal is not None and i + 1 < len(maps):
            signal = Signal(_behind(affine, signal.second), signal.arrives * _arrival(affine))
    return parts, position


def _arrival(channel: AbstractRandomAffine) -> Scalar:
    """Probability that a signal comes through."""
    probability: Scalar = fold(channel, {
        Erasure: lambda loss, parts: plain(loss.arrival) * parts[0],
        Series: lambda _, parts: prod(parts),
        Delayed: lambda _, parts: parts[0],
        AbstractRandomAffine: _certain,
    })  # fmt: skip
    return probability


def _certain(channel: AbstractRandomAffine, _: object) -> Scalar:
    if channel.erases:
        raise fail("transmitter behind a loss", "a chain that erases", type(channel).__name__)
    return 1.0


def _behind(channel: AbstractRandomAffine, second: Second) -> Second:
    """E (z, 1)(z, 1)' behind a map, of what arrives."""
    match channel:
        case Erasure():
            return _behind(channel.base, second)
        case Series():
            for affine in channel.maps:
                second = _behind(affine, second)
            return second
        case Delayed():
            return _behind(channel.link, second)
    # E h Y h' by the second moments of the random map h, and its mean.
    moments = channel.moments(2)
    tensor = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    mean, xp = moments.mean[:-1] @ second[:, -1], library(tensor, second)
    behind: Second = xp.block(
        [[xp.einsum("ijab,ab->ij", tensor, second), mean[:, None]], [mean[None], np.ones((1, 1))]]
    )
    return behind


def _line(second: Second, times: int) -> Second:
    """Moment of the line (y_k, y_{k-1}, ...): each as the present one; a delay chooses one of them, so no two meet."""
    xp = library(second)
    mean, blocks = xp.tile(second[:-1, -1], times), xp.kron(np.eye(times), second[:-1, :-1])
    line: Second = xp.block([[blocks, mean[:, None]], [mean[None], np.ones((1, 1))]])
    return line


def transmitter_names(channel: AbstractRandomAffine) -> list[str]:
    """Names of the transmitters, in order of appearance."""
    names: dict[str, None] = {}

    def note(name: str, hop: AbstractHop, signal: Signal | None) -> AbstractHop:
        names.setdefault(name)
        return hop

    visit_hops(channel, note)
    return list(names)


def select_transmitters(names: Sequence[str], chosen: Sequence[str], what: str) -> np.ndarray:
    """Mask of the names that are chosen, by name or by what stands before a dot.

    Raises:
        ValueError: a choice that is there under no name.
    """
    chosen_mask = np.zeros(len(names), dtype=bool)
    for choice in chosen:
        hit = np.array([name == choice or name.startswith(f"{choice}.") for name in names])
        if not np.any(hit):
            raise fail(what, f"names of transmitters {list(names)}", repr(choice))
        chosen_mask |= hit
    return chosen_mask


def compute_sent_powers(channel: AbstractRandomAffine, second: Second, step: int = 0) -> dict[str, Any]:
    """Power of each transmitter at a step, the mean square of what it sends, from E (y, 1)(y, 1)' of the input.

    Exact: modes have the law of the step.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    joint = joint_modes(channel, order=2)
    law = joint.initial @ library(joint.transition).linalg.matrix_power(joint.transition, step)
    return powers_of_law(channel, second, law)


def steady_powers(channel: AbstractRandomAffine, second: Second) -> dict[str, Any]:
    """Power of each transmitter in the long run, whatever modes the channel began with."""
    joint = joint_modes(channel, order=2)
    unchanged = np.allclose(joint.initial @ joint.transition, joint.initial, rtol=0.0, atol=UNCHANGED)
    return powers_of_law(channel, second, joint.initial if unchanged else stationary(joint.transition))


def powers_of_law(channel: AbstractRandomAffine, second: Second, law: Float[Array, "modes"]) -> dict[str, Any]:
    """Power of each transmitter where the channel's modes have this law (one mode, of a channel without memory)."""
    total: dict[str, Scalar] = dict.fromkeys(transmitter_names(channel), 0.0)
    occurs = dict(total)
    for weight, mode_map in zip(law, joint_modes(channel, order=2).maps, strict=True):
        # Powers in a mode; a transmitter that is not received there sends as in other modes.
        powers: dict[str, Scalar] = {}

        def note(name: str, hop: AbstractHop, signal: Signal | None, powers: dict[str, Scalar] = powers) -> AbstractHop:
            assert signal is not None and isinstance(hop, GainAndNoise)
            if not is_silent(hop):
                powers[name] = signal.arrives * (hop.matrix @ signal.second[:-1, :-1] * hop.matrix).sum()
            return hop

        visit_hops(mode_map, note, Signal(second, 1.0))
        for name, power in powers.items():
            total[name] += weight * power
            occurs[name] += weight
    return {name: _divide_by_probability(total[name], occurs[name]) for name in total}


def _divide_by_probability(total: Scalar, probability: Scalar) -> Scalar:
    """Conditional mean; zero where the condition never holds."""
    if is_traced(probability):
        quotient: Scalar = total / library(probability).where(probability == 0, 1.0, probability)
        return quotient
    return 0.0 if is_zero(probability) else plain(total / probability)


def allocate(
    channel: AbstractRandomAffine, second: Second, powers: Mapping[str, float], step: int = 0
) -> AbstractRandomAffine:
    """Channel whose named transmitters send these powers: each amplifies what it receives to its power.

    Raises:
        ValueError: a transmitter that receives nothing which it could amplify.
    """
    for name in transmitter_names(channel):  # in order: a relay receives what those before it send
        if name in powers:
            now = compute_sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                channel = amplify_transmitter(channel, name, None)
                now = compute_sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                raise fail(f"transmitter {name!r}", "a signal that can be amplified", "none")
            channel = amplify_transmitter(channel, name, np.sqrt(powers[name] / now) if now > 0 else 0.0)
    return channel


def amplify_transmitter(channel: AbstractRandomAffine, name: str, factor: float | None) -> AbstractRandomAffine:
    """Channel in which a transmitter amplifies by this factor more; None: sends what it receives, whatever it sent."""

    def change(hop_name: str, hop: AbstractHop, signal: Signal | None) -> AbstractHop:
        if hop_name != name:
            return hop
        matrix = np.eye(*np.shape(hop.matrix)) if factor is None else np.asarray(hop.matrix) * factor
        changed: AbstractHop = eqx.tree_at(lambda h: h.matrix, hop, matrix)
        return changed

    return visit_hops(channel, change)
