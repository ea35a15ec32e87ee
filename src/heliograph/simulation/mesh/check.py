"""Checks of a fusion between neighbours when its network is made: whether errors decay; and its claim.

The plant is x+ = A x + w, Cov w = Q; node j measures z_j = H_j x + v_j, Cov v_j = R_j. A mode is an eigenvector of A,
unstable where it does not decay. A node is upstream of another if its messages reach that, through others too.
"""

import warnings

import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.fusion.mesh.graph import Graph, find_upstream_nodes, graph_of
from heliograph.fusion.mesh.neighbour_rules import DiffusionWeights, FrozenWeights
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import UniformQuantizer
from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import fail, instance, spread_over_names
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.simulation.centres.fusion_centre import find_claim_of_informed_fusion
from heliograph.simulation.mesh.fixed_share_stability import check_error_decay
from heliograph.simulation.mesh.neighbour_edges import (
    build_edges,
    find_arrival_probability,
    find_loss_decay,
    links_by_edge,
)
from heliograph.simulation.node import HasNodes, Node

MODE = 1e-6  # a mode of 1 - MODE counts as one that does not decay: double ones are computed to half of the digits
CUTS = 200  # most nodes of which losses are judged: one minimal cut for each
UNIT = 1e5  # whole units of one e-fold of a loss's probability, for integer capacities
WIDEST = 1e8  # largest capacity of an edge of the graph, in these units
UNCUT = 2**30  # capacity of an edge that no least cut takes
RANK = 1e-9  # relative: singular values of a mode's observability below are zero


def check_mesh(name: str, fusion: Fusion, network: HasNodes) -> None:
    """Raise ValueError for a fusion between neighbours that does not fit its network, naming the node that does not.

    In such a fusion nodes exchange estimates among themselves, without a centre. It is checked before a run, since a
    fusion that does not fit would give wrong covariances or growing errors, without an error message.

    Args:
        name: name of the fusion.
        fusion: the fusion: each node's neighbours, the local filter whose estimates are exchanged, the rule of
            combination (shares or covariances), the links between nodes.
        network: the network with its plant, nodes and filters.

    Raises:
        ValueError: unknown nodes, nodes with a sensor but without the filter, models that are not linear, relays or
            nodes that share noise, rules or links that do not serve, a node that cannot know an unstable mode.
    """
    what = f"fusion {name!r} between neighbours"
    neighbours = fusion.neighbours or {}
    if unknown := sorted(set(neighbours) - set(network.nodes)):
        raise fail(what, f"nodes of the network {list(network.nodes)[:5]}", f"unknown ones {unknown[:5]}")
    # Rules combine nodes whose measurement noises are uncorrelated. Relays and shared channels correlate them.
    if network.relays is not None or network.common is not None:
        sharing = [node for node in network.mesh_nodes(name) if network.nodes[node].received][:5]
        got = "relays" if network.relays is not None else f"{sharing}, which share a channel: stack their measurements"
        raise fail(what, "nodes with a sensor and a channel each, whose noises are uncorrelated", got)
    # The covariances of the rules are those of linear dynamics.
    if not isinstance(first(network.plant), LinearPlant):
        raise fail(what, "a LinearPlant", type(first(network.plant)).__name__)
    # A node with a sensor (`Node`) must have the local filter. The fusion's result is stored under its name beside the
    # node's filters, so no filter may have that name.
    for node_name in network.mesh_nodes(name):
        node = network.nodes[node_name]
        if isinstance(node, Node) and fusion.filter not in node.filters:
            raise fail(f"{what}: node {node_name!r}", f"the filter {fusion.filter!r}", list(node.filters) or "none")
        if name in node.filters:
            raise fail(f"{what}: node {node_name!r}", "a name that no filter has", repr(name))
    # The rule and the messages between nodes.
    _check_rule(what, fusion, network)
    graph = graph_of(neighbours, network.mesh_nodes(name))
    _check_messages(what, fusion, network, graph)
    fusion.rule.placed(graph)  # raises for shares or blocks that do not fit the graph
    find_claim_of_mesh(name, fusion, network)  # raises for filters that the rule refuses
    # Whether errors stay bounded: each node sees, or hears of, all unstable modes; messages are not lost too often; and
    # fixed shares do not amplify errors.
    _check_detectability(what, name, fusion, network)
    _check_losses(what, fusion, network, graph)
    _check_fixed_shares(what, fusion, network, graph)


