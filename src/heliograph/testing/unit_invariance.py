"""Test that the estimates of a network do not depend on the user's units."""

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.sequential_nodes import SequentialFilter
from heliograph.filters.linear.linear import LinearFilter
from heliograph.filters.wrappers.fed_back import PredictionFilter
from heliograph.fusion.joint_covariance_fusion import ScalarWeights
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.rules import CovarianceIntersection, InverseCovarianceIntersection
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order
from heliograph.random_affine.series_and_stack import Series
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.recordings.filter_recording import run
from heliograph.simulation.simulate import monte_carlo
from heliograph.testing.change_of_units import Units, rescale_channel, rescale_filter, rescale_plant, rescale_sensor

DECADES = 9  # factors from 1e-9 to 1e9
DIGITS = 1e-8  # of each component's own scale
SEARCHED = 1e-6  # where a flat minimum is searched for: it fixes its weights to the root of rounding alone
MISSING = 0.2  # share of the components that do not arrive


def check_scaling(
    network: Network, inputs: ArrayLike | None = None, steps: int = 5, seed: int = 0, trials: int = 1
) -> float:
    """Compare all estimates of a network with those of the same network in other units.

    Factors from 1e-9 to 1e9 are drawn for each state, output, measurement and input; every filter gets the model in the
    new units and the same simulated measurements, some missing. Means and covariances must agree to 1e-8 of each
    component's own scale. A rule that minimises a trace (covariance intersection, a bound with free scalars) adds
    squares of different units by definition: for it all states get one factor, and the weights that it optimises agree
    to 1e-6. The same holds for the descriptions of the channels that filters are made from. From a row on that a filter
    holds for impossible, with a log-likelihood of -inf, rounding decides what it makes of it: nominal estimates are
    compared before that row.

    Args:
        network: the network to test.
        inputs: the plant's inputs, shape (steps, inputs); by default none.
        steps: number of steps (default 5).
        seed: seed of the measurements and factors (default 0).
        trials: number of draws of the factors (default 1).

    Returns:
        The largest difference, relative to its tolerance.

    Raises:
        AssertionError: naming the node, the filter and the step; an estimate that is not finite.
        ValueError: a network of relays, a fusion with quantizers, a filter that has no covariances to compare.
    """
    check_count("steps", steps)
    random = np.random.default_rng(seed)
    world = monte_carlo(_drop_filters(network), steps, 1, seed, inputs=inputs)
    z = {name: np.array(rows[0]) for name, rows in world.measurements.items()}
    for name, rows in z.items():
        rows[random.random(rows.shape) < MISSING] = np.nan
        if (limits := network.nodes[name].limits) is not None:  # in these units: what a node refuses never arrives
            rows[limits.outside(rows)] = np.nan
    # The estimates in the user's units, and their greatest difference from those in drawn units: a factor for each
    # state, then (one_factor) one for all states.
    u = np.zeros((steps, 0)) if inputs is None else np.asarray(inputs, dtype=float)
    plain, worst = run(network, z, u).estimates, 0.0
    for _ in range(trials):
        for one_factor in (False, True):
            units = _draw_units(network, random, one_factor)
            worst = max(worst, _compare_runs(network, z, u, plain, units, one_factor))
    return worst


def _list_nodes(network: Network) -> dict[str, Node]:
    """Return the nodes by name; raise ValueError if some node does not measure the plant itself."""
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    if len(nodes) < len(network.nodes):
        raise fail("network to rescale", "nodes that receive the plant themselves", "a network of relays")
    return nodes


def _drop_filters(network: Network) -> Network:
    """Return the network without its filters, except where a filter feeds back to its sensor."""
    nodes = {
        name: Node(node.sensor, node.channel, {}) if node.informed_by is None else node
        for name, node in _list_nodes(network).items()
    }
    return Network(network.plant, nodes)


def _draw_units(network: Network, random: np.random.Generator, one_factor: bool) -> dict[str, Units]:
    """Return random units of each node, and of all nodes together under `Network.FUSED`.

    States and inputs have the same in all nodes; `one_factor`: all states have the same factor.
    """

    def draw(count: int) -> np.ndarray:
        """Return so many factors, from 10^-DECADES to 10^DECADES."""
        return np.asarray(10.0 ** random.uniform(-DECADES, DECADES, size=count))

    n = len(network.states)
    states = np.repeat(draw(1), n) if one_factor else draw(n)
    inputs, units = draw(len(network.inputs)), {}
    for name in network.names:
        node = network.nodes[name]
        units[name] = Units(states, outputs=draw(len(node.outputs)), received=draw(node.received), inputs=inputs)
    outputs = np.concatenate([units[name].outputs for name in network.names])
    received = np.concatenate([units[name].received for name in network.names])
    return units | {Network.FUSED: Units(states, outputs, received, inputs)}


