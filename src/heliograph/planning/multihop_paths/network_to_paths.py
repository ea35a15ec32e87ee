"""A network as independent paths of hops, each of which carries one combination of a sensor's outputs."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import at, steps_covered
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import check_horizon, fail, instance
from heliograph.numerics.types import Float
from heliograph.planning.error_objective import Error
from heliograph.planning.multihop_paths.model import Paths, PlantSteps
from heliograph.planning.plant_moments import (
    measured_moment_with_one,
    moments_with_one_over,
    require_design_plant,
    steady_moment_with_one,
)
from heliograph.planning.transmitters import compute_sent_powers, require_plain_senders
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.series_and_stack import Stack
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

UNCORRELATED = 1e-12  # relative: a covariance of noises that counts as none


class HopChain(NamedTuple):
    """A chain of hops for one number: what it carries, and kappa and alpha of its hops.

    Args:
        row: the number is row @ (y, 1), with the sensor's outputs y (m + 1,).
        hops: {name: (kappa, alpha)} in the order of the chain, with kappa = E g^2 / (E g)^2 of a hop's gain g, and
            alpha its noise variance over E g^2.
    """

    row: Float[np.ndarray, "m1"]
    hops: dict[str, tuple[float, float]]


def paths_of(network: Network, error: Error) -> tuple[Paths, Float[np.ndarray, "time hop"]]:
    """Return a network's independent paths, as the best linear filter of all that its nodes receive has them.

    A path is the chain of hops (transmitters that amplify) from one sensor to the receiver. A planner of powers needs
    the gain and noise of each path, and the second moment of the signal that it carries.

    Args:
        network: nodes with linear sensors behind chains of hops.
        error: over which steps the planner counts the error: steady unless it has a period or a horizon.

    Returns:
        The paths, and the power that each transmitter sends at present, shape (time, hop).

    Raises:
        ValueError: a network that is not of independent paths, a plant that is not linear or, without a horizon, not
            stable.
    """
    # Check that the plant is linear and every node a plain one, of a linear sensor behind hops.
    instance("network", network, Network, "a Network")
    plant = network.plant
    steps = instance("error", error, Error, "an Error").steps
    start_plant = require_design_plant(plant)
    nodes = _require_plain_nodes(network)
    # Second moments E (x, 1)(x, 1)' of the plant at each step, or in its steady state.
    covered = steps_covered((plant, [(node.sensor, node.channel) for node in nodes.values()]))
    if error.horizon is None:
        if covered is not None:
            raise fail("steady error", "a network that does not vary (give a horizon)", "parts that are OverTime")
        seconds, start = [steady_moment_with_one(plant)] * steps, None
    else:
        check_horizon(steps, covered)
        seconds = moments_with_one_over(plant, steps)
        start = np.asarray(start_plant.initial_covariance)
    # Paths of each step, and the plant's A and Q.
    described = [_make_paths_of_step(nodes, k, np.asarray(second)) for k, second in enumerate(seconds)]
    plant_at = [at(plant, k) for k in range(steps)]
    paths = Paths(
        plants=PlantSteps(
            transition=np.array([now.matrix for now in plant_at]),
            process=np.array([now.noise.covariance for now in plant_at]),
            start=start,
        ),
        rows=np.array([step.rows for step in described]),
        second=np.array([step.second for step in described]),
        signal=np.array([step.signal for step in described]),
        path=np.array(described[0].path),
        kappa=np.array([step.kappa for step in described]),
        alpha=np.array([step.alpha for step in described]),
        names=tuple(described[0].names),
    )
    return paths, np.array([step.powers for step in described])


def _require_plain_nodes(network: Network) -> dict[str, Node]:
    """Return the nodes by name; raise ValueError for relays that filter, a shared channel, or senders not plain.

    A plain node has a sensor that sends what it measures at each step, over a channel of its own.
    """
    if network.relays is not None:
        raise fail("network", "a RelayNetwork alone, whose relays' gains are free", "a Network of relays that filter")
    if network.common is not None:
        raise _make_no_paths_error("nodes that share a channel (give a function of free numbers)")
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    require_plain_senders("a design", nodes)
    return nodes


def find_hop_chains(channel: AbstractRandomAffine, rows: Float[np.ndarray, "k m1"], prefix: str = "") -> list[HopChain]:
    """Return the chains of a channel that carries the numbers rows @ (y, 1); names of hops begin with `prefix`.

    y: the sensor's outputs. A wire is a known matrix without noise; the parts of a stack are chains side by side.

    Raises:
        ValueError: a channel that is not made of independent chains, each for one number.
    """
    head, *rest = channel.in_series
    # Wires multiply what is carried.
    while isinstance(head, GainAndNoise) and not head.transmits:
        rows = np.asarray(head.matrix) @ rows
        if not rest:
            return [HopChain(row, {}) for row in rows]
        rows[:, -1] += np.asarray(head.noise.mean)
        head, *rest = rest
    if not isinstance(head, Stack):
        return [_make_chain([head, *rest], rows, prefix)]
    if rest:
        raise _make_no_paths_error("a stack that is sent on")
    parts = enumerate(head.maps, 1)
    return [chain for i, affine in parts for chain in find_hop_chains(affine, rows, f"{prefix}part{i}.")]


def _make_chain(parts: list[AbstractRandomAffine], rows: Float[np.ndarray, "k m1"], prefix: str) -> HopChain:
    """Return maps in series as one chain: the row that it carries, kappa = E g^2 / (E g)^2 and alpha of each hop.

    Args:
        parts: the maps, in the order in which the signal passes them.
        rows: what arrives at the first one is rows @ (y, 1), with the sensor's outputs y.
        prefix: beginning of the names of hops.

    Raises:
        ValueError: maps that are not hops of one number, wires, and unobserved losses.
    """
    if parts[-1].outputs != 1:
        raise _make_no_paths_error(f"one gain for {parts[-1].outputs} numbers")
    maps, loss_factor = _take_losses_apart(parts)
    row = rows[0]
    has_offset = False  # whether a wire behind a hop has added a constant
    hops: dict[str, tuple[float, float]] = {}  # kappa and alpha by name
    for affine in maps:
        # The first map may combine several numbers; of a single one the hop's alpha holds the unit already.
        if not hops:
            row = np.asarray(affine.matrix)[0] @ rows if affine.inputs > 1 else rows[0]
        if affine.transmits:
            if has_offset:
                raise _make_no_paths_error("a relay that takes a reference off")
            hops[f"{prefix}hop{len(hops) + 1}"] = _compute_hop_kappa_and_alpha(affine)
        elif affine.inputs != 1 or affine.outputs != 1:
            raise _make_no_paths_error("a wire of several numbers behind a hop")
        elif hops:  # a wire behind a hop: its gain changes no ratio, but a constant would be amplified by a relay
            has_offset = has_offset or bool(np.any(np.asarray(affine.noise.mean)))
    # Losses multiply kappa of the last hop: a path's information depends on the product of its kappas alone.
    if hops:
        last = list(hops)[-1]
        kappa, alpha = hops[last]
        hops[last] = (kappa * loss_factor, alpha)
    elif loss_factor > 1:
        raise _make_no_paths_error("a wire that loses what it carries")
    return HopChain(row, hops)


def _take_losses_apart(parts: list[AbstractRandomAffine]) -> tuple[list[GainAndNoise], float]:
    """Return the maps of a series without its unobserved losses, and the product of the losses' kappas.

    A loss that nobody observes is a random gain, 0 or 1, of kappa = E g^2 / (E g)^2 = 1 / P(arrival). The maps that it
    may lose take its place in the series. `parts`: the maps of the series, in the order in which a signal passes them.

    Raises:
        ValueError: maps that are neither losses nor of one gain and noise.
    """
    left, maps, loss_factor = list(parts), list[GainAndNoise](), 1.0
    while left:
        affine = left.pop(0)
        if isinstance(affine, Mixture):
            inner, factor = _split_loss(affine)
            left = [*inner.in_series, *left]
            loss_factor = loss_factor * factor
        elif isinstance(affine, GainAndNoise):
            maps.append(affine)
        else:
            raise _make_no_paths_error(type(affine).__name__)
    return maps, loss_factor


def _compute_hop_kappa_and_alpha(hop: GainAndNoise) -> tuple[float, float]:
    """Return kappa = E g^2 / (E g)^2 and alpha = Var m / E g^2 of a hop that delivers g sent + m.

    These two numbers are all that the information of a path needs of a hop.
    """
    if len(hop.law.extremes()) > 1:
        raise _make_no_paths_error("a gain with uncertain probabilities")
    mean = float(hop.law.moment(1))
    square = float(hop.law.moment(2))
    if mean == 0:
        raise fail("hop", "a gain whose mean is not zero (a linear filter receives no signal else)", "mean 0")
    if np.any(np.asarray(hop.noise.mean)):
        raise _make_no_paths_error("noise with a mean")
    return square / mean**2, float(np.asarray(hop.noise.covariance)[0, 0]) / square


def _split_loss(mixture: Mixture) -> tuple[AbstractRandomAffine, float]:
    """Return the channel inside an unobserved loss, and 1 / (arrival probability), the factor of its kappa.

    Such a loss is a mixture of one channel with maps that deliver nothing.
    """
    probabilities = np.asarray(mixture.choice.probabilities)
    delivering = [index for index, affine in enumerate(mixture.maps) if not _delivers_nothing(affine)]
    has_uncertain_probabilities = mixture.corner_count() > 1
    if len(delivering) != 1 or has_uncertain_probabilities or not probabilities[delivering[0]] > 0:
        raise _make_no_paths_error("a mixture of several channels")
    index = delivering[0]
    return mixture.maps[index], 1 / float(probabilities[index])


def _delivers_nothing(affine: AbstractRandomAffine) -> bool:
    """Decide whether a map has neither a signal nor a noise."""
    return isinstance(affine, GainAndNoise) and not np.any(np.append(affine.matrix, affine.noise.covariance))


def _make_no_paths_error(got: str) -> ValueError:
    """Return the error that names what is no independent path."""
    return fail("network", "independent paths, each a chain of hops for one number", got)


class _PathsOfStep(NamedTuple):
    """Lists of one step, filled path by path; a path carries y = c x + v over its hops.

    Args:
        rows: c of each path.
        second: s = E y^2 of each path.
        signal: t = s - Var v of each path.
        kappa: of each hop.
        alpha: of each hop.
        powers: what each hop's transmitter sends at present.
        names: name of each hop's transmitter.
        path: number of each hop's path.
    """

    rows: list[np.ndarray]
    second: list[float]
    signal: list[float]
    kappa: list[float]
    alpha: list[float]
    powers: list[float]
    names: list[str]
    path: list[int]


def _make_paths_of_step(nodes: Mapping[str, Node], k: int, state: Float[np.ndarray, "n1 n1"]) -> _PathsOfStep:
    """Return the paths of all nodes at step k: what each carries, its powers, and its hops.

    A path carries a number c x + v from a sensor over a chain of hops, each a radio that amplifies what it receives,
    g sent + m. A planner of powers needs of each path c, s = E y^2 and t = s - Var v, and of each hop
    kappa = E g^2 / (E g)^2, alpha = Var m / E g^2 and the power that is sent.

    Args:
        nodes: nodes by name, each a linear sensor and a channel.
        k: the step.
        state: E (x, 1)(x, 1)' of the plant's state at this step.
    """
    # Lists, filled path by path and hop by hop.
    step = _PathsOfStep(rows=[], second=[], signal=[], kappa=[], alpha=[], powers=[], names=[], path=[])
    for name, node in nodes.items():
        sensor, channel = at(node.sensor, k), at(node.channel, k)
        if not isinstance(sensor, LinearSensor):
            raise fail(f"sensor of {name!r}", "a LinearSensor", type(sensor).__name__)
        refuse_angles("design", sensor)
        # Chains of the channel, and what their transmitters send at present, by E (y, 1)(y, 1)' of the outputs.
        measured = np.asarray(measured_moment_with_one(sensor, state))
        noise = np.asarray(sensor.noise.covariance)
        chains = find_hop_chains(channel, np.eye(len(sensor.outputs), len(measured)))
        sent_powers = compute_sent_powers(channel, measured, k)
        _check_uncorrelated(name, np.array([chain.row[:-1] for chain in chains]), noise)
        # Each chain is a path that carries chain.row @ (y, 1). Paths are numbered by their rows in the list.
        for chain in chains:
            weights = chain.row[:-1]  # of y alone
            step.rows.append(weights @ np.asarray(sensor.matrix))
            step.second.append(float(chain.row @ measured @ chain.row))
            step.signal.append(step.second[-1] - float(weights @ noise @ weights))
            # Without a hop and without the sensor's noise the path would tell the signal exactly.
            if not chain.hops and not step.second[-1] > step.signal[-1]:
                raise fail(f"sensor of {name!r}", "noise, since a wire adds none", "none")
            for hop, (kappa, alpha) in chain.hops.items():
                step.kappa.append(kappa)
                step.alpha.append(alpha)
                step.powers.append(sent_powers[hop])
                step.names.append(f"{name}.{hop}")
                step.path.append(len(step.rows) - 1)
    return step


def _check_uncorrelated(name: str, rows: Float[np.ndarray, "path m"], covariance: Float[np.ndarray, "m m"]) -> None:
    """Raise ValueError if two paths of a node carry correlated noise of its sensor.

    A correlation up to
    UNCORRELATED counts as rounding.

    Args:
        name: name of the node, for messages.
        rows: the combination of outputs that each path carries (path, m).
        covariance: covariance of the sensor's noise (m, m).
    """
    path_covariance = rows @ covariance @ rows.T
    variances = np.diag(path_covariance)
    deviations = np.sqrt(variances)
    off_diagonal = np.abs(path_covariance - np.diag(variances))
    if np.any(off_diagonal > UNCORRELATED * np.outer(deviations, deviations)):
        raise _make_no_paths_error(f"paths of {name!r} that share a sensor's noise")