def find_claim_of_errors(name: str, fusion: Fusion, network: HasNodes) -> Claim:
    """Return the claim of the joint covariance of all nodes' errors.

    It is "exact", or weaker if laws or noises are only bounds. `name`: the name of `fusion`, a fusion between
    neighbours, in the network.
    """
    parts_by_node = {}
    for name_of_node in network.mesh_nodes(name):
        node = network.nodes[name_of_node]
        if isinstance(node, Node):
            parts_by_node[name_of_node] = node.sensor, node.channel, node.filters[fusion.filter]
    rule = f"{type(fusion.rule).__name__} between neighbours"
    return find_claim_of_informed_fusion(rule, network.plant, parts_by_node, shared=False)


def find_claim_of_mesh(name: str, fusion: Fusion, network: HasNodes) -> Claim:
    """Return what is claimed of every node's covariance: "exact", an "upper" bound, or "nominal" (neither).

    A rule that weighs by the joint covariance of all errors gives that covariance, an intersection a bound. The claim
    is weaker if laws are known only up to a radius. It is "nominal" if the joint covariance is a mean over losses that
    is not updated (`FrozenWeights`), and if data decide what arrives: if a sender chooses by what it measured, limits
    refuse values, or a quantizer saturates; and if codewords are sent, whose rounding no weight
    knows. `name`: the name of `fusion`, between neighbours, in the network.
    """
    claim_of_errors = find_claim_of_errors(name, fusion, network)
    nodes = [network.nodes[node] for node in network.mesh_nodes(name)]
    is_disturbed = any(node.disturbs_what_is_sent for node in nodes if isinstance(node, Node))
    if is_disturbed or fusion.quantizer is not None or isinstance(fusion.rule, FrozenWeights):
        return weakest([claim_of_errors, "nominal"])
    if fusion.rule.needs_joint:  # it weighs by the joint covariance
        return claim_of_errors
    return weakest([claim_of_errors, "upper"])  # an intersection


def _check_rule(what: str, fusion: Fusion, network: HasNodes) -> None:
    """Raise ValueError for a rule without weights for neighbours, for more than it can do, and for a singular start.

    `what`: the fusion, for errors.
    """
    rule, kind = fusion.rule, type(fusion.rule)
    intersects = not rule.needs_joint and not isinstance(rule, FrozenWeights)
    if not rule.between_neighbours:
        raise fail(what, "a rule such as CovarianceIntersection() or MatrixWeights()", kind.__name__)
    if getattr(rule, "with_mean", False):
        raise fail(f"{what} by {kind.__name__}", "with_mean=False", True)
    if fusion.rounds > 1 and not intersects:
        raise fail(f"{what} by {kind.__name__}", "one round (more need a rule that intersects)", fusion.rounds)
    # Where a node sends only what has changed (an event), data decide what arrives: a joint covariance would be wrong.
    if fusion.alpha is not None and not intersects:
        raise fail(f"{what} by {kind.__name__}", "a rule that intersects, where there are events", fusion.alpha)
    if fusion.alpha is not None and fusion.rounds > 1:
        raise fail(what, "one round, where there are events", f"{fusion.rounds} rounds")
    # Rules that intersect weigh by inverses, which a singular initial covariance has not.
    start = np.asarray(first(network.plant).initial_covariance)
    scale = np.sqrt(np.diagonal(start))
    singular = np.any(scale == 0) or np.linalg.eigvalsh(start / np.outer(scale, scale))[0] < RANK
    if singular and intersects:
        raise fail(f"{what} by {kind.__name__}", "a regular initial covariance of the plant", "a singular one")


