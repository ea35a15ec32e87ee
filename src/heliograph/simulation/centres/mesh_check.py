"""Checks of a fusion between neighbours when its network is made: whether errors decay; and its claim."""

import warnings

import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.factors.roots import covariance_of_root, observe_information, roots_of
from heliograph.fusion.mesh.graph import Graph, find_upstream_nodes, graph_of
from heliograph.fusion.mesh.joint_error_covariance import scatter_blocks
from heliograph.fusion.mesh.neighbour_rules import DiffusionWeights, FrozenWeights
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import UniformQuantizer
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.estimate import Claim, weakest
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import fail, instance, spread_over_names
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.simulation.centres.centre import claim_of_informed
from heliograph.simulation.centres.neighbour_edges import arrival_chance, build_edges, edge_links, find_loss_decay
from heliograph.simulation.node import HasNodes, Node

MODE = 1e-6  # below 1: a mode is computed to half of the digits where it is a double one
CUTS = 200  # most nodes of which losses are judged: one minimal cut for each
UNIT = 1e5  # whole units of one e-fold of a loss's probability, for integer capacities
RANK = 1e-9  # relative: singular values of a mode's observability below are zero
STEPS, LAST = 100, 40  # of the recursion of errors, and those at its end by which their growth is judged
SLOW = 1e-3  # growth a step that so few steps cannot tell from none


def check_mesh(name: str, fusion: Fusion, network: HasNodes) -> None:
    """Refuse a fusion between neighbours that does not fit its network, by the name of the node that does not.

    Raises:
        ValueError: unknown nodes, nodes with a sensor but without the filter, models that are not linear, relays or
            nodes that share noise, rules or links that do not serve, a node that cannot know an unstable mode.
    """
    what = f"fusion {name!r} between neighbours"
    neighbours = fusion.neighbours or {}
    if unknown := sorted(set(neighbours) - set(network.nodes)):
        raise fail(what, f"nodes of the network {list(network.nodes)[:5]}", f"unknown ones {unknown[:5]}")
    if network.relays is not None or network.common is not None:
        sharing = [node for node in network.mesh_nodes(name) if network.nodes[node].received][:5]
        kind = "relays" if network.relays is not None else f"{sharing}, which share a channel: stack their measurements"
        raise fail(what, "nodes with a sensor and a channel each, whose noises are uncorrelated", kind)
    if not isinstance(first(network.plant), LinearPlant):
        raise fail(what, "a LinearPlant", type(first(network.plant)).__name__)
    # Nodes have the filter or no sensor, and names of their own for the result.
    for node in network.mesh_nodes(name):
        here = network.nodes[node]
        if isinstance(here, Node) and fusion.filter not in here.filters:
            raise fail(f"{what}: node {node!r}", f"the filter {fusion.filter!r}", list(here.filters) or "none")
        if name in here.filters:
            raise fail(f"{what}: node {node!r}", "a name that no filter has", repr(name))
    _check_rule(what, fusion, network)
    graph = graph_of(neighbours, network.mesh_nodes(name))
    _check_messages(what, fusion, network, graph)
    fusion.rule.placed(graph)
    mesh_claim(name, fusion, network)
    _check_detectability(what, name, fusion, network)
    _check_losses(what, fusion, network, graph)
    _check_fixed_shares(what, fusion, network, graph)


def error_claim(name: str, fusion: Fusion, network: HasNodes) -> Claim:
    """Return the claim of the joint covariance of all nodes' errors.

    "exact", weaker where laws or noises are known by bounds.
    """
    parts = {}
    for name_of_node in network.mesh_nodes(name):
        node = network.nodes[name_of_node]
        if isinstance(node, Node):
            parts[name_of_node] = node.sensor, node.channel, node.filters[fusion.filter]
    return claim_of_informed(f"{type(fusion.rule).__name__} between neighbours", network.plant, parts, shared=False)


def mesh_claim(name: str, fusion: Fusion, network: HasNodes) -> Claim:
    """Return the claim of every node's estimate: "upper" by intersection, "exact" by the joint covariance.

    Weaker where laws are known up to a radius, weights are frozen means over losses, or data decide what arrives: a
    sender by what it measured, limits by what they refuse, a quantizer by what it cannot send.
    """
    known = error_claim(name, fusion, network)
    senders = [n for node in network.mesh_nodes(name) if isinstance(n := network.nodes[node], Node)]
    by_data = fusion.quantizer is not None or any(n.chosen_by_value for n in senders)
    if by_data or isinstance(fusion.rule, FrozenWeights):
        return weakest([known, "nominal"])
    return known if fusion.rule.needs_joint else weakest([known, "upper"])


