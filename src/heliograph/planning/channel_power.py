"""What power each transmitter of a channel sends.

A transmitter sends whether it is heard or not: of modes and mixtures in which it is silent it knows nothing. Behind a
loss that is told (an erasure) a relay sends only what arrived.
"""

from math import prod
from typing import Any

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced, is_zero, library, plain
from heliograph.numerics.types import Array, Float, Scalar
from heliograph.planning.transmitters import BEGINNING, Place, is_silent, names_of, transmits, unknown
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.chain import stationary
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed, OfLine, sent
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.second_moments import second_moment_tensor

STAYS = 1e-12  # change of a law in a step that counts as none

Second = Float[Array, "p p"]  # E (y, 1)(y, 1)'


def sent_powers(channel: AbstractRandomAffine, second: Second, step: int = 0) -> dict[str, Any]:
    """Mean square of what each transmitter sends at a step, from E (y, 1)(y, 1)' of what is given to the channel.

    Exact: of modes in the law that they have at the step.

    Raises:
        ValueError: a map of a kind whose transmitters are not known.
    """
    joint = joint_modes(channel, order=2)
    law = joint.initial @ library(joint.transition).linalg.matrix_power(joint.transition, step)
    return by_mode(channel, second, law)


def steady_powers(channel: AbstractRandomAffine, second: Second) -> dict[str, Any]:
    """The same in the long run, whatever modes it began with."""
    joint = joint_modes(channel, order=2)
    stays = np.allclose(joint.initial @ joint.transition, joint.initial, rtol=0.0, atol=STAYS)
    return by_mode(channel, second, joint.initial if stays else stationary(joint.transition))


def by_mode(channel: AbstractRandomAffine, second: Second, law: Float[Array, "modes"]) -> dict[str, Any]:
    """The same where the channel's modes have this law (one mode, of a channel that forgets)."""
    joint = joint_modes(channel, order=2)
    total: dict[str, Scalar] = dict.fromkeys(names_of(channel), 0.0)
    seen = dict(total)
    for weight, one in zip(law, joint.maps, strict=True):
        powers: dict[str, Scalar] = {}
        _send(one, second, BEGINNING, 1.0, powers)
        for name, power in powers.items():
            total[name] += weight * power
            seen[name] += weight
    return {name: _over(total[name], seen[name]) for name in total}


def _over(total: Scalar, seen: Scalar) -> Scalar:
    """Their quotient; zero where nothing was seen."""
    if is_traced(seen):
        quotient: Scalar = total / library(seen).where(seen == 0, 1.0, seen)
        return quotient
    return 0.0 if is_zero(seen) else plain(total / seen)


def _send(
    channel: AbstractRandomAffine, second: Second, place: Place, arrives: Scalar, powers: dict[str, Scalar]
) -> Place:
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
    own = [not is_silent(part) for part in channel.maps]
    if sum(own) > 1:
        for i, part in enumerate(channel.maps, 1):
            _send(part, second, Place(f"{place.prefix}choice{i}.", 0), arrives, powers)
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
