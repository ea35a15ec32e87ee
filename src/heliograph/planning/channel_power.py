"""Power of each transmitter of a channel, and channels whose transmitters send other powers.

A transmitter sends whether it is received or not: of modes and mixtures in which it is silent it knows nothing. Behind
an observed loss (an erasure) a relay sends only what arrived.
"""

from collections.abc import Mapping
from math import prod
from typing import Any

import equinox as eqx
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, is_zero, library, plain
from heliograph.numerics.types import Array, Float, Scalar
from heliograph.planning.transmitters import (
    BEGINNING,
    Hop,
    Place,
    is_silent,
    replace_hops,
    transmits,
    transmitter_names,
    unknown,
)
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.chain import stationary
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed, OfLine, sent
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.second_moments import second_moment_tensor

UNCHANGED = 1e-12  # change of a law in a step that counts as none

Second = Float[Array, "p p"]  # E (y, 1)(y, 1)'


def sent_powers(channel: AbstractRandomAffine, second: Second, step: int = 0) -> dict[str, Any]:
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
    joint = joint_modes(channel, order=2)
    total: dict[str, Scalar] = dict.fromkeys(transmitter_names(channel), 0.0)
    occurs = dict(total)
    for weight, map_ in zip(law, joint.maps, strict=True):
        powers: dict[str, Scalar] = {}
        _send(map_, second, BEGINNING, 1.0, powers)
        for name, power in powers.items():
            total[name] += weight * power
            occurs[name] += weight
    return {name: _over(total[name], occurs[name]) for name in total}


def _over(total: Scalar, probability: Scalar) -> Scalar:
    """Conditional mean; zero where the condition never holds."""
    if is_traced(probability):
        quotient: Scalar = total / library(probability).where(probability == 0, 1.0, probability)
        return quotient
    return 0.0 if is_zero(probability) else plain(total / probability)


def _send(
    channel: AbstractRandomAffine, second: Second, place: Place, arrives: Scalar, powers: dict[str, Scalar]
) -> Place:
    """Note the powers in a map without memory, and return the place behind it; `arrives` is the input's probability."""
    match channel:
        case GainAndNoise():
            if not transmits(channel):
                return place
            place = place._replace(hops=place.hops + 1)
            if is_silent(channel):  # a transmitter that is not received sends as in other modes
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
                _send(part, second, Place(f"{place.prefix}part{i}.", 0), arrives, powers)
        case Mixture():
            return _send_mixture(channel, second, place, arrives, powers)
        case Erasure():
            return _send(channel.base, second, place, arrives, powers)
        case Delayed():
            return _send(channel.link, second, place, arrives, powers)
        case OfLine():
            return _send(channel.plain, _line(second, channel.inputs // sent(channel)), place, arrives, powers)
        case _:
            raise unknown(channel)
    return place


def _send_mixture(channel: Mixture, second: Second, place: Place, arrives: Scalar, powers: dict[str, Scalar]) -> Place:
    if sum(not is_silent(part) for part in channel.maps) > 1:
        for i, part in enumerate(channel.maps, 1):
            _send(part, second, Place(f"{place.prefix}choice{i}.", 0), arrives, powers)
        return place
    for part in channel.maps:
        place = _send(part, second, place, arrives, powers)
    return place


def _arrival(channel: AbstractRandomAffine) -> Scalar:
    """Probability that a signal comes through."""
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
    """Moment of the line (y_k, y_{k-1}, ...): each as the present one; a delay chooses one of them, so no two meet."""
    xp = library(second)
    mean, blocks = xp.tile(second[:-1, -1], times), xp.kron(np.eye(times), second[:-1, :-1])
    result: Second = xp.block([[blocks, mean[:, None]], [mean[None], np.ones((1, 1))]])
    return result


def allocate(
    channel: AbstractRandomAffine, second: Second, powers: Mapping[str, float], step: int = 0
) -> AbstractRandomAffine:
    """Channel whose named transmitters send these powers: each amplifies what it receives to its power.

    Raises:
        ValueError: a transmitter that receives nothing which it could amplify.
    """
    for name in transmitter_names(channel):  # in order: a relay receives what those before it send
        if name in powers:
            now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                channel = _amplified(channel, name, None)
                now = sent_powers(channel, second, step)[name]
            if now <= 0 < powers[name]:
                raise fail(f"transmitter {name!r}", "a signal that can be amplified", "none")
            channel = _amplified(channel, name, np.sqrt(powers[name] / now) if now > 0 else 0.0)
    return channel


def _amplified(channel: AbstractRandomAffine, name: str, factor: float | None) -> AbstractRandomAffine:
    """Channel in which a transmitter amplifies by this factor more; None: sends what it receives, whatever it sent."""

    def change(hop_name: str, hop: Hop) -> Hop:
        if hop_name != name:
            return hop
        matrix = np.eye(*np.shape(hop.matrix)) if factor is None else np.asarray(hop.matrix) * factor
        result: Hop = eqx.tree_at(lambda h: h.matrix, hop, matrix)
        return result

    return replace_hops(channel, change)[0]
