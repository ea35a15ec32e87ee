"""What sensors are worth: the error of one filter of all nodes, with some left out, out for a while, or added."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.filter_for_likelihood import likelihood_filter
from heliograph.learning.told_numbers import find_told_filter
from heliograph.model.augmented.joint_sensors import join_links
from heliograph.model.over_time import at_each_step, first
from heliograph.model.sensor import is_linear
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import check_count, fail, instance, items, table
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.planning.transmitters import require_plain_senders
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.simulate import monte_carlo


@readable
@dataclass(frozen=True)
class ErrorWithout:
    """Error of the filter of all nodes in one case.

    Args:
        name: "all", "without gnss", "gnss out for 60 steps", "with mast".
        error: root mean square error of each state at the end (n,).
        uncertainty: standard error of that, of the runs drawn (n,); 0 where it is computed.
        increase: the error over that of all nodes (n,), below 1 for one that is added; NaN where that is 0.
    """

    name: str
    error: Float[np.ndarray, " n"]
    uncertainty: Float[np.ndarray, " n"]
    increase: Float[np.ndarray, " n"]

    @property
    def mean_increase(self) -> float:
        """Return the geometric mean of the increase over states, which has no unit; NaN where one is not known."""
        with np.errstate(divide="ignore"):
            return float(np.exp(np.mean(np.log(self.increase))))


@readable
@dataclass(frozen=True)
class SensorWorth:
    """Errors with all nodes, and in each case.

    Args:
        states: names of the states (n,).
        complete: with all nodes of the network.
        cases: each node left out, each outage, each addition, in the order asked for.
        exact: whether errors are covariances of an exact filter, and not squares of errors that were drawn.
        added: names of the nodes that were tried, whose cases are the last.
    """

    states: tuple[str, ...]
    complete: ErrorWithout
    cases: tuple[ErrorWithout, ...]
    exact: bool
    added: tuple[str, ...] = ()

    @property
    def best_addition(self) -> ErrorWithout | None:
        """The case with the least error (`mean_increase`) among the nodes that were added; None of fewer than two."""
        # The cases of added nodes are the last ones.
        cases = self.cases[len(self.cases) - len(self.added) :]
        return min(cases, key=lambda case: case.mean_increase) if len(cases) > 1 else None

    def describe_method(self, runs: int) -> str:
        """Say how errors were found: by the covariance of an exact filter, or as those of so many runs.

        Args:
            runs: number of runs.
        """
        return "by the covariance" if self.exact else f"root mean square of {runs} runs"


class _SensorCase(NamedTuple):
    """A case: its name, and which rows of each node are used, False where a node's value is left out (steps, nodes)."""

    name: str
    used: Bool[np.ndarray, "steps nodes"]