def _check_rule(what: str, fusion: Fusion, network: HasNodes) -> None:
    """Refuse a rule without weights for neighbours, more than it can do, and a start that has no inverse."""
    rule, kind = fusion.rule, type(fusion.rule)
    if not rule.between_neighbours:
        raise fail(what, "a rule such as CovarianceIntersection() or MatrixWeights()", kind.__name__)
    if getattr(rule, "with_mean", False):
        raise fail(f"{what} by {kind.__name__}", "with_mean=False", True)
    if fusion.rounds > 1 and (rule.needs_joint or isinstance(rule, FrozenWeights)):
        raise fail(f"{what} by {kind.__name__}", "one round (more need a rule that intersects)", fusion.rounds)
    # With events no matrix may depend on what is sent.
    if fusion.alpha is not None and (rule.needs_joint or isinstance(rule, FrozenWeights)):
        raise fail(f"{what} by {kind.__name__}", "a rule that intersects, where there are events", fusion.alpha)
    if fusion.alpha is not None and fusion.rounds > 1:
        raise fail(what, "one round, where there are events", f"{fusion.rounds} rounds")
    # Information of a singular start has no number.
    start = np.asarray(first(network.plant).initial_covariance)
    scale = np.sqrt(np.diagonal(start))
    singular = np.any(scale == 0) or np.linalg.eigvalsh(start / np.outer(scale, scale))[0] < RANK
    if singular and not rule.needs_joint and not isinstance(rule, FrozenWeights):
        raise fail(f"{what} by {kind.__name__}", "a regular initial covariance of the plant", "a singular one")


def _check_messages(what: str, fusion: Fusion, network: HasNodes, graph: Graph) -> None:
    """Raise ValueError for links that do not serve, and for delays and quantizers with which no bound is known."""
    past, kind = build_edges(fusion, graph).past, type(fusion.rule).__name__
    if not past and fusion.quantizer is None:
        return
    expected = f"a rule that intersects, where there are {'messages that come late' if past else 'quantizers'}"
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

    Mode lambda is observed where rank [lambda I - A; H of all upstream and itself] = n. Not checked where plant,
    sensors or channels vary over time.
    """
    nodes = network.mesh_nodes(name)
    sensors = [network.nodes[node] for node in nodes]
    observations = [(n.sensor, n.channel) for n in sensors if isinstance(n, Node)]
    varying = [model for pair in observations for model in pair] + [network.plant]
    if any(isinstance(model, OverTime) for model in varying):
        return
    # Matrices that do not vary.
    a = np.asarray(first(network.plant).matrix)
    n = len(a)
    refuse_angles(what, network.plant, *(sensor for sensor, _ in observations))
    # Squares H'H of each node's mean gain, and their sums over those upstream.
    squares = np.zeros((len(nodes), n, n))
    for i, sensor in enumerate(sensors):
        if isinstance(sensor, Node):
            h, noise = _model_node(sensor)
            squares[i] = _scale_rows(h).T @ _scale_rows(h)
            _check_regular(f"{what}: node {nodes[i]!r}", noise)
    # Unstable modes that nobody upstream observes are refused, decaying ones warned of.
    without_unstable, without_decaying = _list_unseeing_nodes(graph_of(fusion.neighbours or {}, nodes), a, squares)
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

    For each set of nodes that do not see the mode lambda, all edges into the set must not be lost too often together:
    |lambda|^2 p < 1, p the product of their loss rates (of losses in bursts the chance of a bad state to stay). The set
    of largest p about a node is the minimal cut between it and those that see the mode, of capacities -log p.
    """
    link, names = fusion.link, graph.nodes
    if link is None or len(names) > CUTS or isinstance(first(network.plant), OverTime):
        return
    rates = [find_loss_decay(channel) for channel in edge_links(link, graph).values()]
    if any(rate is None for rate in rates):
        return
    # Capacities -log p in whole units; those that are never cut get more than all others together.
    exact = np.array([-np.log(max(float(rate or 0.0), 1e-300)) for rate in rates])
    units = np.minimum(np.round(UNIT * exact), 1e8).astype(np.int32)
    # Of each unstable mode the least cut between the nodes that observe it and each other node.
    values, vectors = np.linalg.eig(np.asarray(first(network.plant).matrix))
    for value, vector in zip(values, vectors.T, strict=True):
        if abs(value) <= 1 + MODE:
            continue
        sees = np.array([_sees(network.nodes[name], vector) for name in names])
        source = len(names)
        rows = np.concatenate([graph.edges[:, 0], np.full(sees.sum(), source)])
        columns = np.concatenate([graph.edges[:, 1], np.flatnonzero(sees)])
        data = np.concatenate([units, np.full(sees.sum(), 2**30, dtype=np.int32)]).astype(np.int32)
        flow = scipy.sparse.csr_array((data, (rows, columns)), shape=(source + 1, source + 1))
        for i in np.flatnonzero(~sees):
            cut = scipy.sparse.csgraph.maximum_flow(flow, source, int(i)).flow_value / UNIT
            if cut <= 2 * np.log(abs(value)) * (1 - MODE):
                raise fail(what, f"losses below {1 / abs(value) ** 2:.3g} in all of what node {names[i]!r} learns of a "
                           f"mode of {abs(value):.3g}", f"{np.exp(-cut):.3g}")  # fmt: skip


