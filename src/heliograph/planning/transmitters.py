"""Who sends in a channel, what power each one sends, and channels whose transmitters send more or less.

Every map z = g A y + n with a random gain or a noise is a hop, and its transmitter sends A y; what is known and without
noise is a wire. Transmitters are called by their place: "hop1", "hop2" along a chain, "part1.", "part2." in a stack,
"choice1." where a mixture chooses among several. A transmitter sends whether it is heard or not: of modes and mixtures
in which it is silent it knows nothing. Behind a loss that is told (an erasure) a relay sends only what arrived.
"""

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, is_zero, library, plain
from heliograph.numerics.types import Array, Float, Scalar
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed, OfLine, sent
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.law import Constant
from heliograph.random_affine.modes import Faded, Modes, OneStepLate, Revealed, joint_modes
from heliograph.random_affine.second_moments import second_moment_tensor

Second = Float[Array, "p p"]  # E (y, 1)(y, 1)'
Hop = GainAndNoise | Faded
Act = Callable[[str, Hop], AbstractRandomAffine]


def transmits(atom: Hop) -> bool:
    """Whether anything is sent over the air."""
    if isinstance(atom, Faded):
        return True
    return not (_is_one(atom) and is_zero(atom.noise.covariance))


def _is_one(atom: GainAndNoise) -> bool:
    return isinstance(atom.law, Constant) and not is_traced(atom.law.value) and float(atom.law.value) == 1.0


def is_silent(channel: AbstractRandomAffine) -> bool:
    """Whether nothing comes through but noise: what a loss, or a mode in which nothing is heard, is made of."""
    return isinstance(channel, GainAndNoise) and is_zero(channel.matrix) and _is_one(channel)


class _Place(NamedTuple):
    """Where in a channel: the prefix of names, and how many hops are before along the chain."""

    prefix: str
    hops: int


BEGINNING = _Place("", 0)


def walked(channel: AbstractRandomAffine, act: Act, place: _Place = BEGINNING) -> tuple[AbstractRandomAffine, _Place]:
    """The channel with every hop replaced by act(name, hop), and the place behind it.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    match channel:
        case GainAndNoise() | Faded():
            if not transmits(channel):
                return channel, place
            after = place._replace(hops=place.hops + 1)
            return act(f"{place.prefix}hop{after.hops}", channel), after
        case Series():
            parts = []
            for part in channel.maps:
                part, place = walked(part, act, place)
                parts.append(part)
        case Stack():
            places = [_Place(f"{place.prefix}part{i}.", 0) for i in range(1, len(channel.maps) + 1)]
            parts = [walked(part, act, own)[0] for part, own in zip(channel.maps, places, strict=True)]
        case Mixture() | Modes():
            parts, place = _chosen(channel, act, place)
        case Revealed():
            return channel, place
        case Erasure() | OneStepLate() | Delayed() | OfLine():
            name = {Erasure: "base", OneStepLate: "base", Delayed: "link", OfLine: "plain"}[type(channel)]
            inner, place = walked(getattr(channel, name), act, place)
            return eqx.tree_at(lambda c: getattr(c, name), channel, inner), place
        case _:
            raise _unknown(channel)
    return eqx.tree_at(lambda c: c.maps, channel, tuple(parts)), place


def _chosen(channel: Mixture | Modes, act: Act, place: _Place) -> tuple[list[AbstractRandomAffine], _Place]:
    """The maps of which one is in force: modes of one link have the same transmitters, those of a mixture their own."""
    own = [not is_silent(part) for part in channel.maps]
    several = isinstance(channel, Mixture) and sum(own) > 1
    places = [_Place(f"{place.prefix}choice{i}.", 0) if several else place for i in range(1, len(own) + 1)]
    pairs = [walked(part, act, at) for part, at in zip(channel.maps, places, strict=True)]
    return [part for part, _ in pairs], place if several else max((at for _, at in pairs), key=lambda at: at.hops)


def names_of(channel: AbstractRandomAffine) -> list[str]:
    """Names of the transmitters, in order of appearance."""
    found: dict[str, None] = {}

    def note(name: str, hop: Hop) -> Hop:
        found.setdefault(name)
        return hop

    walked(channel, note)
    return list(found)


def scaled(channel: AbstractRandomAffine, factors: Mapping[str, float]) -> AbstractRandomAffine:
    """The channel in which each named transmitter's signal is so many times larger."""

    def act(name: str, hop: Hop) -> Hop:
        result: Hop = eqx.tree_at(lambda h: h.matrix, hop, np.asarray(hop.matrix) * factors.get(name, 1.0))
        return result

    return walked(channel, act)[0]


