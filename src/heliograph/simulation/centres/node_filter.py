"""One node of a fusion between neighbours as a filter: its measurements are its sensor's and its neighbours' messages.

What a node needs of the others is in their messages, so that each can run in another process.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.innovation import gaussian_innovation, no_innovation
from heliograph.fusion.mesh.graph import Graph, graph_of
from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.premises.premise import on_premise
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.float64 import compile_in_float64, in_float64
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import Array, ArrayLike
from heliograph.simulation.centres.mesh import Mesh, MeshRows, MeshState
from heliograph.simulation.centres.neighbour_edges import MeshEdges
from heliograph.simulation.centres.neighbour_messages import MessagesOnTheWay, quantize_estimate
from heliograph.simulation.centres.observation_model import Apart, stack_nodes
from heliograph.simulation.claims import find_premise
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node, ReceivingNode

# Compiled as one program, since a service calls it for each message.
_quantize_message = compile_in_float64(quantize_estimate)


class NodeState(NamedTuple):
    """State of a node: `before` the last step, as its message of that step says it, the step's inputs, and `now`."""

    before: MeshState
    inputs: Array
    now: MeshState


class NodeFilter(AbstractSizedFilter):
    """Filter of one node of a fusion between neighbours; of the mesh it has one row and the neighbours' sensors.

    The measurement is z of the node itself, then for each neighbour j the mean (n,) and covariance (n, n) of its
    estimate before the step and its z_j: NaN where the message did not come. Claim: as the fusion's, whatever comes.

    Args:
        mesh: the fusion, with the node's row of the graph.
        measured: numbers of each sensor, the node's first.
        receivers: names of the nodes that receive this one's messages.
        quantizer: of its messages; None of messages that are not quantized.
    """

    mesh: Mesh
    measured: tuple[int, ...] = eqx.field(static=True)
    receivers: tuple[str, ...] = eqx.field(static=True)
    quantizer: AbstractQuantizer | None

    @in_float64
    def init(self) -> NodeState:
        """Return the plant's initial law."""
        start = self.mesh.init()
        n, count = start.mean.shape[1], len(self.measured)
        alone = start._replace(way=MessagesOnTheWay(jnp.zeros((0, count, n)), jnp.zeros((0, count, n, n))))
        return NodeState(alone, jnp.zeros(len(self.inputs)), alone)

    @predicts
    def predict(self, state: NodeState, u: ArrayLike = (), k: Step = 0) -> NodeState:
        """Predict from the node's estimate alone, as if no message came."""
        return self._make_state(state.now, jnp.full(self.received, jnp.nan), jnp.asarray(u), k)

    @corrects
    def correct(self, state: NodeState, z: ArrayLike, k: Step = 0) -> tuple[NodeState, Innovation]:
        """Fuse, predict and correct with what came; innovations of the measurements about the node's prediction."""
        mean, covariance = state.now.mean[0], state.now.covariance[0]
        observation = self.mesh.observation_model.observe(*state.now.plant, jnp.asarray(k))
        sensed, _ = self._gather_measurements(jnp.asarray(z), state.before)
        sensors = [(i, size) for i, size in enumerate(self.measured) if size]
        if not sensors:
            return self._make_state(state.before, jnp.asarray(z), state.inputs, k), no_innovation()
        gain, offset = (jnp.concatenate([stacked[i, :size] for i, size in sensors])
                        for stacked in (observation.gain, observation.offset))  # fmt: skip
        noise = block_diag(*(observation.noise[i, :size, :size] for i, size in sensors))
        total = gain @ covariance @ gain.T + noise
        innovation = gaussian_innovation(jnp.concatenate(sensed), gain @ mean + offset, total)
        return self._make_state(state.before, jnp.asarray(z), state.inputs, k), innovation

    @estimates
    def estimate(self, state: NodeState) -> Estimate:
        """Return the mean and covariance of the node."""
        return Estimate(jnp.asarray(state.now.mean)[0], jnp.asarray(state.now.covariance)[0], self.claim)

    @in_float64
    def sent(self, before: MeshState) -> tuple[jax.Array, jax.Array]:
        """Return the mean (n,) and covariance (n, n) that a message about the estimate before a step holds."""
        message = before.mean[0], before.covariance[0]
        return message if self.quantizer is None else _quantize_message(self.quantizer, *message)

    def _gather_measurements(self, z: jax.Array, before: MeshState) -> tuple[list[jax.Array], MeshState]:
        """Take z apart: return the measurements of node and neighbours, and their estimates.

        Where no message came, the mean is NaN, and the covariance any regular one: the node's own.
        """
        n, end = len(self.states), self.measured[0]
        sensed, means, covariances = [z[:end]], [before.mean[0]], [before.covariance[0]]
        # Of each neighbour mean (n), covariance (n n) and measurement (size).
        for size in self.measured[1:]:
            mean, covariance, measured = jnp.split(z[end : end + n + n * n + size], [n, n + n * n])
            end += n + n * n + size
            sensed.append(measured)
            arrives = ~jnp.any(jnp.isnan(covariance))
            means.append(jnp.where(arrives, mean, jnp.nan))
            covariances.append(jnp.where(arrives, symmetrize(covariance.reshape(n, n)), covariances[0]))
        return sensed, before._replace(mean=jnp.stack(means), covariance=jnp.stack(covariances))

    def _make_state(self, before: MeshState, z: jax.Array, u: Array, k: Step) -> NodeState:
        """Return the state after a step with measurement z: the state before, the inputs, and the new estimate."""
        sensed, all_nodes = self._gather_measurements(z, before)
        everything = jnp.ones((1, 1, len(sensed)), dtype=bool)
        now, _ = self.mesh.step(all_nodes, [x[None] for x in sensed], everything, jnp.asarray(u), jnp.asarray(k))
        return NodeState(before, u, now)


