"""A network as independent paths of hops, each of which carries one combination of a sensor's outputs."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import at, first, steps_covered
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import check_horizon, fail, instance
from heliograph.numerics.types import Float
from heliograph.planning.adjoint import Plants
from heliograph.planning.channel_power import sent_powers
from heliograph.planning.criterion import Error
from heliograph.planning.paths import Paths
from heliograph.planning.state_power import check_constant_noise, of_sensor, seconds_over, steady_second
from heliograph.planning.transmitters import transmits
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

ALIKE = 1e-12  # relative: a covariance of noises that counts as none


class Route(NamedTuple):
    """A chain of hops for one number: what it carries of (outputs, 1), and kappa and alpha of each hop by name."""

    chosen: Float[np.ndarray, "m1"]
    hops: dict[str, tuple[float, float]]


def routes(channel: AbstractRandomAffine, chosen: Float[np.ndarray, "k m1"], prefix: str = "") -> list[Route]:
    """The routes of a channel that is given chosen @ (y, 1).

    Raises:
        ValueError: a channel that is not made of independent chains, each for one number.
    """
    match channel:
        case GainAndNoise() if not transmits(channel):  # a wire tells each number as it is
            return [Route(row, {}) for row in np.asarray(channel.matrix) @ chosen]
        case Stack():
            return [
                route for i, part in enumerate(channel.maps, 1) for route in routes(part, chosen, f"{prefix}part{i}.")
            ]
        case Series():
            head, *rest = channel.maps
            if isinstance(head, GainAndNoise) and not transmits(head) and rest:
                onward = rest[0] if len(rest) == 1 else Series(rest)
                given = np.asarray(head.matrix) @ chosen
                given[:, -1] += np.asarray(head.noise.mean)
                return routes(onward, given, prefix)
            if isinstance(head, Series):
                return routes(Series([*head.maps, *rest]), chosen, prefix)
            if isinstance(head, Stack):
                raise _unfit("a stack that is sent on")
    return [_chain(channel, chosen, prefix)]


def _chain(channel: AbstractRandomAffine, chosen: Float[np.ndarray, "k m1"], prefix: str) -> Route:
    if channel.outputs != 1:
        raise _unfit(f"one gain for {channel.outputs} numbers")
    parts = list(channel.maps) if isinstance(channel, Series) else [channel]
    row, fading, moved = chosen[0], 1.0, False
    hops: dict[str, tuple[float, float]] = {}
    while parts:
        part = parts.pop(0)
        if isinstance(part, Series):
            parts = [*part.maps, *parts]
            continue
        if isinstance(part, Mixture):
            inner, lost = _lost(part)
            parts, fading = [inner, *parts], fading * lost
            continue
        if not isinstance(part, GainAndNoise):
            raise _unfit(type(part).__name__)
        if not hops:
            row = np.asarray(part.matrix)[0] @ chosen if part.inputs > 1 else chosen[0]  # of one number, in its units
        if transmits(part):
            if moved:
                raise _unfit("a relay that takes a reference off")
            hops[f"{prefix}hop{len(hops) + 1}"] = _hop(part)
        elif part.inputs != 1 or part.outputs != 1:
            raise _unfit("a wire of several numbers behind a hop")
        elif hops:
            moved = moved or bool(np.any(np.asarray(part.noise.mean)))
    if hops:
        last = list(hops)[-1]
        hops[last] = (hops[last][0] * fading, hops[last][1])
    elif fading > 1:
        raise _unfit("a wire that loses what it carries")
    return Route(row, hops)


def _hop(part: GainAndNoise) -> tuple[float, float]:
    """kappa = E g^2 / (E g)^2 and alpha = Var m / E g^2."""
    if len(part.law.extremes()) > 1:
        raise _unfit("a gain with uncertain probabilities")
    mean, square = float(part.law.moment(1)), float(part.law.moment(2))
    if mean == 0:
        raise fail("hop", "a gain whose mean is not zero (a linear filter hears nothing else)", "mean 0")
    if np.any(np.asarray(part.noise.mean)):
        raise _unfit("noise with a mean")
    return square / mean**2, float(np.asarray(part.noise.covariance)[0, 0]) / square


def _lost(part: Mixture) -> tuple[AbstractRandomAffine, float]:
    """What a loss that nobody is told of is a loss of, and 1 / (probability that it arrives)."""
    p = np.asarray(part.choice.probabilities)
    silent = [isinstance(m, GainAndNoise) and not np.any(np.append(m.matrix, m.noise.covariance)) for m in part.maps]
    if silent.count(False) != 1 or part.corner_count() > 1 or not (arrives := float(p[silent.index(False)])) > 0:
        raise _unfit("a mixture of several channels")
    return part.maps[silent.index(False)], 1 / arrives


def _unfit(got: str) -> ValueError:
    return fail("network", "independent paths, each a chain of hops for one number", got)


class _Step(NamedTuple):
    """One step: of each path c, s and t, of each hop kappa, alpha, the power sent now, the name, and its path."""

    rows: list[np.ndarray]
    second: list[float]
    signal: list[float]
    kappa: list[float]
    alpha: list[float]
    powers: list[float]
    names: list[str]
    path: list[int]


def paths_of(network: Network, error: Error) -> tuple[Paths, Float[np.ndarray, "time hop"]]:
    """The network as the best linear filter of everything that its nodes receive has it, and what is sent now.

    Raises:
        ValueError: a network that is not of independent paths, a plant that is not linear or, without a horizon, not
            stable.
    """
    instance("network", network, Network, "a Network")
    instance("error", error, Error, "an Error")
    plant, steps = network.plant, error.steps
    check_constant_noise(plant)
    if first(plant).inputs:
        raise fail("plant of a design", "no inputs", list(first(plant).inputs))
    refuse_angles("design", plant)
    if network.relays is not None:
        raise fail("network", "a RelayNetwork alone, whose relays' gains are free", "a Network of relays that filter")
    if network.common is not None:
        raise _unfit("nodes that share a channel (give a function of free numbers)")
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    covered = steps_covered((plant, [(node.sensor, node.channel) for node in nodes.values()]))
    if error.horizon is None:
        if covered is not None:
            raise fail("steady error", "a network that does not vary (give a horizon)", "parts that are OverTime")
        seconds, start = np.tile(steady_second(plant), (steps, 1, 1)), None
    else:
        check_horizon(steps, covered)
        seconds, start = seconds_over(plant, steps), np.asarray(first(plant).initial_covariance)
    each = [_at_step(nodes, k, second) for k, second in enumerate(seconds)]
    rows, second, signal, kappa, alpha, powers = (np.array(part) for part in list(zip(*each, strict=True))[:6])
    moves = [at(plant, k) for k in range(steps)]
    plants = Plants(np.array([p.matrix for p in moves]), np.array([p.noise.covariance for p in moves]), start)
    path, names = np.array(each[0].path), tuple(each[0].names)
    return Paths(plants, rows, second, signal, path, kappa, alpha, names), powers


def _at_step(nodes: Mapping[str, Node], k: int, state: Float[np.ndarray, "n1 n1"]) -> _Step:
    found = _Step([], [], [], [], [], [], [], [])
    for name, node in nodes.items():
        if node.told_by is not None:
            raise _unfit("a sensor that hears back, whose power depends on the error")
        sensor, channel = at(node.sensor, k), at(node.channel, k)
        if not isinstance(sensor, LinearSensor):
            raise fail(f"sensor of {name!r}", "a LinearSensor", type(sensor).__name__)
        refuse_angles("design", sensor)
        y, noise = of_sensor(sensor, state), np.asarray(sensor.noise.covariance)
        each, sends = routes(channel, np.eye(len(sensor.outputs), len(y))), sent_powers(channel, y, k)
        _check_apart(name, np.array([route.chosen[:-1] for route in each]), noise)
        for route in each:
            chosen = route.chosen[:-1]
            found.rows.append(chosen @ np.asarray(sensor.matrix))
            found.second.append(float(route.chosen @ y @ route.chosen))
            found.signal.append(found.second[-1] - float(chosen @ noise @ chosen))
            if not route.hops and not found.second[-1] > found.signal[-1]:
                raise fail(f"sensor of {name!r}", "noise, since a wire adds none", "none")
            for hop, (kappa, alpha) in route.hops.items():
                found.kappa.append(kappa)
                found.alpha.append(alpha)
                found.powers.append(sends[hop])
                found.names.append(f"{name}.{hop}")
                found.path.append(len(found.rows) - 1)
    return found


def _check_apart(name: str, chosen: Float[np.ndarray, "path m"], covariance: Float[np.ndarray, "m m"]) -> None:
    """Raise ValueError where paths carry noise of the sensor that they share."""
    noise = chosen @ covariance @ chosen.T
    own = np.sqrt(np.diag(noise))
    apart = noise - np.diag(np.diag(noise))
    if np.any(np.abs(apart) > ALIKE * np.outer(own, own)):
        raise _unfit(f"paths of {name!r} that share a sensor's noise")