def _sees(node: object, vector: np.ndarray) -> bool:
    """Test whether a node's own measurement shows a mode."""
    if not isinstance(node, Node):
        return False
    return bool(np.any(np.abs(_scale_rows(_model_node(node)[0]) @ vector) > RANK))


def _list_unseeing_nodes(graph: Graph, a: np.ndarray, squares: np.ndarray) -> tuple[list[str], list[str]]:
    """Return the nodes for which nobody upstream observes some unstable mode of A, and those for some decaying mode.

    Nodes of one strongly connected part share the array `places`, so that each part is checked once.
    """
    without_unstable, without_decaying = [], []
    values = np.linalg.eigvals(a)
    checked: dict[int, tuple[bool, bool]] = {}
    for node, places in zip(graph.nodes, find_upstream_nodes(graph), strict=True):
        if id(places) not in checked:
            checked[id(places)] = _find_unseen(a, values, squares[places].sum(axis=0))
        unstable, decaying = checked[id(places)]
        if unstable:
            without_unstable.append(node)
        if decaying:
            without_decaying.append(node)
    return without_unstable, without_decaying


def _find_unseen(a: np.ndarray, values: np.ndarray, square: np.ndarray) -> tuple[bool, bool]:
    """Return whether outputs H, `square` H'H, hide a mode that does not decay, and whether they hide one that does.

    `values`: eigenvalues of a.
    """
    size = np.linalg.norm(a, 2) or 1.0
    hides_unstable = hides_decaying = False
    for value in values:
        pencil = np.concatenate([(value * np.eye(len(a)) - a) / size, square])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < RANK:
            unstable = abs(value) >= 1 - MODE
            hides_unstable, hides_decaying = hides_unstable or unstable, hides_decaying or not unstable
    return hides_unstable, hides_decaying


def _scale_rows(h: np.ndarray) -> np.ndarray:
    """Return the rows scaled to unit length, so that the unit of a measurement does not matter."""
    lengths = np.linalg.norm(h, axis=1, keepdims=True)
    return np.asarray(h / np.where(lengths > 0, lengths, 1.0))


def _model_node(node: Node) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean matrix from the state to what a node receives, and the covariance of its noise at zero signal."""
    sensor, channel = first(node.sensor), second_order(first(node.channel).condition_on_arrival())
    assert isinstance(sensor, LinearSensor)  # as its filter's claim requires
    gain = np.asarray(channel.mean_gain)
    noise = gain @ np.asarray(sensor.noise.covariance) @ gain.T + np.asarray(channel.nominal.center)[:, :, -1, -1]
    return gain @ np.asarray(sensor.matrix), noise


def _check_regular(where: str, noise: np.ndarray) -> None:
    """Refuse a measurement without noise in some direction: its information has no number."""
    scale = np.sqrt(np.maximum(np.diagonal(noise), 0.0))
    if np.any(scale == 0) or np.linalg.eigvalsh(noise / np.outer(scale, scale))[0] < RANK:
        raise fail(where, "measurement noise in every direction", "a singular covariance")


def _check_fixed_shares(what: str, fusion: Fusion, network: HasNodes, graph: Graph) -> None:
    """Raise ValueError for fixed shares with which errors grow, where the plant does not decay and gains settle."""
    plant, link, names = network.plant, fusion.link, graph.nodes
    if not isinstance(fusion.rule, DiffusionWeights) or not isinstance(plant, LinearPlant) or len(names) > CUTS:
        return
    a, q = np.asarray(plant.matrix), np.asarray(plant.noise_covariance(jnp.zeros(len(plant.inputs))))
    nodes = [network.nodes[name] for name in names]
    rates = [1.0] * len(graph.edges) if link is None else [arrival_chance(c) for c in edge_links(link, graph).values()]
    arrival = np.array([p for p in rates if p is not None])
    steady = all(_is_steady(node) for node in nodes if isinstance(node, Node))
    if np.abs(np.linalg.eigvals(a)).max() < 1 - MODE or len(arrival) < len(rates) or not steady:
        return
    # Of a node without a sensor a row of zeros.
    models = [_model_node(node) if isinstance(node, Node) else (np.zeros((1, len(a))), np.eye(1)) for node in nodes]
    squares = np.array([h.T @ np.linalg.solve(noise, h) for h, noise in models])
    check_decay(what, graph, np.asarray(fusion.rule.placed(graph).shares).T, arrival, (a, q), squares)


def _is_steady(node: Node) -> bool:
    """Test whether a node's measurement is the same at every step, and no signal adds to its noise."""
    if isinstance(node.sensor, OverTime) or isinstance(node.channel, OverTime):
        return False
    return not np.any(np.asarray(second_order(node.channel.condition_on_arrival()).nominal.center)[:, :, :-1, :-1])