def _compare_runs(
    network: Network,
    z: dict[str, np.ndarray],
    u: np.ndarray,
    plain: dict[str, dict[str, Estimate]],
    units: dict[str, Units],
    one_factor: bool,
) -> float:
    """Run the network in other units; return the largest difference of an estimate, as a share of what is allowed.

    Units are arbitrary, so the estimates must be the same but for their factors and for rounding.

    Some estimates come from a search that minimises a trace, a sum of squares of different units. By definition these
    end elsewhere in other units: they are compared, to SEARCHED, only where all states have one factor. All others are
    compared to DIGITS.

    Args:
        network: the network.
        z: measurements by node (steps, received).
        u: inputs (steps, inputs).
        plain: estimates in the old units, by node and filter.
        units: the other units, as `_draw_units` returns them.
        one_factor: whether all states have one factor in these.

    Raises:
        AssertionError: an estimate that differs by more than is allowed.
    """
    nodes = {name: _rescale_node(name, node, units[name]) for name, node in _list_nodes(network).items()}
    fused = {name: _rescale_fusion(name, fusion, units[Network.FUSED]) for name, fusion in network.fused.items()}
    scaled = Network(rescale_plant(network.plant, units[Network.FUSED]), nodes, fused)
    scaled_z = {name: rows * units[name].received for name, rows in z.items()}
    estimates = run(scaled, scaled_z, u * units[Network.FUSED].inputs).estimates
    worst = 0.0
    for node, filters in plain.items():
        for name, estimate in filters.items():
            is_searched = _has_search_in_estimate(network, node, name)
            if is_searched and not one_factor:
                continue
            allowed = SEARCHED if is_searched else DIGITS
            difference = _find_difference(estimate, estimates[node][name], units[node].states) / allowed
            # A nominal filter may hold a row for impossible. What it makes of that one and later ones is left to
            # rounding, so that only the rows before are compared.
            if np.any(difference > 1) and estimate.claim == "nominal":
                difference = difference[: _count_possible_rows(network, node, name, z, u)]
            worst = max(worst, _check_differences(f"{node}/{name}", difference))
    return worst


def _count_possible_rows(network: Network, node: str, name: str, z: dict[str, np.ndarray], u: np.ndarray) -> int:
    """Return how many rows come before the first row that a filter of this estimate finds impossible.

    An impossible row has a log-likelihood of -inf: it contradicts what the filter's model holds for certain. This
    happens if a filter that trusts the mean gain receives a noise-free output over two links. After such a row the
    estimate depends on rounding.
    """
    fusion = network.fused[name] if node == Network.FUSED else network.nodes[node].filters[name]
    if isinstance(fusion, AbstractFilter):
        of_all_nodes = [z[single] for single in network.names]
        filters = [(fusion, np.concatenate(of_all_nodes, axis=1) if node == Network.FUSED else z[node])]
    else:
        nodes = network.nodes_with(fusion.filter)
        filters = [(network.nodes[single].filters[fusion.filter], z[single]) for single in nodes]
    is_impossible = [np.isneginf(filter.run(rows, u).log_likelihoods) for filter, rows in filters]
    # The index of the first impossible row. The True after all rows counts if there is none.
    return int(np.argmax(np.append(np.any(is_impossible, axis=0), True)))


def _check_differences(name: str, differences: np.ndarray) -> float:
    """Return the largest of the steps' differences, as a share of what is allowed; raise AssertionError above 1."""
    largest = float(np.max(differences, initial=0.0))
    assert largest <= 1, f"{name}: expected the same estimate in other units, off at step {int(np.argmax(differences))}"
    return largest


def _find_difference(a: Estimate, b: Estimate, s: np.ndarray) -> np.ndarray:
    """Return the largest difference of `a` and of `b`, in units s (n,), at each step (steps,).

    Relative to the scale of each component, its largest mean plus its largest deviation over all steps.
    """
    mean, mean_b = np.asarray(a.mean), np.asarray(b.mean) / s
    covariance, covariance_b = np.asarray(a.covariance), np.asarray(b.covariance) / np.outer(s, s)
    is_claimed = a.claim != "none"
    assert np.all(np.isfinite(mean)), "expected finite means"
    assert not is_claimed or np.all(np.isfinite(covariance)), "expected finite covariances"
    deviation = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)).max(axis=0)) if is_claimed else 0.0
    size = deviation + np.abs(mean).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    # What is not finite in `b` differs by infinitely much.
    difference = np.nan_to_num(np.abs(mean - mean_b) / size, nan=np.inf).max(axis=1)
    if is_claimed:
        of_covariance = np.abs(covariance - covariance_b) / np.outer(size, size)
        difference = np.maximum(difference, np.nan_to_num(of_covariance, nan=np.inf).max(axis=(1, 2)))
    return np.asarray(difference)