def worth_of_sensors(
    network: "Network",
    steps: int = 200,
    without: "Sequence[str] | None" = None,
    outages: "Mapping[str, int] | None" = None,
    additions: "Mapping[str, Node] | None" = None,
    runs: int = 200,
    key: int = 0,
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
) -> "SensorWorth":
    """Compare the error at the end of a run, of one filter of all nodes, with nodes left out, out at the end, or added.

    The filter is the best linear one where plant and sensors are linear, else the cubature filter; it knows what is
    missing. Where its claim is exact, the error is its covariance, averaged over what the links lost in the runs;
    else the mean square of the errors drawn. All cases have the same draws, so that differences are known better than
    errors.

    Args:
        network: the network; its own filters do not matter.
        steps: length of a run, 200 by default; long enough to be steady where the steady error is asked for.
        without: nodes that are left out, each by itself; by default each of several.
        outages: for how many steps at the end of the run a node is out, by node; none by default.
        additions: nodes that are tried beside those there are, each by itself, such as one sensor at several places;
            none by default.
        runs: number of runs, at least 2; 200 by default.
        key: a seed, 0 by default.
        inputs: (steps, inputs), common to all runs; by default a plant without inputs is assumed.

    Raises:
        ValueError: a node that is not there, an outage longer than the run, an addition of a name that is taken, nodes
            or additions with triggers, words or feedback, relays that filter, a single run.
    """
    instance("network", network, Network, "a Network")
    nodes = _require_plain_nodes(network)
    added = table("additions", additions or {}, "nodes")
    if taken := [name for name in added if name in nodes]:
        raise fail("additions", "nodes of other names than the network's", taken[0])
    check_count("steps", steps)
    cases = list(_list_cases([*nodes], [*added], steps, without, table("outages", outages or {}, "steps")))
    # One filter of all that is received, additions included, and one set of draws, by nodes without their own filters.
    added = {name: instance(f"addition {name!r}", node, Node, "a Node") for name, node in added.items()}
    require_plain_senders("the additions", added)
    bare = {name: Node(node.sensor, node.channel, {}) for name, node in {**nodes, **added}.items()}
    filter_of_all = _make_filter_of_all(network, bare)
    is_exact = filter_of_all.claim == "exact"
    # Of fewer than two runs no spread is known.
    drawn = monte_carlo(Network(network.plant, bare), steps, check_count("runs", runs, 2), key, inputs=inputs)
    u = np.zeros((steps, 0)) if inputs is None else np.asarray(inputs, float)
    z = np.concatenate([drawn.measurements[name] for name in bare], axis=-1)
    truth = np.asarray(drawn.truth)
    # The error of each case, in which what is not used is NaN. The first case is that of all nodes.
    sizes = [bare[name].received for name in bare]
    errors: list[ErrorWithout] = []
    for case in cases:
        z_of_case = np.where(np.repeat(case.used, sizes, axis=1), z, np.nan)
        squares = _compute_squares_at_end(filter_of_all, z_of_case, u, truth, is_exact)
        errors.append(_make_error_of_case(case.name, squares, complete=errors[0].error if errors else None))
    complete, *others = errors
    return SensorWorth(network.states, complete=complete, cases=tuple(others), exact=is_exact, added=tuple(added))


def _make_error_of_case(
    name: str, squares: Float[np.ndarray, "runs n"], complete: Float[np.ndarray, " n"] | None
) -> ErrorWithout:
    """Return the root mean square error of a case, its standard error, and its ratio to the error with all nodes.

    Args:
        name: name of the case.
        squares: squared error of each state in each run, or its variance.
        complete: error with all nodes (n,); None if this is the case of all nodes.
    """
    error = np.sqrt(squares.mean(axis=0))
    # The standard error of a root is sd(sqrt(m)) = sd(m) / (2 sqrt(m)). One row stands for all runs, which agree.
    spread = squares.std(axis=0, ddof=min(1, len(squares) - 1)) / np.sqrt(len(squares))
    uncertainty = np.divide(spread, 2 * error, out=np.zeros_like(error), where=error > 0)
    of_all = error if complete is None else complete
    increase = np.divide(error, of_all, out=np.full_like(error, np.nan), where=of_all > 0)
    return ErrorWithout(name=name, error=error, uncertainty=uncertainty, increase=increase)


def _require_plain_nodes(network: Network) -> dict[str, Node]:
    """Return the nodes; raise ValueError unless each receives one sensor over one link.

    Relays that filter, nodes that share a channel, triggers, encoders and feedback are refused.
    """
    if network.relays is not None or network.common is not None:
        raise fail("network", "nodes that receive sensors through channels of their own", "relays that filter")
    require_plain_senders("a comparison of sensors", network.nodes)
    return {name: node for name, node in network.nodes.items() if isinstance(node, Node)}