def _check_messages(what: str, fusion: Fusion, network: HasNodes, graph: Graph) -> None:
    """Raise ValueError for links, delays and quantizers with which the covariances of the nodes would not hold.

    Nodes of this fusion send their estimates to neighbours. A late or quantized estimate has an error of its own.
    Covariance intersection needs only a bound on that error, but rules that use the joint covariance of all errors
    would have to follow it, which they do not. Several rounds of exchange in a step, and sending on events, are
    implemented for present estimates that arrive unchanged. A quantizer's error must have a bound that no loss can
    break. `build_edges` refuses links that it cannot draw.

    `what`: the fusion, for errors. `graph`: which nodes send to which.
    """
    longest_delay, kind = build_edges(fusion, graph).past, type(fusion.rule).__name__
    if not longest_delay and fusion.quantizer is None:
        return
    cause = "messages that come late" if longest_delay else "quantizers"
    expected = f"a rule that intersects, where there are {cause}"
    if fusion.rule.needs_joint or isinstance(fusion.rule, FrozenWeights):
        raise fail(f"{what} by {kind}", expected, kind)
    if fusion.rounds > 1 or fusion.alpha is not None:
        expected = "one round without events, where messages come late or quantized"
        raise fail(what, expected, "events" if fusion.rounds == 1 else f"{fusion.rounds} rounds")
    if fusion.quantizer is not None:
        fusion.check(graph.nodes, len(network.states))
        for lossy in spread_over_names("quantizers", fusion.quantizer, graph.nodes):
            instance("quantizer between neighbours", lossy, UniformQuantizer, "one with a bound on its error whatever "
                     "was sent and lost before (UniformQuantizer)")  # fmt: skip


def _check_detectability(what: str, name: str, fusion: Fusion, network: HasNodes) -> None:
    """Raise ValueError if neither a node nor one upstream of it observes an unstable mode; warn of decaying modes.

    A mode is an eigenvalue lambda of the plant's A (n, n). Nodes upstream of a node are those whose messages reach it,
    also through others. The node observes the mode by its own H and theirs if rank [lambda I - A; all these H] = n (the
    test of Hautus); an unstable mode that it does not observe makes its error grow without bound. Nothing is checked
    where plant, sensors or channels vary over time. `what` names the fusion `name` in errors.
    """
    # Only models that do not vary over time.
    names = network.mesh_nodes(name)
    nodes = [network.nodes[node] for node in names]
    observations = [(node.sensor, node.channel) for node in nodes if isinstance(node, Node)]
    models = [model for pair in observations for model in pair] + [network.plant]
    if any(isinstance(model, OverTime) for model in models):
        return
    a = np.asarray(first(network.plant).matrix)
    n = len(a)
    refuse_angles(what, network.plant, *(sensor for sensor, _ in observations))
    # H'H of each node (node, n, n), H its mean gain with rows of unit length.
    squares = np.zeros((len(names), n, n))
    for i, node in enumerate(nodes):
        if isinstance(node, Node):
            h, noise = _get_gain_and_noise(node)
            squares[i] = _scale_rows(h).T @ _scale_rows(h)
            _check_noise_is_regular(f"{what}: node {names[i]!r}", noise)
    # Unstable modes that nobody upstream observes are refused, decaying ones warned of.
    without_unstable, without_decaying = _list_unseeing_nodes(graph_of(fusion.neighbours or {}, names), a, squares)
    if without_unstable:
        some = ", ".join(map(repr, without_unstable[:5])) + (" and more" if len(without_unstable) > 5 else "")
        raise fail(
            what, "that a node or one upstream of it observes every mode that does not decay", f"none for {some}"
        )
    if without_decaying:
        warnings.warn(f"{what}: a decaying mode is observed by nobody upstream of {without_decaying[:5]}; their errors "
                      "are those of its prior", stacklevel=4)  # fmt: skip