def sent_powers(channel: AbstractRandomAffine, second: Second, step: int = 0) -> dict[str, Any]:
    """Mean square of what each transmitter sends at a step, from E (y, 1)(y, 1)' of what is given to the channel.

    Exact: of modes in the law that they have at the step.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    total: dict[str, Any] = dict.fromkeys(names_of(channel), 0.0)
    seen = dict(total)
    joint = joint_modes(channel, order=2)
    law = joint.initial @ library(joint.transition).linalg.matrix_power(joint.transition, step)
    for weight, one in zip(law, joint.maps, strict=True):
        powers: dict[str, Any] = {}
        _send(one, second, BEGINNING, 1.0, powers)
        for name, power in powers.items():
            total[name] += weight * power
            seen[name] += weight
    return {name: 0.0 if is_zero(seen[name]) else plain(total[name] / seen[name]) for name in total}


def _send(
    channel: AbstractRandomAffine, second: Second, place: _Place, arrives: Scalar, powers: dict[str, Any]
) -> _Place:
    """Note the powers in a map that forgets, and return the place behind it."""
    match channel:
        case GainAndNoise():
            if not transmits(channel):
                return place
            place = place._replace(hops=place.hops + 1)
            if is_silent(channel):  # a transmitter that is not heard sends as in other modes
                return place
            matrix = channel.matrix
            powers[f"{place.prefix}hop{place.hops}"] = arrives * (matrix @ second[:-1, :-1] * matrix).sum()
        case Series():
            for i, part in enumerate(channel.maps):
                place = _send(part, second, place, arrives, powers)
                if i + 1 < len(channel.maps):
                    arrives, second = arrives * _arrival(part), _behind(part, second)
        case Stack():
            for i, part in enumerate(channel.maps, 1):
                _send(part, second, _Place(f"{place.prefix}part{i}.", 0), arrives, powers)
        case Mixture():
            return _send_mixture(channel, second, place, arrives, powers)
        case Erasure():
            return _send(channel.base, second, place, arrives, powers)
        case Delayed():
            return _send(channel.link, second, place, arrives, powers)
        case OfLine():
            return _send(channel.plain, _line(second, channel.inputs // sent(channel)), place, arrives, powers)
        case _:
            raise _unknown(channel)
    return place


def _send_mixture(channel: Mixture, second: Second, place: _Place, arrives: Scalar, powers: dict[str, Any]) -> _Place:
    own = [not is_silent(part) for part in channel.maps]
    if sum(own) > 1:
        for i, part in enumerate(channel.maps, 1):
            _send(part, second, _Place(f"{place.prefix}choice{i}.", 0), arrives, powers)
        return place
    for part in channel.maps:
        place = _send(part, second, place, arrives, powers)
    return place


def _arrival(channel: AbstractRandomAffine) -> Scalar:
    """The probability that what comes through is there."""
    if not channel.erases:
        return 1.0
    match channel:
        case Erasure():
            return plain(channel.arrival) * _arrival(channel.base)
        case Series():
            return prod(_arrival(part) for part in channel.maps)
        case Delayed():
            return _arrival(channel.link)
    raise fail("transmitter behind a loss", "a chain that erases", type(channel).__name__)


def _behind(channel: AbstractRandomAffine, second: Second) -> Second:
    """E (z, 1)(z, 1)' behind a map, of what arrives."""
    match channel:
        case Erasure():
            return _behind(channel.base, second)
        case Series():
            for part in channel.maps:
                second = _behind(part, second)
            return second
        case Delayed():
            return _behind(channel.link, second)
    moments = channel.moments(2)
    tensor = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    mean, xp = moments.mean[:-1] @ second[:, -1], library(tensor, second)
    result: Second = xp.block(
        [[xp.einsum("ijab,ab->ij", tensor, second), mean[:, None]], [mean[None], np.ones((1, 1))]]
    )
    return result


def _line(second: Second, times: int) -> Second:
    """Of the line (y_k, y_{k-1}, ...): each as the present one; a delay chooses one of them, so no two meet."""
    xp = library(second)
    mean, whole = xp.tile(second[:-1, -1], times), xp.kron(np.eye(times), second[:-1, :-1])
    result: Second = xp.block([[whole, mean[:, None]], [mean[None], np.ones((1, 1))]])
    return result


def allocated(
    channel: AbstractRandomAffine, second: Second, powers: Mapping[str, float], step: int = 0
) -> AbstractRandomAffine:
    """The channel whose named transmitters send these powers: each amplifies what it hears to its own.

    Raises:
        ValueError: a transmitter that hears nothing which it could amplify.
    """
    for name in names_of(channel):  # a relay hears what those before it send
        if name in powers:
            now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                channel = _woken(channel, name)
                now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                raise fail(f"transmitter {name!r}", "a signal that can be amplified", "none")
            channel = scaled(channel, {name: np.sqrt(powers[name] / now) if now > 0 else 0.0})
    return channel


def _woken(channel: AbstractRandomAffine, silent: str) -> AbstractRandomAffine:
    """The channel in which a transmitter whose matrix is zero sends what it hears."""

    def act(name: str, hop: Hop) -> Hop:
        if name != silent:
            return hop
        result: Hop = eqx.tree_at(lambda h: h.matrix, hop, np.eye(*np.shape(hop.matrix)))
        return result

    return walked(channel, act)[0]


def selected(names: Sequence[str], wanted: Sequence[str], what: str) -> np.ndarray:
    """Which of the names are wanted, by name or by what stands before a dot.

    Raises:
        ValueError: one that is there under no name.
    """
    chosen = np.zeros(len(names), dtype=bool)
    for one in wanted:
        hit = np.array([name == one or name.startswith(f"{one}.") for name in names])
        if not np.any(hit):
            raise fail(what, f"names of transmitters {list(names)}", repr(one))
        chosen |= hit
    return chosen


def _unknown(channel: AbstractRandomAffine) -> ValueError:
    expected = "hops in series, stacks, mixtures, modes, losses and delays"
    return fail("transmitters of a channel", expected, type(channel).__name__)
