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
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Estimate, Innovation
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.float64 import compile_in_float64, in_float64
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import Array, ArrayLike
from heliograph.simulation.centres.observation_model import SeparateObservations, stack_nodes
from heliograph.simulation.covariance_claims import find_assumed
from heliograph.simulation.mesh.late_and_quantized_messages import MessagesOnTheWay, quantize_estimate
from heliograph.simulation.mesh.mesh import Mesh
from heliograph.simulation.mesh.neighbour_edges import MeshEdges
from heliograph.simulation.mesh.state_and_step import MeshState, NodeBucket
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node, ReceivingNode

# Compiled as one program, since a service calls it for each message.
_quantize_message = compile_in_float64(quantize_estimate)


class NodeState(NamedTuple):
    """State of a node's filter, which keeps the last step's start, since messages of that step may still come.

    Args:
        before: state before the last step, as the node's message of that step says it.
        inputs: of the plant over the last step.
        now: state after it, with all that came.
    """

    before: MeshState
    inputs: Array
    now: MeshState


class NodeFilter(AbstractSizedFilter):
    """Filter of one node of a fusion between neighbours: of the mesh it has one row and the neighbours' sensors.

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
        """Return the state before the first step: the plant's initial law, and no message on the way.

        A mesh is a fusion between neighbours: here one of this node alone, with its neighbours as senders.
        """
        start = self.mesh.init()
        n, count = start.mean.shape[1], len(self.measured)
        # The mesh has the node and its neighbours. The first axis of the messages, by age, is empty: none is late.
        no_messages = MessagesOnTheWay(jnp.zeros((0, count, n)), jnp.zeros((0, count, n, n)))
        state = start._replace(way=no_messages)
        return NodeState(state, jnp.zeros(len(self.inputs)), state)

    @predicts
    def predict(self, state: NodeState, u: ArrayLike = (), k: Step = 0) -> NodeState:
        """Return the state after step k as if nothing came, neither a measurement nor a message.

        The step starts from the estimate with all that came until now (`state.now`). `correct` repeats it from the same
        start with the data of the step.
        """
        nothing_received = jnp.full(self.received, jnp.nan)
        return self._step_from(state.now, nothing_received, jnp.asarray(u), k)

    @corrects
    def correct(self, state: NodeState, z: ArrayLike, k: Step = 0) -> tuple[NodeState, Innovation]:
        """Return the state after step k with what came in z, and the innovation of all measurements in z.

        Neighbours' estimates are of before the step, so that fusion comes before prediction: the step is taken again
        from `state.before`. The innovation is about the prediction without data, `state.now`.
        """
        after = self._step_from(state.before, jnp.asarray(z), state.inputs, k)
        # Measurements z_i = M_i x + o_i + nu_i of the node and its neighbours, without padding.
        mean, covariance = state.now.mean[0], state.now.covariance[0]
        observation = self.mesh.observation_model.observe(*state.now.plant, jnp.asarray(k))
        measurements, _ = self._split_measurements(jnp.asarray(z), state.before)
        sensors = [(i, size) for i, size in enumerate(self.measured) if size]  # (number of the node, its numbers)
        if not sensors:
            return after, no_innovation()
        gain = jnp.concatenate([observation.gain[i, :size] for i, size in sensors])
        offset = jnp.concatenate([observation.offset[i, :size] for i, size in sensors])
        noise = block_diag(*(observation.noise[i, :size, :size] for i, size in sensors))
        # Innovation z - (M x + o) of covariance S = M P M' + Cov nu, by the prediction x of covariance P.
        innovation_covariance = gain @ covariance @ gain.T + noise
        innovation = gaussian_innovation(jnp.concatenate(measurements), gain @ mean + offset, innovation_covariance)
        return after, innovation

    @estimates
    def estimate(self, state: NodeState) -> Estimate:
        """Return the mean and covariance of the node."""
        return Estimate(jnp.asarray(state.now.mean)[0], jnp.asarray(state.now.covariance)[0], self.claim)

    @in_float64
    def sent(self, before: MeshState) -> tuple[jax.Array, jax.Array]:
        """Return the mean (n,) and covariance (n, n) that a message about the estimate before a step holds.

        With a quantizer the mean is rounded to few bits, and the covariance is widened by the bound of that error. The
        node itself is row 0 of `before`.
        """
        mean, covariance = before.mean[0], before.covariance[0]
        return (mean, covariance) if self.quantizer is None else _quantize_message(self.quantizer, mean, covariance)

    def _split_measurements(self, z: jax.Array, before: MeshState) -> tuple[list[jax.Array], MeshState]:
        """Return the measurements of the node and its neighbours in z, and `before` with the estimates in z.

        The first row is the node's, and the next rows are its neighbours'. `self.measured`: how many numbers each of
        them measures. If a neighbour's message did not come, its mean is NaN, and its covariance is the node's own,
        since any regular one will do.
        """
        n, begin = len(self.states), self.measured[0]  # where the next neighbour's numbers begin in z
        measurements = [z[:begin]]  # the node's own first
        means, covariances = [before.mean[0]], [before.covariance[0]]
        # Each neighbour's numbers in z: mean (n), covariance (n n) and measurement (size).
        for size in self.measured[1:]:
            mean, covariance, measurement = jnp.split(z[begin : begin + n + n * n + size], [n, n + n * n])
            begin += n + n * n + size
            measurements.append(measurement)
            arrives = ~jnp.any(jnp.isnan(covariance))
            means.append(jnp.where(arrives, mean, jnp.nan))
            covariances.append(jnp.where(arrives, symmetrize(covariance.reshape(n, n)), covariances[0]))
        return measurements, before._replace(mean=jnp.stack(means), covariance=jnp.stack(covariances))

    def _step_from(self, before: MeshState, z: jax.Array, u: Array, k: Step) -> NodeState:
        """Return the state after step k of the mesh, which has the node as its only receiver, started from `before`.

        z: the node's measurement, then each neighbour's message with its estimate before the step and its measurement.
        """
        measurements, state_with_messages = self._split_measurements(z, before)
        # All messages are flagged as arrived, since NaN already marks those that did not come.
        all_arrive = jnp.ones((1, 1, len(measurements)), dtype=bool)
        after, _ = self.mesh.step(
            state=state_with_messages,
            z=[measurement[None] for measurement in measurements],
            arrived=all_arrive,
            u=jnp.asarray(u),
            k=jnp.asarray(k),
        )
        return NodeState(before=before, inputs=u, now=after)


def node_filter(network: Network, fusion: str, node: str) -> NodeFilter:
    """Return the filter of one node of a fusion between neighbours, on what its neighbours send.

    In such a fusion there is no centre: each node corrects its estimate by its own measurement and by its neighbours'
    messages. The filter does this for one node, with messages as measurements, so each node can be another process.

    Args:
        network: the network.
        fusion: name of its fusion between neighbours.
        node: name of the node.

    Raises:
        ValueError: a rule that needs the joint covariance of all nodes' errors, more than one round, events, a plant
            whose steps are of any length.
    """
    between, nodes = network.meshes[fusion], network.mesh_nodes(fusion)
    _check_can_filter_alone(f"node {node!r} of fusion {fusion!r} by itself", network, between)
    # The graph of this node alone: itself first, then its neighbours, which only send.
    mesh = _build_one_node_mesh(network, fusion, node)
    # The filter receives the node's own measurement, then a message of each neighbour: the neighbour's mean (n),
    # covariance (n, n) and measurement. `measured_by`: how many numbers the node and each neighbour measure.
    measured_by = tuple(network.nodes[name].received for name in mesh.nodes)
    own, *of_neighbours = measured_by
    filter = NodeFilter(
        mesh=mesh,
        measured=measured_by,
        quantizer=next(iter(between.quantizers((node,))), None),  # the node's own, if it has one
        receivers=tuple(name for name in nodes if node in (between.neighbours or {})[name]),  # whose neighbour it is
        claim=mesh.claim,
        states=network.states,
        inputs=network.inputs,
        received=own + sum(_count_message_numbers(len(network.states), size) for size in of_neighbours),
    )
    # The claim (what the covariance is said to be: exact, upper bound or nominal) is that of the whole network. The
    # assumed model, attached here, holds the models under which it is true: plant, and the node's sensor and channel.
    return with_assumed(filter, find_assumed(network, node))


def _build_one_node_mesh(network: Network, fusion: str, node: str) -> Mesh:
    """Return the mesh (a fusion between neighbours) in which one node alone estimates, for a filter of that node.

    It uses the node's own measurement and its neighbours' messages. No message gets lost in it: a message that did not
    arrive is given to the filter as a message of NaN.

    Args:
        network: the network.
        fusion: name of the fusion between neighbours.
        node: name of the node.
    """
    between, nodes = network.meshes[fusion], network.mesh_nodes(fusion)
    neighbours = between.neighbours or {}
    # The node's row of the graph: itself, then its neighbours, numbered as the network numbers its nodes.
    graph = graph_of(neighbours, nodes)
    i, count = nodes.index(node), 1 + len(neighbours[node])
    row = Graph(nodes, senders=graph.senders[i : i + 1, :count], present=np.ones((1, count), dtype=bool))
    only_node = np.zeros(1, dtype=int)  # number of the one node that estimates: it is the first of the members
    # The members: the node and its neighbours. Each has a measurement model of its own, since they may differ in
    # structure; None without a sensor.
    names = (node, *neighbours[node])
    members = [network.nodes[name] for name in names]
    models = [stack_nodes([n.sensor], [n.channel]) if isinstance(n, Node) else None for n in members]
    sizes = [n.received for n in members]
    # Without groups of channels every message arrives; a step has one exchange.
    lossless_edges = MeshEdges(groups=(), slots=np.zeros(0, dtype=int), present=row.present, rounds=1)
    return Mesh(
        plant=network.plant,
        buckets=(NodeBucket(rule=between.rule.placed(row), rows=only_node, width=count),),
        ranks=only_node,
        edges=lossless_edges,
        observation_model=SeparateObservations(
            tuple(models), order=np.arange(count), size=max(1, *sizes), counts=(1,) * count
        ),
        senders=np.arange(count)[None],  # numbered among the members
        indices=((0,),),
        nodes=names,
        alpha=None,
        quantizer=None,
        needs_joint=False,
        claim=network.claims()[node][fusion],
    )


def _check_can_filter_alone(what: str, network: Network, between: Fusion) -> None:
    """Raise ValueError if a node of the fusion `between` neighbours would have to know all other nodes to filter.

    A node alone knows what its neighbours' messages hold: their estimates, covariances and measurements. `what`: the
    filter in words, for the error.
    """
    if between.rule.needs_joint:
        raise fail(what, "a rule that needs its neighbours' covariances alone (an intersection)",
                   type(between.rule).__name__)  # fmt: skip
    if between.rounds > 1 or between.alpha is not None:
        raise fail(what, "one exchange a step", "several rounds" if between.rounds > 1 else "events")
    if "dt" in network.inputs:  # with the length of a step as an input, nodes could have different steps
        raise fail(what, "a plant whose time counts steps, which all nodes share", "the input 'dt'")


def node_network(network: Network, node: str) -> Network:
    """Return the network that one node of a fusion between neighbours sees: itself, and its neighbours as senders.

    Args:
        network: the whole network.
        node: name of the node.

    Raises:
        ValueError: no network, none or several fusions between neighbours, an unknown node, one that cannot run alone.
    """
    instance("network", network, Network, "a Network")
    if len(network.meshes) != 1:
        raise fail("a node by itself", "a network with one fusion between neighbours", list(network.meshes) or "none")
    (name,) = network.meshes
    nodes = network.mesh_nodes(name)
    if text("node", node) not in nodes:
        raise fail("node", f"one of fusion {name!r}: {', '.join(nodes)}", repr(node))
    senders = (network.meshes[name].neighbours or {})[node]
    received = {j: _count_message_numbers(len(network.states), network.nodes[j].received) for j in senders}
    parts = {j: ReceivingNode(filters={}, received=size, outputs=(), complete=False) for j, size in received.items()}
    return Network(network.plant, {node: network.nodes[node], **parts}, {name: node_filter(network, name, node)})


def _count_message_numbers(n: int, size: int) -> int:
    """Return how many numbers a neighbour's message has: mean (n), covariance (n, n) and measurement (size)."""
    return n + n * n + size