def _check_losses(what: str, fusion: Fusion, network: HasNodes, graph: Graph) -> None:
    """Raise ValueError if a node's error grows whatever the rule, since messages about a mode are lost too often.

    A mode of the plant is an eigenvector of its matrix, with the eigenvalue lambda; it grows where |lambda| > 1. For
    each set of nodes whose sensors do not see the mode, all edges (links between neighbours) into the set must not be
    lost too often together: |lambda|^2 p < 1, p the product of their loss rates (of losses in bursts the chance of a
    bad state to stay). The set of largest p about a node is the minimal cut between it and the nodes that see the mode,
    with the capacity -log of its loss rate for each edge. Not checked for more than CUTS nodes, where the plant varies,
    or where a loss rate is unknown. `what` names the fusion in errors.
    """
    link, names = fusion.link, graph.nodes
    if link is None or len(names) > CUTS or isinstance(first(network.plant), OverTime):
        return
    rates = [find_loss_decay(channel) for channel in links_by_edge(link, graph).values()]
    if any(rate is None for rate in rates):
        return
    # Capacities -log p (1e-300 in place of p = 0) in whole units of 1 / UNIT, as the search for a flow needs them. An
    # edge that loses nothing has the capacity WIDEST, as good as infinite.
    exact = np.array([-np.log(max(float(rate or 0.0), 1e-300)) for rate in rates])
    capacities = np.minimum(np.round(UNIT * exact), WIDEST).astype(np.int32)
    # For each unstable mode: the least cut between the nodes that observe it and each other node.
    values, vectors = np.linalg.eig(np.asarray(first(network.plant).matrix))
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value) <= 1 + MODE:
            continue
        sees = np.array([_measures_mode(network.nodes[name], vector) for name in names])
        # The graph with one node more, the source, and from it an edge to each node that measures the mode. No least
        # cut takes these edges, whose capacity UNCUT is above all others.
        source = len(names)
        senders = np.concatenate([graph.edges[:, 0], np.full(sees.sum(), source)])
        receivers = np.concatenate([graph.edges[:, 1], np.flatnonzero(sees)])
        widths = np.concatenate([capacities, np.full(sees.sum(), UNCUT, dtype=np.int32)]).astype(np.int32)
        edges = scipy.sparse.csr_array((widths, (senders, receivers)), shape=(source + 1, source + 1))
        for i in np.flatnonzero(~sees):
            # The least cut, which is the largest flow. |lambda|^2 p < 1 where -log p is above 2 log |lambda|.
            cut = scipy.sparse.csgraph.maximum_flow(edges, source, int(i)).flow_value / UNIT
            if cut <= 2 * np.log(abs(value)) * (1 - MODE):
                raise fail(what, f"losses below {1 / abs(value) ** 2:.3g} in all of what node {names[i]!r} learns of a "
                           f"mode of {abs(value):.3g}", f"{np.exp(-cut):.3g}")  # fmt: skip


def _measures_mode(node: object, vector: np.ndarray) -> bool:
    """Return whether a node's measurement shows the plant's mode of this eigenvector v: whether |H v| exceeds RANK."""
    if not isinstance(node, Node):
        return False
    gain, _ = _get_gain_and_noise(node)
    return bool(np.any(np.abs(_scale_rows(gain) @ vector) > RANK))


def _list_unseeing_nodes(graph: Graph, a: np.ndarray, squares: np.ndarray) -> tuple[list[str], list[str]]:
    """Return the nodes that do not see some unstable mode of A, and those that do not see some decaying mode.

    A node sees a mode if it, or a node whose messages can reach it (all called upstream), observes the mode.
    `squares`: H'H of each node (node, n, n). Nodes that reach each other share one array `upstream`, which is checked
    once.
    """
    without_unstable, without_decaying = [], []
    values = np.linalg.eigvals(a)
    hidden_modes: dict[int, tuple[bool, bool]] = {}
    for node, upstream in zip(graph.nodes, find_upstream_nodes(graph), strict=True):
        if id(upstream) not in hidden_modes:
            hidden_modes[id(upstream)] = _hides_modes(a, values, squares[upstream].sum(axis=0))
        unstable, decaying = hidden_modes[id(upstream)]
        if unstable:
            without_unstable.append(node)
        if decaying:
            without_decaying.append(node)
    return without_unstable, without_decaying


def _hides_modes(a: np.ndarray, values: np.ndarray, square: np.ndarray) -> tuple[bool, bool]:
    """Return whether outputs hide a mode of A that does not decay, and whether they hide one that decays.

    `values`: eigenvalues of A. A mode with |value| >= 1 - MODE does not decay. `square`: the sum of H'H over the
    outputs; it hides a mode that all of them hide. RANK: a singular value below it counts as 0.
    """
    size = np.linalg.norm(a, 2) or 1.0
    hides_unstable = hides_decaying = False
    for value in values:
        # Test of Hautus: outputs hide the mode if this matrix loses rank, so that its smallest singular value is 0.
        pencil = np.concatenate([(value * np.eye(len(a)) - a) / size, square])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < RANK:
            is_unstable = abs(value) >= 1 - MODE
            hides_unstable = hides_unstable or is_unstable
            hides_decaying = hides_decaying or not is_unstable
    return hides_unstable, hides_decaying


