"""Fusion between neighbours inside a step: every node fuses what arrived, predicts once, and corrects."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.limits import MESH
from heliograph.fusion.cross_covariance import Motion, Observation, propagate_state
from heliograph.fusion.intersection import invert
from heliograph.fusion.mesh.gains import (
    NeighbourEstimates,
    NeighbourWeights,
    NodeGains,
    NodeStep,
    gains_of,
    information_of,
)
from heliograph.fusion.mesh.graph import graph_of
from heliograph.fusion.mesh.joint import blocks_of, error_transitions, joint_after, measurement_weights, scatter_blocks
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first, stack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Bool, Float, PyTree
from heliograph.simulation.centres.centre import Apart, ObservationModel, stack_nodes
from heliograph.simulation.centres.edges import Edges, edges_of
from heliograph.simulation.centres.messages import Messages, OnTheWay, gather_messages, step_way, test_moved_beyond
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DENSE = 200  # nodes whose joint covariance is propagated at every step
Arrived = Bool[Array, "node rounds degree"]  # which messages arrived, each node's from itself first
Ahead = Sequence[Sequence[Array]]  # parts and covariance of weights, by part of the nodes; none where there are none


class MeshState(NamedTuple):
    """Estimates of all nodes, the covariances by which they weigh, and what is known before any data.

    Shapes: mean (node, n), covariance (node, n, n); joint (node, n, node, n) covariance of all errors, None where the
    rule does without; plant: mean (n,) and covariance (n, n) of the state; sent (node, degree, n): estimates of its
    neighbours that each node received last, predicted, where not all are sent; way: messages that may arrive later.
    """

    mean: Float[jax.Array, "node n"]
    covariance: Float[jax.Array, "node n n"]
    joint: Float[jax.Array, "node n node n"] | None
    plant: tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]
    sent: Float[jax.Array, "node degree n"] | None
    way: OnTheWay | None


class Data(NamedTuple):
    """Measurement models of one step: H_j' R_j^-1 (node, n, m) and S_j = H_j' R_j^-1 H_j (node, n, n) of what is there.

    `complete`: S_j if no component were missing.
    """

    observation: Observation
    weighted: Float[jax.Array, "node n m"]
    information: Float[jax.Array, "node n n"]
    complete: Float[jax.Array, "node n n"]


class MeshStep(NamedTuple):
    """One step of all nodes without the estimates, which enter none of it.

    exchanges: weights of every round but the last. Shapes: information (node, n, n) that each node has
    learned; plant: moments of the state after the step.
    """

    motion: Motion
    plant: tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]
    exchanges: tuple[NeighbourWeights, ...]
    data: Data
    information: Float[jax.Array, "node n n"]
    gains: NodeGains


class Rows(Module):
    """Some nodes of a mesh, of about as many neighbours, and the rule placed on them."""

    rule: AbstractFusion
    rows: np.ndarray
    width: int = eqx.field(static=True)


class Mesh(Module):
    """A fusion between neighbours: the graph, its edges, the rule on parts of its nodes, models of the measurements.

    `places` bring the nodes into the order of the network's groups again, `ranks` the nodes of all buckets.
    """

    plant: AnyPlant
    buckets: tuple[Rows, ...]
    ranks: np.ndarray
    edges: Edges
    observation_model: Apart
    senders: np.ndarray
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)
    alpha: np.ndarray | None
    quantizer: AbstractQuantizer | None
    needs_joint: bool = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    @property
    def is_long(self) -> bool:
        """Return whether a step has too many operations for native code, in which they are written one by one."""
        n = len(first(self.plant).states)
        sent = self.edges.rounds * int(np.count_nonzero(self.edges.present)) * n * n
        rows = len(self.senders) * n if self.needs_joint else 0
        return max(sent, 2 * rows**2) > MESH

    def init(self) -> MeshState:
        """Return the state before the first step: the plant's mean and covariance at every node."""
        plant = at(self.plant, 0)
        mean, covariance = jnp.asarray(plant.initial_mean), jnp.asarray(plant.initial_covariance)
        nodes, n = len(self.senders), len(mean)
        joint = jnp.broadcast_to(covariance[None, :, None], (nodes, n, nodes, n)) if self.needs_joint else None
        sent = None if self.alpha is None else jnp.tile(mean, (*self.senders.shape, 1))
        both = jnp.tile(mean, (nodes, 1)), jnp.tile(covariance, (nodes, 1, 1))
        way = None
        if self.edges.past or self.quantizer is not None:
            ages = self.edges.past
            way = OnTheWay(jnp.tile(mean, (ages, nodes, 1)), jnp.tile(covariance, (ages, nodes, 1, 1)))
        return MeshState(*both, joint, (mean, covariance), sent, way)

    def step(
        self, state: MeshState, z: Sequence[jax.Array], arrived: Arrived,
        u: jax.Array, k: jax.Array, ahead: Ahead = (),
    ) -> tuple[MeshState, tuple[Estimate, ...]]:  # fmt: skip
        """Exchange, fuse, predict and correct at step k: next state, and estimates (1, node, ...) by group of nodes.

        xhat+ = A xhat + b + sum_j M_j (xhat_j - xhat) + W (s - S (A xhat + b)), M_j `gains.front` `gains.parts`,
        W `gains.gain`, S `parts.information`. `arrived`: (node, round, neighbour); `ahead`: weights computed before.
        """
        measured = jnp.concatenate([self._rows(rows) for rows in z])[self.observation_model.order]
        blocks = None if state.joint is None else blocks_of(state.joint, self.senders)
        present = ~jnp.isnan(measured)
        messages = self._keep_messages(state, jnp.asarray(arrived))
        arrived = arrived if messages is None else messages.fresh
        parts = self.parts(state.covariance, blocks, state.plant, present, arrived, u, k, ahead, messages)
        gains, motion = parts.gains, parts.motion
        # All rounds but the last only intersect: xhat_i + front_i sum_j parts_ij (xhat_j - xhat_i).
        mean = state.mean
        for weights in parts.exchanges:
            mean = mean + self._pull_to_neighbours(weights.front, weights.parts, mean, mean[self.senders])
        sent = self._send_estimates(mean, state, jnp.asarray(arrived[:, -1]), messages)
        mean = mean[self.senders[:, 0]]  # of the nodes that are stepped
        # s_i = sum_j H' R^-1 (z_j - H m) about one common prediction m, so that no digits of the means are lost.
        predicted = mean @ motion.matrix.T + motion.shift
        common = jnp.mean(predicted, axis=0)
        observation = parts.data.observation
        off = jnp.where(present, measured - observation.offset - observation.gain @ common, 0.0)
        weighted = jnp.einsum("inm,im->in", parts.data.weighted, off)
        sums = self._collect_sums(weighted, arrived)
        innovation = sums - jnp.einsum("iab,ib->ia", parts.information, predicted - common)
        pulled = self._pull_to_neighbours(gains.front, gains.parts, mean, sent)
        mean = predicted + pulled + jnp.einsum("iab,ib->ia", gains.gain, innovation)
        # Covariance of all errors where the rule needs it; it is then what is claimed.
        joint = None if state.joint is None else self._propagate_joint(state.joint, parts, jnp.asarray(arrived[:, -1]))
        claimed = gains.covariance if joint is None else jnp.einsum("iaib->iab", joint)
        moved_on = None if state.sent is None else sent @ motion.matrix.T + motion.shift
        after = MeshState(mean, gains.covariance, joint, parts.plant, moved_on, None)
        if messages is not None and state.way is not None:
            under_way = step_way(messages, state.way, motion, common, weighted, parts.data.information)
            after = after._replace(way=under_way)
        return after, self._split_by_group(mean, claimed)

    def _keep_messages(self, state: MeshState, arrived: jax.Array) -> Messages | None:
        """Return the messages that are no estimates of now as they are; None where all are."""
        if state.way is None:
            return None
        ages = arrived if self.edges.past else jnp.where(arrived, 0, -1)
        return gather_messages(state.mean, state.covariance, state.way, self.quantizer, self.senders, ages)

    def _send_estimates(
        self, mean: jax.Array, state: MeshState, arrives: jax.Array, messages: Messages | None
    ) -> Float[jax.Array, "node degree n"]:
        """Estimates that the nodes have of their neighbours: those of now, or what they received last or late."""
        if messages is not None:
            return messages.mean[messages.senders]
        now = mean[self.senders]
        if state.sent is None or self.alpha is None:
            return now
        information = jax.vmap(invert)(state.covariance)[self.senders]
        moved = test_moved_beyond(self.alpha, now - state.sent, information, self.senders, self.edges.present)
        return jnp.where((arrives & moved[self.senders])[..., None], now, state.sent)

    def parts(
        self, covariance: Float[Array, "node n n"], blocks: Float[Array, "node degree n degree n"] | None,
        moments: tuple[Array, Array], there: Bool[Array, "node m"], arrived: Arrived, u: Array, k: Array,
        ahead: Ahead = (), messages: Messages | None = None,
    ) -> MeshStep:  # fmt: skip
        """Everything at step k but the estimates, from the covariances before it and what is there and arrives."""
        covariance, there, arrived, u = (jnp.asarray(x) for x in (covariance, there, arrived, u))
        held = None if blocks is None else jnp.asarray(blocks)
        plant: LinearPlant = at(self.plant, jnp.asarray(k))
        shift = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean()
        motion = Motion(jnp.asarray(plant.matrix), shift, plant.noise_covariance(u))
        after = propagate_state(jnp.asarray(moments[0]), jnp.asarray(moments[1]), motion)
        exchanges = []
        for number in range(self.edges.rounds - 1):
            exchanges.append(self._map_nodes(_weights, covariance, None, arrived[:, number]))
            covariance = jnp.asarray(exchanges[-1].covariance)
        # What each node learns of the measurements, and its gains.
        data = self._exchange_measurements(self.observation_model.observe(*after, jnp.asarray(k)), there)
        information = self._collect_sums(data.information, arrived)
        complete = self.sum_of(data.complete, jnp.asarray(self.edges.present))
        arrives, senders = arrived[:, -1], None
        if messages is not None:
            covariance, senders, arrives = messages.covariance, messages.senders, messages.arrives[:, -1]
        gains = self.gains(covariance, held, arrives, motion, information, complete, ahead, senders)
        return MeshStep(motion, after, tuple(exchanges), data, information, gains)

    def _rows(self, z: jax.Array) -> Float[jax.Array, "node m"]:
        """Return the measurements of a group, filled with NaN up to the longest."""
        return jnp.pad(z, ((0, 0), (0, self.observation_model.size - z.shape[1])), constant_values=jnp.nan)

    def _pull_to_neighbours(
        self, front: Float[jax.Array, "node n n"], parts: Float[jax.Array, "node degree n *n"],
        mean: jax.Array, sent: Float[jax.Array, "node degree n"],
    ) -> Float[jax.Array, "node n"]:  # fmt: skip
        """Return front_i sum_j parts_ij (xs_ij - xhat_i) over the neighbours j of i and what it has of them."""
        away = (sent - mean[:, None]).at[:, 0].set(0.0)
        off = jnp.einsum("idab,idb->ia", parts, away) if parts.ndim == 4 else jnp.sum(parts * away, axis=1)
        return jnp.einsum("iab,ib->ia", front, off)

    def _exchange_measurements(self, observation: Observation, there: Bool[jax.Array, "node m"]) -> Data:
        """Return the messages about what was measured, and about what would be if no component were missing."""
        real = jnp.any(observation.gain != 0, axis=-1) | (jnp.einsum("imm->im", observation.noise) > 0)
        gain, noise = jnp.asarray(observation.gain), jnp.asarray(observation.noise)
        weighted, information = jax.vmap(information_of)(gain, noise, real & there)
        complete = jax.vmap(information_of)(gain, noise, real)[1]
        return Data(observation, weighted, information, complete)

    def _map_nodes(
        self,
        function: Callable[..., PyTree],
        covariance: jax.Array,
        blocks: jax.Array | None,
        present: jax.Array,
        *rest: jax.Array,
        ahead: Ahead = (),
        senders: Array | None = None,
    ) -> PyTree:
        """Apply a function of rule, what a node believes, and more by node, to all nodes side by side."""
        information, traces = jax.vmap(invert)(covariance), jnp.trace(covariance, axis1=1, axis2=2)
        over_rows = eqx.filter_vmap(function, in_axes=(eqx.if_array(-1), *[0] * (2 + len(rest))))
        by_bucket = []
        for bucket, bucket_ahead in zip(self.buckets, ahead or [()] * len(self.buckets), strict=True):
            rows, width = bucket.rows, bucket.width
            theirs = (self.senders if senders is None else senders)[rows, :width]
            block = None if blocks is None else blocks[rows, :width, :, :width]
            seen = NeighbourEstimates(
                covariance[theirs[:, 0]], traces[theirs], information[theirs], block, present[rows, :width]
            )
            if self.alpha is not None:  # what was sent last errs by more than the estimate
                wider = jnp.where(np.arange(width) > 0, (1 + jnp.sqrt(self.alpha * covariance.shape[-1])) ** 2, 1.0)
                seen = seen._replace(traces=seen.traces * wider, information=seen.information / wider[:, None, None])
            by_bucket.append(over_rows(bucket.rule, seen, *(leaf[rows] for leaf in rest), bucket_ahead))
        if len(by_bucket) == 1:
            return by_bucket[0]
        # Rows of one length again, in the order of the nodes.
        padded = [r._replace(parts=_pad_to_degree(r.parts, self.senders.shape[1])) for r in by_bucket]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[self.ranks], *padded)

    def _collect_sums(self, values: jax.Array, arrived: Arrived) -> jax.Array:
        """Return the sums of the nodes' messages that each node has after all rounds, each counted once."""
        if self.edges.rounds == 1:
            return self.sum_of(values, jnp.asarray(arrived[:, 0]))
        return jnp.tensordot(self.known(arrived).astype(values.dtype), values, 1)

    def known(self, arrived: Arrived) -> Bool[jax.Array, "node node"]:
        """Return the test whose measurements each node has after all rounds."""
        known, arrived = jnp.eye(len(self.senders), dtype=bool), jnp.asarray(arrived)
        for number in range(self.edges.rounds):
            known = jnp.any(known[self.senders] & arrived[:, number, :, None], axis=1)
        return known

    def sum_of(self, values: jax.Array, present: jax.Array) -> jax.Array:
        """Sum over what arrived of values by node."""
        sums: jax.Array = jnp.einsum("id,id...->i...", present.astype(values.dtype), values[self.senders])
        return sums

    def gains(
        self, covariance: jax.Array, blocks: jax.Array | None, present: jax.Array, motion: Motion,
        information: jax.Array, complete: jax.Array, ahead: Ahead = (), senders: Array | None = None,
    ) -> NodeGains:  # fmt: skip
        """Return the gains of all nodes."""

        def single(
            rule: AbstractFusion,
            belief: NeighbourEstimates,
            arrived: jax.Array,
            every: jax.Array,
            known: Sequence[jax.Array],
        ) -> NodeGains:
            step = NodeStep(motion.matrix, motion.noise, arrived, every)
            if known:
                return gains_of(NeighbourWeights(jnp.eye(len(motion.shift)), *known), step)
            return rule.neighbour_gains(belief, step)

        gains: NodeGains = self._map_nodes(single, covariance, blocks, present, information, complete,
                                         ahead=ahead, senders=senders)  # fmt: skip
        return gains

    def ahead(self, arrived: Bool[np.ndarray, "step node rounds degree"]) -> Ahead:
        """Return the weights of many steps, by part of the nodes; none where they depend on more than what arrives."""
        weights = [bucket.rule.weights_ahead(arrived[:, bucket.rows, -1, : bucket.width])
                 for bucket in self.buckets if isinstance(bucket.rule, FrozenWeights)]  # fmt: skip
        return () if None in weights else tuple(filter(None, weights))

    def _propagate_joint(
        self, joint: jax.Array, parts: MeshStep, present: jax.Array
    ) -> Float[jax.Array, "node n node n"]:
        """Return the joint covariance after a step."""
        gains, motion, size = parts.gains, parts.motion, joint.shape[0] * joint.shape[1]
        measured = measurement_weights(gains.gain, present)
        blocks = error_transitions(gains, motion.matrix), measured @ parts.data.information[self.senders], measured
        m, ws, w = (scatter_blocks(jnp.asarray(each), self.senders, self.edges.present) for each in blocks)
        after = joint_after(joint.reshape(size, size), m, gains.innovation, motion.noise, ws, w)
        return jnp.asarray(after).reshape(joint.shape)

    def _split_by_group(self, mean: jax.Array, covariance: jax.Array) -> tuple[Estimate, ...]:
        """Return the estimates (1, node, ...) of the mesh's nodes in each of the network's groups."""
        return tuple(
            Estimate(mean[jnp.array(rows)][None], covariance[jnp.array(rows)][None], self.claim) for rows in self.places
        )