def node_filter(network: Network, fusion: str, node: str) -> NodeFilter:
    """Return the filter of a node of the fusion `fusion` between neighbours of `network`, on what its neighbours send.

    Raises:
        ValueError: a rule that needs the joint covariance of all nodes' errors, more than one round, events, a plant
            whose steps are of any length.
    """
    between, nodes = network.meshes[fusion], network.mesh_nodes(fusion)
    _check_can_filter_alone(f"node {node!r} of fusion {fusion!r} by itself", network, between)
    # The node's row of the graph: itself, then its neighbours.
    graph, neighbours = graph_of(between.neighbours or {}, nodes), between.neighbours or {}
    i, count = nodes.index(node), 1 + len(neighbours[node])
    row = Graph(nodes, graph.senders[i : i + 1, :count], np.ones((1, count), dtype=bool))
    names = (node, *neighbours[node])
    sensors = [network.nodes[name] for name in names]
    models = [stack_nodes([n.sensor], [n.channel]) if isinstance(n, Node) else None for n in sensors]
    sizes = tuple(n.received for n in sensors)
    mesh = Mesh(
        plant=network.plant,
        buckets=(MeshRows(between.rule.placed(row), np.zeros(1, dtype=int), count),),
        ranks=np.zeros(1, dtype=int),
        edges=MeshEdges((), np.zeros(0, dtype=int), row.present, 1),
        observation_model=Apart(tuple(models), np.arange(count), max(1, *sizes), (1,) * count),
        senders=np.arange(count)[None],
        places=((0,),),
        nodes=names,
        alpha=None,
        quantizer=None,
        needs_joint=False,
        claim=network.claims()[node][fusion],
    )
    alone = NodeFilter(
        mesh=mesh,
        measured=sizes,
        quantizer=next(iter(between.quantizers((node,))), None),
        receivers=tuple(name for name in nodes if node in neighbours[name]),
        claim=mesh.claim,
        states=network.states,
        inputs=network.inputs,
        received=sizes[0] + sum(_count_numbers(len(network.states), size) for size in sizes[1:]),
    )
    # The claim is that of the whole network, which stands here for the node's own part of it.
    return on_premise(alone, find_premise(network, node))


def _check_can_filter_alone(what: str, network: Network, between: Fusion) -> None:
    """Raise ValueError where a node cannot filter without knowledge of all others."""
    if between.rule.needs_joint:
        raise fail(what, "a rule that needs its neighbours' covariances alone (an intersection)",
                   type(between.rule).__name__)  # fmt: skip
    if between.rounds > 1 or between.alpha is not None:
        raise fail(what, "one exchange a step", "several rounds" if between.rounds > 1 else "events")
    if "dt" in network.inputs:
        raise fail(what, "a plant whose time counts steps, which all nodes share", "the input 'dt'")


def node_network(network: Network, node: str) -> Network:
    """Return the network of one node of a fusion between neighbours: itself, and its neighbours as senders of messages.

    Args:
        network: the whole network.
        node: name of the node.

    Raises:
        ValueError: no network, not one fusion between neighbours, no node of it, one that cannot run by itself.
    """
    instance("network", network, Network, "a Network")
    if len(network.meshes) != 1:
        raise fail("a node by itself", "a network with one fusion between neighbours", list(network.meshes) or "none")
    (name,) = network.meshes
    nodes = network.mesh_nodes(name)
    if text("node", node) not in nodes:
        raise fail("node", f"one of fusion {name!r}: {', '.join(nodes)}", repr(node))
    senders = (network.meshes[name].neighbours or {})[node]
    received = {j: _count_numbers(len(network.states), network.nodes[j].received) for j in senders}
    parts = {j: ReceivingNode({}, size, (), False) for j, size in received.items()}
    return Network(network.plant, {node: network.nodes[node], **parts}, {name: node_filter(network, name, node)})


def _count_numbers(n: int, size: int) -> int:
    """Return how many numbers a neighbour's message has: mean (n), covariance (n, n) and measurement (size)."""
    return n + n * n + size