def _scale_rows(h: np.ndarray) -> np.ndarray:
    """Return the rows scaled to unit length, so that the unit of a measurement does not matter."""
    lengths = np.linalg.norm(h, axis=1, keepdims=True)
    return np.asarray(h / np.where(lengths > 0, lengths, 1.0))


def _get_gain_and_noise(node: Node) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean matrix H from the state to what a node receives, and the noise covariance R at a signal of 0.

    The node receives z = G (C x + v) + n with a random gain G: H = E[G] C and R = E[G] Cov(v) E[G]' + Cov(n). The noise
    that a random gain makes in proportion to the signal is left out.
    """
    sensor, channel = first(node.sensor), second_order(first(node.channel).condition_on_arrival())
    assert isinstance(sensor, LinearSensor)  # as its filter's claim requires
    # `center` is the covariance of (gains, offset). At a signal of 0 only the offset's entry, the last, makes noise.
    gain = np.asarray(channel.mean_gain)
    noise = gain @ np.asarray(sensor.noise.covariance) @ gain.T + np.asarray(channel.nominal.center)[:, :, -1, -1]
    return gain @ np.asarray(sensor.matrix), noise


def _check_noise_is_regular(where: str, noise: np.ndarray) -> None:
    """Raise ValueError for a measurement without noise in some direction, whose information would be infinite.

    `where`: the node's name in the error. `noise`: the covariance R. Its correlation matrix must have no eigenvalue
    below RANK.
    """
    deviation = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    has_zero = np.any(deviation == 0)
    if has_zero or np.linalg.eigvalsh(noise / np.outer(deviation, deviation))[0] < RANK:
        raise fail(where, "measurement noise in every direction", "a singular covariance")


def _check_fixed_shares(what: str, fusion: Fusion, network: HasNodes, graph: Graph) -> None:
    """Raise ValueError for fixed shares with which errors grow, where the plant does not decay and gains settle.

    `what`: the fusion, for errors. Not checked for more than CUTS nodes.
    """
    plant, link, names = network.plant, fusion.link, graph.nodes
    if not isinstance(fusion.rule, DiffusionWeights) or not isinstance(plant, LinearPlant) or len(names) > CUTS:
        return
    a, q = np.asarray(plant.matrix), np.asarray(plant.noise_covariance(jnp.zeros(len(plant.inputs))))
    nodes = [network.nodes[name] for name in names]
    # Judged where the plant does not decay, each edge's losses are independent over steps (so that a message has one
    # probability to arrive, which is None else), and nodes measure by one law at every step.
    links = [None] * len(graph.edges) if link is None else list(links_by_edge(link, graph).values())
    probabilities = [find_arrival_probability(channel) for channel in links]
    arrival = np.array([p for p in probabilities if p is not None])
    are_independent = len(arrival) == len(probabilities)
    is_decaying = np.abs(np.linalg.eigvals(a)).max() < 1 - MODE
    are_steady = all(_measures_alike_at_each_step(node) for node in nodes if isinstance(node, Node))
    if is_decaying or not are_independent or not are_steady:
        return
    # H' R^-1 H of each node. One without a sensor measures zeros, with a noise that does not matter.
    nothing = np.zeros((1, len(a))), np.eye(1)
    models = [_get_gain_and_noise(node) if isinstance(node, Node) else nothing for node in nodes]
    squares = np.array([h.T @ np.linalg.solve(r, h) for h, r in models])
    shares = np.asarray(fusion.rule.placed(graph).shares).T
    check_error_decay(what, graph, shares, arrival, (a, q), squares)


def _measures_alike_at_each_step(node: Node) -> bool:
    """Return whether a node's measurement has one law at every step, with noise that does not grow with the signal.

    Noise grows with the signal if the gains G of the channel z = G y + n are random, Cov(G_ij, G_kl) != 0.
    """
    if isinstance(node.sensor, OverTime) or isinstance(node.channel, OverTime):
        return False
    moments = second_order(node.channel.condition_on_arrival())
    # `center` [i, k, j, l] is the covariance of the entries (i, j) and (k, l) of [G, n]; the last column is n.
    gain_covariance = np.asarray(moments.nominal.center)[:, :, :-1, :-1]
    return not np.any(gain_covariance)