def _weights(rule: AbstractFusion, belief: NeighbourEstimates, *_: PyTree) -> NeighbourWeights:
    """Return the weights of an exchange that only intersects, with the covariance after it."""
    return rule.neighbour_weights(belief)


def _pad_to_degree(parts: jax.Array, degree: int) -> Float[jax.Array, "node degree n *n"]:
    """Pad rows with zeros up to the longest."""
    return jnp.pad(parts, ((0, 0), (0, degree - parts.shape[1]), *[(0, 0)] * (parts.ndim - 2)))


def build_mesh(network: Network, name: str) -> Mesh:
    """Build the fusion `name` between neighbours of a network."""
    fusion = network.meshes[name]
    assert fusion.neighbours is not None
    nodes = network.mesh_nodes(name)
    graph = graph_of(fusion.neighbours, nodes)
    # Models of the measurements, group after group.
    index = {node: i for i, node in enumerate(nodes)}
    groups: list[ObservationModel | None] = []
    group_places: dict[str, int] = {}
    for names in network.groups:
        sensors = [node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)]
        groups.append(stack_nodes([n.sensor for n in sensors], [n.channel for n in sensors]) if sensors else None)
        group_places |= {node: len(group_places) + i for i, node in enumerate(names)}
    # Kinds of its filters, and the places of their nodes in the mesh.
    kinds = [kind for kind in network.mesh_kinds if kind.filters == (name,)]
    kind_places = [tuple(index[node] for node in network.groups[kind.group]) for kind in kinds]
    return Mesh(
        plant=network.plant,
        buckets=tuple(Rows(fusion.rule.placed(b), b.senders[:, 0], b.senders.shape[1]) for b in graph.buckets()),
        ranks=np.argsort(np.concatenate([bucket.senders[:, 0] for bucket in graph.buckets()])),
        edges=edges_of(fusion, graph),
        observation_model=Apart(
            tuple(groups),
            np.array([group_places[node] for node in nodes]),
            max(1, *(node.received for node in network.nodes.values())),
            tuple(map(len, network.groups)),
        ),
        senders=graph.senders,
        places=tuple(kind_places),
        nodes=graph.nodes,
        alpha=None if fusion.alpha is None else np.asarray(fusion.alpha),  # a number of its program
        quantizer=stack(fusion.quantizers(graph.nodes)) if fusion.quantizer is not None else None,
        needs_joint=fusion.rule.needs_joint,
        claim=network.claims()[nodes[0]][name],
    )


def build_meshes(network: Network) -> dict[str, Mesh]:
    """Return the fusions between neighbours, by name, to be stepped.

    Raises:
        ValueError: too many nodes for a rule that follows the joint covariance of their errors.
    """
    for name, fusion in network.meshes.items():
        nodes = len(network.mesh_nodes(name))
        if fusion.rule.needs_joint and nodes > DENSE:
            kind = type(fusion.rule).__name__
            expected = f"at most {DENSE} nodes, whose joint covariance it follows (freeze it, or intersect)"
            raise fail(f"fusion {name!r} between neighbours by {kind}", expected, nodes)
    return {name: build_mesh(network, name) for name in network.meshes}
