"""Designs compared: over total powers, over places, and after each change of the network by a sensor or a relay."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.channel import amplify_and_forward
from heliograph.model.over_time import first
from heliograph.numerics.check import InputError, array, fail, function, instance
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.design_problem import DesignProblem, PowerDesign
from heliograph.planning.network_design import design
from heliograph.planning.power_budget import Budget, PerTransmitter, make_budget
from heliograph.planning.transmitters import transmitter_names, visit_hops
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import AbstractHop, GainAndNoise
from heliograph.random_affine.laws.law import GivenMoments
from heliograph.random_affine.moments.signal_path import SignalMoment
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

SPAN, POINTS = 10.0, 9  # of the totals that are tried about a design's: down and up by this factor, so many
SITE_STARTS, CHANGE_STARTS = 8, 16  # descents at each place, and after each change: compared, not built

Advance = TypeAliasType("Advance", Callable[[str], None])


def _report_nothing(what: str) -> None:
    """Do nothing: the default for `advance`, by which progress is not reported."""


@readable
class ErrorsOverPower(NamedTuple):
    """Least errors at several total powers in rising order, and bounds below which no error is; shapes (points,).

    No error is above that of less power: what less power reaches, more reaches too.
    """

    totals: Float[np.ndarray, "points"]
    errors: Float[np.ndarray, "points"]
    bounds: Float[np.ndarray, "points"]


def error_over_power(
    problem: DesignProblem, totals: Sequence[float], advance: Advance = _report_nothing
) -> ErrorsOverPower:
    """Return the least error at each of several total powers.

    Args:
        problem: the design problem; its other limits of power stay.
        totals: total powers, shape (points,), positive.
        advance: called with a text before each design, to show progress (by default nothing is).

    Returns:
        totals in rising order, errors, and bounds below which no error is, each of shape (points,).

    Raises:
        ValueError: totals that are not positive, what `hg.design` refuses.
    """
    instance("problem", problem, DesignProblem, "a DesignProblem")
    powers = np.unique(array("budgets of the front", totals, (None,)))
    if not len(powers) or powers[0] <= 0:
        raise fail("budgets of the front", "positive numbers", list(totals))
    designs = []
    for total in powers:
        advance(f"the best for a power of {total:.4g}")
        designs.append(design(problem.replace_total(float(total))))
    # A design that was found for less power counts for more power too: the least error so far.
    errors = np.minimum.accumulate([best.error for best in designs])
    # No bound below all possible errors may be above an error that was reached.
    bounds = np.minimum([best.bound for best in designs], errors)
    return ErrorsOverPower(totals=powers, errors=errors, bounds=bounds)


def list_totals_about(total: float) -> list[float]:
    """Return POINTS total powers on both sides of this one, from a SPANth of it to SPAN times it."""
    return [float(power) for power in total * np.geomspace(1 / SPAN, SPAN, POINTS)]


@readable
class ErrorsOverSites(NamedTuple):
    """Errors (len(y), len(x)) at places, and the best of them."""

    x: Float[np.ndarray, "columns"]
    y: Float[np.ndarray, "rows"]
    errors: Float[np.ndarray, "rows columns"]

    @property
    def best(self) -> tuple[float, float, float]:
        """Best place and its error: x, y, error."""
        row, column = np.unravel_index(np.argmin(self.errors), self.errors.shape)
        return float(self.x[column]), float(self.y[row]), float(self.errors[row, column])


def error_over_sites(
    best: "PowerDesign",
    build: "Callable[[float, float], Network]",
    x: "Float[ArrayLike, ' columns']",
    y: "Float[ArrayLike, ' rows']",
    advance: Advance = _report_nothing,
) -> "ErrorsOverSites":
    """Return the least error at a design's total power where its network stands at each of several places.

    Args:
        best: the design: a division of a total power among transmitters, with the problem that it solves.
        build: function that returns the network for a place (x, y), such as of a relay.
        x: first coordinates of the places, shape (columns,).
        y: second coordinates, shape (rows,); all pairs (x, y) are tried.
        advance: called with a word before each row (by default nothing is).

    Returns:
        x, y, the errors at all places, shape (rows, columns), and the best place.

    Raises:
        ValueError: a function that builds no network, what `hg.design` refuses.
    """
    # Check the design, the function and the places.
    instance("design", best, PowerDesign, "a PowerDesign")
    function("network of a map", build, "x and y")
    columns = array("x of a map", x, (None,))
    rows = array("y of a map", y, (None,))
    # The design is made again at each place. A few starts are enough, since errors are only compared.
    problem = best.problem.replace_total(best.total)
    problem = replace(problem, starts=min(problem.starts, SITE_STARTS))
    errors = np.zeros((len(rows), len(columns)))
    for row, north in enumerate(rows):
        advance(f"the map at y = {north:.4g}")
        for column, east in enumerate(columns):
            network = build(float(east), float(north))
            if not isinstance(network, Network):
                raise fail("map", "a function of x and y that returns a Network", type(network).__name__)
            errors[row, column] = design(replace(problem, network=network)).error
    return ErrorsOverSites(x=columns, y=rows, errors=errors)


@readable
class ChangeWorth(NamedTuple):
    """Worth of a change of the network.

    Args:
        name: what changes: "one more a", "without a", "a relay halfway of a.hop1".
        value: error of the design made again, or its power if an error is the target.
        saved: how much less it is than before the change.
    """

    name: str
    value: float
    saved: float


def worth_of_changes(
    best: PowerDesign, exponent: float | None = None, advance: Advance = _report_nothing
) -> list[ChangeWorth]:
    """Return what each change of a design's network is worth: a sensor more, one less, or a relay within a hop.

    A design chooses the powers of transmitters for the least error, or the least power for a target error. It is made
    again with each sensor doubled, with each left out, and with a relay halfway in each hop. Such a relay makes two
    hops of one, each with 2^exponent times its power gain E g^2, as the distance is halved, and the same kappa and
    noise. A new transmitter has the limits of the one that it doubles or relieves. A change that cannot be designed,
    such as one whose fixed powers exceed the budget, is not listed.

    Args:
        best: the design of the unchanged network.
        exponent: exponent of the path loss; without it no relays are tried.
        advance: called with a word before each design (by default nothing is).

    Returns:
        Changes with their names, the value of the design and what it saves; the change that saves most comes first.

    Raises:
        ValueError: a design of anything but a Network.
    """
    instance("design", best, PowerDesign, "a PowerDesign")
    network = instance("network of the design", best.problem.network, Network, "a Network")
    # Fewer starts of the search, to save time.
    problem = replace(best.problem, starts=min(best.problem.starts, CHANGE_STARTS))
    worths = []
    for name, changed in _list_changes(problem, network, exponent).items():
        advance(name)
        try:
            value = design(changed).certificate.value
        except InputError:  # such as one more sensor that is not free, whose power is above the budget
            continue
        worths.append(ChangeWorth(name=name, value=value, saved=best.certificate.value - value))
    return sorted(worths, key=lambda change: -change.saved)


def _list_changes(problem: DesignProblem, network: Network, exponent: float | None) -> dict[str, DesignProblem]:
    """Return {name of a change: the design problem of the changed network}.

    Comparing their optimal designs says which change of the network would be worth most. Changes are: each sensor once
    more, each sensor left out, and, if `exponent` (of the path loss: power falls as distance^-exponent) is given, a
    relay in the middle of each hop. `problem` holds the powers that are free (`free`, names of transmitters or nodes)
    and the budget or the target error.
    """
    senders = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    nodes = {name: Node(node.sensor, node.channel, {}) for name, node in senders.items()}  # without filters
    free = _list_free_names(problem)
    problems = {}
    for name, node in nodes.items():
        own = [f"{name}.{hop}" for hop in transmitter_names(first(node.channel))]
        # The sensor once more. If some powers are free by name, the new sensor's are too.
        twin = f"{name} again"
        twice = {each: (each, twin + each.removeprefix(name)) for each in own}
        with_twin = None if free is None else (*free, twin)
        problems[f"one more {name}"] = _change_nodes(problem, network, {**nodes, twin: node}, with_twin, twice)
        # The sensor left out, unless nothing is left or nothing is free then. With a target error it is not tried, as
        # that is one of all sensors.
        still_free = None if free is None else tuple(each for each in free if _find_node_of_transmitter(each) != name)
        if len(nodes) > 1 and still_free != () and problem.target_error is None:
            rest = {other: other_node for other, other_node in nodes.items() if other != name}
            none_left: dict[str, tuple[str, ...]] = dict.fromkeys(own, ())
            problems[f"without {name}"] = _change_nodes(problem, network, rest, still_free, none_left)
        if exponent is not None and isinstance(node.channel, AbstractRandomAffine):
            problems |= _list_relays(problem, network, nodes, name, exponent)
    return problems


def _list_free_names(problem: DesignProblem) -> tuple[str, ...] | None:
    """Return the names of transmitters or nodes whose powers are free, None where all are."""
    named = [problem.free] if isinstance(problem.free, str) else problem.free
    return None if named is None else tuple(named)


def _list_relays(
    problem: DesignProblem, network: Network, nodes: dict[str, Node], name: str, exponent: float
) -> dict[str, DesignProblem]:
    """Return {name of a change: the design problem} with a relay in the middle of each hop of the node `name`.

    A relay changes the numbers in the names of hops behind it, so that nodes are free as
    a whole. It has the limits of the transmitter whose hop it halves.

    Args:
        problem: the design problem of the unchanged network.
        network: the unchanged network.
        nodes: all its nodes, without filters.
        name: name of the node whose hops get a relay.
        exponent: exponent of the path loss: power falls as distance^-exponent.
    """
    node = nodes[name]
    problems = dict[str, DesignProblem]()
    free = _list_free_names(problem)
    assert isinstance(node.channel, AbstractRandomAffine)
    free_nodes = None if free is None else tuple(dict.fromkeys(_find_node_of_transmitter(each) for each in free))
    hops = transmitter_names(node.channel)
    for i, hop in enumerate(hops):
        channel = _insert_relay(node.channel, hop, exponent)
        # Hop i becomes the hops i and i + 1, and those behind it move on by one.
        now = [f"{name}.{each}" for each in transmitter_names(channel)]
        renamed: dict[str, tuple[str, ...]] = {f"{name}.{each}": (now[j + (j > i)],) for j, each in enumerate(hops)}
        renamed[f"{name}.{hop}"] = (now[i], now[i + 1])
        with_relay = {**nodes, name: Node(node.sensor, channel, {})}
        problems[f"a relay halfway of {name}.{hop}"] = _change_nodes(problem, network, with_relay, free_nodes, renamed)
    return problems


def _change_nodes(
    problem: DesignProblem,
    network: Network,
    nodes: dict[str, Node],
    free: tuple[str, ...] | None,
    renamed: Mapping[str, tuple[str, ...]],
) -> DesignProblem:
    """Return the design problem of a network of other nodes, with limits by name moved to the transmitters there are.

    Args:
        problem: of the unchanged network.
        network: the unchanged one, whose plant stays.
        nodes: of the changed network.
        free: names of its transmitters or nodes whose powers are free; None for all.
        renamed: the names there of a transmitter of the unchanged network; one that is not listed keeps its name.
    """

    def rename(limit: PerTransmitter) -> PerTransmitter:
        """Return a limit with the names that transmitters have in the changed network; a number for all as it is.

        `renamed` has the new names of each transmitter that has others; it may be doubled, or left out.
        """
        if not isinstance(limit, dict):
            return limit
        return {new: number for name, number in limit.items() for new in renamed.get(name, (name,))}

    budget = None if problem.budget is None else make_budget(problem.budget)
    if budget is not None:
        budget = Budget(budget.total, rename(budget.per_transmitter), rename(budget.peak))
    return replace(problem, network=Network(network.plant, nodes), free=free, budget=budget)


def _find_node_of_transmitter(transmitter: str) -> str:
    """Return the name of a transmitter's node: "north" of "north.hop1"."""
    return transmitter.partition(".")[0]


def _insert_relay(channel: AbstractRandomAffine, name: str, exponent: float) -> AbstractRandomAffine:
    """Return the channel in which a relay stands halfway of the hop of this name.

    Power falls with distance^exponent: over half the distance E g^k grows by 2^(exponent k / 2). Both halves have the
    noise of the whole hop.
    """

    def insert_into_hop(hop_name: str, hop: AbstractHop, signal: SignalMoment | None) -> AbstractRandomAffine:
        """Return the hop called `name` as a chain of two hops with a relay halfway; any other hop stays as it is.

        Both halves have the noise of the whole. Half the distance multiplies E g^k by 2^(exponent k / 2), with
        `exponent` of the path loss.
        """
        if hop_name != name or not isinstance(hop, GainAndNoise):
            return hop
        mean, square = (float(hop.law.moment(k)) * 2 ** (exponent * k / 2) for k in (1, 2))
        law = GivenMoments([mean, square])
        onward = GainAndNoise(law, np.eye(hop.outputs), hop.noise)
        return amplify_and_forward([GainAndNoise(law, hop.matrix, hop.noise), onward])

    return visit_hops(channel, insert_into_hop)