def check_decay(
    what: str, graph: Graph, shares: np.ndarray, arrival: np.ndarray, plant: tuple[np.ndarray, np.ndarray],
    squares: np.ndarray,
) -> None:  # fmt: skip
    """Refuse fixed shares (node, degree) with which the errors of a node grow.

    Args:
        what: name of the fusion.
        graph: whom each node receives.
        shares: c_ij, zero for the node itself.
        arrival: probability of every edge's message (edge,), receiver after receiver.
        plant: A and Q.
        squares: H_j' R_j^-1 H_j (node, n, n).

    Raises:
        ValueError: errors that grow, by the name of the node where they are largest.
    """
    arrives = np.zeros(graph.present.shape)
    arrives[:, 1:][graph.present[:, 1:]] = arrival
    growth, sizes = _compute_growth(graph, arrives, *_make_error_steps(graph, shares, plant, squares))
    if growth > 1 + SLOW:
        raise fail(what, "shares with which errors decay, whatever is lost (or a rule that intersects)",
                   f"squares that grow by {growth:.3g} a step at node {graph.nodes[sizes.argmax()]!r}")  # fmt: skip


def _make_error_steps(
    graph: Graph, shares: np.ndarray, plant: tuple[np.ndarray, np.ndarray], squares: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the matrices of one step of the errors e_i, with the gains of the long run.

    e_i+ = alone_i e_i + sum_j (pulled_ij e_j + pushed_ij e_i), over the senders j whose messages arrive.

    Returns: alone (node, n, n), pulled and pushed (node, degree, n, n).
    """
    a, q = plant
    n = len(a)
    # Gains of a filter that receives all its neighbours' measurements, in the long run.
    total = np.where(graph.present[:, :, None, None], squares[graph.senders], 0.0).sum(axis=1)
    root = np.tile(np.eye(n), (len(squares), 1, 1))
    process = np.broadcast_to(roots_of(q), root.shape)
    for _ in range(STEPS):
        root = observe_information(np.concatenate([a @ root, process], axis=-1), total).root
    p = covariance_of_root(root)
    # c_ij F_i A e_j, and -c_ij F_i A e_i - P_i S_j A e_i.
    pulled = shares[:, :, None, None] * ((np.eye(n) - p @ total) @ a)[:, None]
    return a - p @ squares @ a, pulled, -pulled - p[:, None] @ squares[graph.senders] @ a


def _compute_growth(
    graph: Graph, arrives: np.ndarray, alone: np.ndarray, pulled: np.ndarray, pushed: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the growth of the errors' second moments in a step, and their sizes by node in the end.

    Args: `arrives` (node, degree): probability of each message; the others as `_make_error_steps` returns them.
    """
    nodes, n = alone.shape[:2]
    # Mean over what gets lost, and its variance.
    mean = arrives[:, :, None, None] * pulled
    mean[:, 0] = alone + (arrives[:, :, None, None] * pushed)[:, 1:].sum(axis=1)
    m = scatter_blocks(mean, graph.senders, graph.present)
    variance = (arrives * (1 - arrives))[:, :, None, None]
    # Second moments without noise, in units of their size before a step.
    # J+ = E[M] J E[M]', and on the diagonal sum_j p_j (1 - p_j) D_j E[(e_i, e_j)(e_i, e_j)'] D_j',
    # D_j = (pushed, pulled).
    joint, logarithms, places, senders = np.eye(nodes * n), [], np.arange(nodes), graph.senders
    added_by_message = np.concatenate([pushed, pulled], axis=3)
    for _ in range(STEPS):
        blocks = joint.reshape(nodes, n, nodes, n)
        cross = blocks[places[:, None], :, senders, :]
        top = np.concatenate([np.broadcast_to(blocks[places, :, places, :][:, None], cross.shape), cross], axis=3)
        below = np.concatenate([cross.swapaxes(2, 3), blocks[senders, :, senders, :]], axis=3)
        more = propagate_by_mode(added_by_message, np.concatenate([top, below], axis=2), 0.0)
        joint = np.asarray(propagate_by_mode(m, joint, 0.0))
        joint.reshape(nodes, n, nodes, n)[places, :, places, :] += (variance * more).sum(axis=1)
        # Their size, of which the next step is a multiple.
        logarithms.append(np.log(np.trace(joint)))
        joint /= np.trace(joint)
    return float(np.exp(np.mean(logarithms[-LAST:]))), np.einsum("iaia->i", joint.reshape(nodes, n, nodes, n))