def _rescale_node(name: str, node: Node, units: Units) -> Node:
    """Return the node in other units, after checking that its channel's moments change as they must.

    `rescale_channel` changes moments by formula; they must be those of the channel that maps R y to Q z.

    Raises:
        AssertionError: moments that differ, with the node's name.
    """
    channel = first(node.channel)
    # The maps of a channel without memory, one for each set of losses.
    maps = [] if channel.remembers else [outcome.map for outcome in channel.list_outcomes()]
    for affine in maps:
        in_units = Series([known(np.diag(1 / units.outputs)), affine, known(np.diag(units.received))])
        difference = _measure_difference(rescale_channel(second_order(affine), units), second_order(in_units))
        # DIGITS is the largest allowed relative difference.
        assert difference <= DIGITS, f"{name}: expected the channel's moments in other units, off by {difference:.3g}"
    filters = {filter_name: rescale_filter(filter, units) for filter_name, filter in node.filters.items()}
    return Node(rescale_sensor(node.sensor, units), _change_units_of_channel(node.channel, units), filters)


def _change_units_of_channel(channel: Channel, units: Units) -> Channel:
    """Return the channel that maps R y to Q z, where this one maps y to z: the maps R^-1, this channel, Q in series.

    R and Q are the diagonal matrices of the factors of outputs and of measurements in `units`.
    """
    if isinstance(channel, OverTime):
        return over_time([_change_units_of_channel(step, units) for step in unstack(channel)])
    return Series([known(np.diag(1 / units.outputs)), channel, known(np.diag(units.received))])


def _measure_difference(a: SecondOrder, b: SecondOrder) -> float:
    """Return the largest difference of two descriptions' second moments E[M_ia M_jb], relative to their scales.

    The scale of an entry of M = (G, n) is the root of its mean square, and that of a product is the product of both.
    As indices a and b may be exchanged, the moment ijab is compared with scale_ia scale_jb + scale_ib scale_ja.
    """
    moments_of_a, moments_of_b = _find_largest_moments(a), _find_largest_moments(b)
    spread, _, power, _ = moments_of_a
    squares = np.einsum("iiaa->ia", np.abs(spread) + np.abs(power))
    scale = np.sqrt(squares + np.abs(np.concatenate([a.mean_gain, a.offset[:, None]], axis=1)) ** 2)
    size = np.einsum("ia,jb->ijab", scale, scale)
    size = size + size.swapaxes(2, 3)
    size = np.where(size > 0, size, 1.0)
    pairs = zip(moments_of_a, moments_of_b, strict=True)
    return max(float(np.max(np.abs(one - other) / size, initial=0.0)) for one, other in pairs)


def _find_largest_moments(described: SecondOrder) -> list[np.ndarray]:
    """Return the largest values of four second moments of M = (gain, offset), entry ijab, (m, m, p + 1, p + 1) each.

    They are bounds of the covariance of M (`spread`), of the square of its mean's error (`shift`), of E[M_ia M_jb]
    (`power`), and the covariance of the nominal law. Each may be uncertain: anything within `radius` of `center`.
    """
    quadratics = described.spread, described.shift, described.power, described.nominal
    return [np.asarray(quadratic.center + quadratic.radius) for quadratic in quadratics]


def _rescale_fusion(name: str, fusion: Fusion | AbstractFilter, units: Units) -> Fusion | AbstractFilter:
    """Return a central filter in other units; a fusion of estimates stays as it is, since its rule has no units.

    Raises:
        ValueError: a fusion of quantized estimates, whose cells are in units.
    """
    if isinstance(fusion, AbstractFilter):
        return rescale_filter(fusion, units)
    if fusion.quantizer is not None:
        raise fail(f"fusion {name!r} to rescale", "one without quantizers, whose cells are in units", "quantizers")
    return fusion


def _has_search_in_estimate(network: Network, node: str, name: str) -> bool:
    """Return whether an estimate of a network depends on a search that minimises the trace of a covariance.

    The result of such a search depends on units, since a trace adds squares of different ones.

    Args:
        network: the network.
        node: name of a node, or `Network.FUSED` for a fusion of all.
        name: name of the node's filter, or of the fusion.
    """
    if node != Network.FUSED:
        return _has_search(network.nodes[node].filters[name])
    fusion = network.fused[name]
    if isinstance(fusion, AbstractFilter):
        return _has_search(fusion)
    if isinstance(fusion.rule, CovarianceIntersection | InverseCovarianceIntersection | ScalarWeights):
        return True
    return any(_has_search(network.nodes[n].filters[fusion.filter]) for n in network.nodes_with(fusion.filter))


def _has_search(filter: AbstractFilter) -> bool:
    """Return whether a filter minimises a trace by a search, whose result depends on units within its tolerance."""
    match filter:
        case GaussianFilter() | LinearFilter():
            return bool(first(filter.channel).uncertain)
        case PredictionFilter():
            return _has_search(filter.base)
        case SequentialFilter():
            return any(_has_search(node_filter) for node_filter in filter.filters)
    return False