def _list_cases(
    names: list[str], added: list[str], steps: int, without: Sequence[str] | None, outages: Mapping[str, int]
) -> Iterator[_SensorCase]:
    """Yield the cases: all nodes first, then each node left out, each outage, each addition.

    A case says which nodes' values a filter uses at which steps. Comparing its error with that of the case "all" shows
    what a sensor is worth.

    Args:
        names: names of the network's nodes.
        added: names of nodes that are tried beside them.
        steps: length of a run.
        without: nodes that are left out, each in a case of its own; None: every node, if there are several.
        outages: for how many steps at the end a node is out, by its name.
    """
    each_of_several = names if len(names) > 1 else []  # without a single one nothing would be received
    left_out = each_of_several if without is None else items("nodes left out", without, "names")
    for what, asked in (("nodes left out", left_out), ("outages", outages)):
        for name in asked:
            if name not in names:
                raise fail(what, f"some of the nodes {', '.join(names)}", repr(name))
    # Case "all": a mask (steps, nodes) with the additions in the last columns. The network's nodes are used at each
    # step, and additions are not.
    base = np.tile(np.isin([*names, *added], names), (steps, 1))
    yield _SensorCase("all", base)
    for name in left_out:
        used = base.copy()
        used[:, names.index(name)] = False
        yield _SensorCase(f"without {name}", used)
    for name, count in outages.items():
        if check_count(f"outage of {name!r}", count) > steps:
            raise fail(f"outage of {name!r}", f"at most the {steps} steps of the run", count)
        used = base.copy()
        used[steps - count :, names.index(name)] = False
        yield _SensorCase(f"{name} out for {count} steps", used)
    for i, name in enumerate(added):
        used = base.copy()
        used[:, len(names) + i] = True
        yield _SensorCase(f"with {name}", used)


def _make_filter_of_all(network: Network, nodes: Mapping[str, Node]) -> AbstractFilter:
    """Return the likelihood filter of everything the nodes receive, linear if plant and sensors are, without angles.

    Args:
        network: the network, for its plant.
        nodes: the nodes that are received, by name.
    """
    # The filter skips what is lost (NaN), so a channel without memory is taken given arrival. A channel with memory,
    # such as bursts, stays as it is, since one loss changes the probability of the next.
    plant = network.plant
    channels = [
        node.channel if first(node.channel).remembers else at_each_step(_condition_on_arrival, node.channel)
        for node in nodes.values()
    ]
    sensor, channel = join_links({name: node.sensor for name, node in nodes.items()}, channels)
    has_angles = first(plant).circular or first(sensor).circular
    return likelihood_filter(plant, sensor, channel, linear=not has_angles and is_linear(plant, sensor))


def _condition_on_arrival(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return the channel given that what it carries arrives."""
    return channel.condition_on_arrival() if channel.erases else channel


def _compute_squares_at_end(
    filter: AbstractFilter,
    z: Float[np.ndarray, "runs steps received"],
    u: Float[np.ndarray, "steps inputs"],
    truth: Float[np.ndarray, "runs steps n"],
    exact: bool,
) -> Float[np.ndarray, "runs n"]:
    """Return the squared error of each state after the last step of each run (runs, n), or if `exact` its variance.

    If variances are the same in all runs, only the first run is computed and returned (1, n).

    Args:
        filter: the filter of all nodes.
        z: simulated measurements (runs, steps, received), NaN where something is lost or left out.
        u: inputs (steps, inputs).
        truth: true states (runs, steps, n).
        exact: whether the filter's covariance is true, so that variances are taken in place of squared errors, which
            scatter.
    """
    squares, angles = [], filter.angles_used()
    # Variances depend on which outputs arrive, and on gains or noise variances that are reported with each message
    # (`numbers`), not on measured values. If both are the same in all runs, so are the variances.
    reported = find_told_filter(filter)
    is_reported = np.isin(np.arange(z.shape[-1]), () if reported is None else reported.numbers)
    deciding = np.where(is_reported, z, np.isnan(z))
    alike = exact and np.array_equal(deciding, np.broadcast_to(deciding[:1], z.shape), equal_nan=True)
    for z_of_run, x in zip(z, truth, strict=True):
        filtered = filter.run(z_of_run, u)
        if exact:
            squares.append(np.diagonal(filtered.covariances[-1]))
        else:
            # Errors of angles are within half a turn.
            squares.append(wrap_angles(filtered.means[-1] - x[-1], angles.states if angles else ()) ** 2)
        if alike:
            break
    return np.array(squares)
