"""Fusion between neighbours inside a step: every node fuses what arrived, predicts once, and corrects."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.limits import MESH
from heliograph.fusion.cross_covariance import JointObservation, Motion, propagate_state
from heliograph.fusion.intersection import invert
from heliograph.fusion.mesh.gains import (
    NeighbourEstimates,
    NeighbourWeights,
    NodeGains,
    NodeStep,
    gains_of,
    information_of,
)
from heliograph.fusion.mesh.joint_error_covariance import (
    blocks_of,
    error_transitions,
    measurement_weights,
    propagate_joint_covariance,
    scatter_blocks,
)
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Bool, Float, PyTree
from heliograph.simulation.centres.neighbour_edges import MeshEdges
from heliograph.simulation.centres.neighbour_messages import (
    ArrivingEstimates,
    MessagesOnTheWay,
    find_moved_beyond,
    gather_messages,
    step_messages_on_the_way,
)
from heliograph.simulation.centres.observation_model import Apart

Arrived = Bool[Array, "node rounds degree"]  # which messages arrived, each node's from itself first
Ahead = Sequence[Sequence[Array]]  # weights computed before a step: parts and covariance by bucket; empty: none are


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
    way: MessagesOnTheWay | None


class MeasurementInformation(NamedTuple):
    """Information in the measurements of one step, by the node j that took them, of components that are not missing.

    `observation`: z_j = H_j x + offset + noise of covariance R_j. `weighted`: H_j' R_j^-1 (node, n, m). `information`:
    S_j = H_j' R_j^-1 H_j (node, n, n). `complete`: S_j if no component were missing.
    """

    observation: JointObservation
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
    data: MeasurementInformation
    information: Float[jax.Array, "node n n"]
    gains: NodeGains


class MeshRows(Module):
    """Some nodes of a mesh, of about as many neighbours, and the rule placed on them.

    `rows`: their numbers. `width`: the most messages that one of them receives, its own included.
    """

    rule: AbstractFusion
    rows: np.ndarray
    width: int = eqx.field(static=True)


class Mesh(Module):
    """A fusion between neighbours: the graph, its edges, the rule on parts of its nodes, models of the measurements.

    `buckets`: the nodes, those of about as many neighbours together; `ranks` bring what buckets give, one after
    another, into the order of the nodes. `senders` (node, degree): of whom each node receives, itself first. `places`:
    numbers of the nodes of each group of the network.
    """

    plant: AnyPlant
    buckets: tuple[MeshRows, ...]
    ranks: np.ndarray
    edges: MeshEdges
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
        way = None
        if self.edges.past or self.quantizer is not None:
            ages = self.edges.past
            way = MessagesOnTheWay(jnp.tile(mean, (ages, nodes, 1)), jnp.tile(covariance, (ages, nodes, 1, 1)))
        return MeshState(
            mean=jnp.tile(mean, (nodes, 1)),
            covariance=jnp.tile(covariance, (nodes, 1, 1)),
            joint=joint,
            plant=(mean, covariance),
            sent=sent,
            way=way,
        )

    def step(
        self, state: MeshState, z: Sequence[jax.Array], arrived: Arrived,
        u: jax.Array, k: jax.Array, ahead: Ahead = (),
    ) -> tuple[MeshState, tuple[Estimate, ...]]:  # fmt: skip
        """Exchange, fuse, predict and correct at step k: next state, and estimates (1, node, ...) by group of nodes.

        xhat+ = A xhat + b + sum_j M_j (xhat_j - xhat) + W (s - S (A xhat + b)): M_j = `gains.front` `gains.parts`,
        W = `gains.gain`, S = `parts.information` and s, `sums` of H' R^-1 z over the measurements that arrived.
        `z`: measurements by group. `arrived` (node, round, neighbour): flags or ages. `ahead`: weights computed before.
        """
        measured = jnp.concatenate([self._pad_to_longest(rows) for rows in z])[self.observation_model.order]
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
            under_way = step_messages_on_the_way(messages, state.way, motion, common, weighted, parts.data.information)
            after = after._replace(way=under_way)
        return after, self._split_by_group(mean, claimed)

    def _keep_messages(self, state: MeshState, arrived: jax.Array) -> ArrivingEstimates | None:
        """Return the messages that arrive, where they may be late or quantized; None where all are estimates of now."""
        if state.way is None:
            return None
        ages = arrived if self.edges.past else jnp.where(arrived, 0, -1)
        return gather_messages(state.mean, state.covariance, state.way, self.quantizer, self.senders, ages)

    def _send_estimates(
        self, mean: jax.Array, state: MeshState, arrives: jax.Array, messages: ArrivingEstimates | None
    ) -> Float[jax.Array, "node degree n"]:
        """Return the estimates that each node has of its neighbours: those of now, or what it received last or late."""
        if messages is not None:
            return messages.mean[messages.senders]
        now = mean[self.senders]
        if state.sent is None or self.alpha is None:
            return now
        # With events: a node sends only where its estimate has moved beyond what somebody received last.
        information = jax.vmap(invert)(state.covariance)[self.senders]
        moved = find_moved_beyond(self.alpha, now - state.sent, information, self.senders, self.edges.present)
        return jnp.where((arrives & moved[self.senders])[..., None], now, state.sent)

    def parts(
        self, covariance: Float[Array, "node n n"], blocks: Float[Array, "node degree n degree n"] | None,
        moments: tuple[Array, Array], there: Bool[Array, "node m"], arrived: Arrived, u: Array, k: Array,
        ahead: Ahead = (), messages: ArrivingEstimates | None = None,
    ) -> MeshStep:  # fmt: skip
        """Return all of step k but the estimates: models, moments of the plant, weights and gains.

        `covariance`, `blocks` and `moments` are of before the step; blocks: the joint covariance of each neighbourhood.
        `there`: components measured. `arrived`: messages that arrive.
        """
        covariance, there, arrived, u = (jnp.asarray(x) for x in (covariance, there, arrived, u))
        blocks = None if blocks is None else jnp.asarray(blocks)
        plant: LinearPlant = at(self.plant, jnp.asarray(k))
        shift = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean()
        motion = Motion(jnp.asarray(plant.matrix), shift, plant.noise_covariance(u))
        after = propagate_state(jnp.asarray(moments[0]), jnp.asarray(moments[1]), motion)
        exchanges = []
        for number in range(self.edges.rounds - 1):
            exchanges.append(self._map_nodes(_weigh_neighbours, covariance, None, arrived[:, number]))
            covariance = jnp.asarray(exchanges[-1].covariance)
        # What each node learns of the measurements, and its gains.
        data = self._exchange_measurements(self.observation_model.observe(*after, jnp.asarray(k)), there)
        information = self._collect_sums(data.information, arrived)
        complete = self.sum_of(data.complete, jnp.asarray(self.edges.present))
        arrives, senders = arrived[:, -1], None
        if messages is not None:
            covariance, senders, arrives = messages.covariance, messages.senders, messages.arrives[:, -1]
        gains = self.gains(covariance, blocks, arrives, motion, information, complete, ahead, senders)
        return MeshStep(
            motion=motion,
            plant=after,
            exchanges=tuple(exchanges),
            data=data,
            information=information,
            gains=gains,
        )

    def _pad_to_longest(self, z: jax.Array) -> Float[jax.Array, "node m"]:
        """Return the measurements of a group, filled with NaN up to the longest of all nodes."""
        return jnp.pad(z, ((0, 0), (0, self.observation_model.size - z.shape[1])), constant_values=jnp.nan)

    def _pull_to_neighbours(
        self, front: Float[jax.Array, "node n n"], parts: Float[jax.Array, "node degree n *n"],
        mean: jax.Array, sent: Float[jax.Array, "node degree n"],
    ) -> Float[jax.Array, "node n"]:  # fmt: skip
        """Return front_i sum_j parts_ij (sent_ij - mean_i) over the neighbours j of i; parts: matrices or scalars."""
        difference = (sent - mean[:, None]).at[:, 0].set(0.0)
        is_matrix = parts.ndim == 4
        pull = jnp.einsum("idab,idb->ia", parts, difference) if is_matrix else jnp.sum(parts * difference, axis=1)
        return jnp.einsum("iab,ib->ia", front, pull)

    def _exchange_measurements(
        self, observation: JointObservation, there: Bool[jax.Array, "node m"]
    ) -> MeasurementInformation:
        """Return each node's information from what it measured, and from all of it if no component were missing."""
        # Rows of zeros without noise only pad a measurement.
        real = jnp.any(observation.gain != 0, axis=-1) | (jnp.einsum("imm->im", observation.noise) > 0)
        gain, noise = jnp.asarray(observation.gain), jnp.asarray(observation.noise)
        weighted, information = jax.vmap(information_of)(gain, noise, real & there)
        complete = jax.vmap(information_of)(gain, noise, real)[1]
        return MeasurementInformation(observation, weighted, information, complete)

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
        """Apply function(rule, estimates of the neighbours, *rest, *ahead) to all nodes side by side.

        Args:
            function: of one node.
            covariance: (node, n, n) of all estimates.
            blocks: (node, degree, n, degree, n) joint covariances of each neighbourhood; None where no rule needs them.
            present: (node, degree) which messages arrive.
            *rest: further arguments by node.
            ahead: weights computed before, by bucket.
            senders: rows of `covariance` that each node's messages are of; None for the graph's.
        """
        information, traces = jax.vmap(invert)(covariance), jnp.trace(covariance, axis1=1, axis2=2)
        over_rows = eqx.filter_vmap(function, in_axes=(eqx.if_array(-1), *[0] * (2 + len(rest))))
        by_bucket = []
        for bucket, bucket_ahead in zip(self.buckets, ahead or [()] * len(self.buckets), strict=True):
            rows, width = bucket.rows, bucket.width
            sent_by = (self.senders if senders is None else senders)[rows, :width]
            block = None if blocks is None else blocks[rows, :width, :, :width]
            seen = NeighbourEstimates(
                covariance[sent_by[:, 0]], traces[sent_by], information[sent_by], block, present[rows, :width]
            )
            # With events what a neighbour sent last errs by more than its estimate: by (1 + sqrt(alpha n))^2 P.
            if self.alpha is not None:
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
        """Return for each node (row) whether it has each node's (column) measurement after all rounds."""
        known, arrived = jnp.eye(len(self.senders), dtype=bool), jnp.asarray(arrived)
        for number in range(self.edges.rounds):
            known = jnp.any(known[self.senders] & arrived[:, number, :, None], axis=1)
        return known

    def sum_of(self, values: jax.Array, present: jax.Array) -> jax.Array:
        """Return for each node the sum of the values (node, ...) of those whose messages are present (node, degree)."""
        sums: jax.Array = jnp.einsum("id,id...->i...", present.astype(values.dtype), values[self.senders])
        return sums

    def gains(
        self, covariance: jax.Array, blocks: jax.Array | None, present: jax.Array, motion: Motion,
        information: jax.Array, complete: jax.Array, ahead: Ahead = (), senders: Array | None = None,
    ) -> NodeGains:  # fmt: skip
        """Return the gains of all nodes in a step of this motion.

        `information`: what each node learns of the measurements; `complete`: if none were missing; others as of
        `_map_nodes`.
        """

        def compute_node_gains(
            rule: AbstractFusion,
            belief: NeighbourEstimates,
            arrived: jax.Array,
            every: jax.Array,
            known: Sequence[jax.Array],
        ) -> NodeGains:
            """Return the gains of one node, with weights that are known or those of the rule."""
            step = NodeStep(motion.matrix, motion.noise, arrived, every)
            if known:
                return gains_of(NeighbourWeights(jnp.eye(len(motion.shift)), *known), step)
            return rule.neighbour_gains(belief, step)

        gains: NodeGains = self._map_nodes(compute_node_gains, covariance, blocks, present, information, complete,
                                         ahead=ahead, senders=senders)  # fmt: skip
        return gains

    def ahead(self, arrived: Bool[np.ndarray, "step node rounds degree"]) -> Ahead:
        """Return the weights of many steps by bucket; none where they depend on more than what arrives."""
        weights = [bucket.rule.weights_ahead(arrived[:, bucket.rows, -1, : bucket.width])
                 for bucket in self.buckets if isinstance(bucket.rule, FrozenWeights)]  # fmt: skip
        return () if None in weights else tuple(filter(None, weights))

    def _propagate_joint(
        self, joint: jax.Array, parts: MeshStep, present: jax.Array
    ) -> Float[jax.Array, "node n node n"]:
        """Return the joint covariance M J M' + F Q F' + sum_l K_l R_l K_l' after a step, F `gains.innovation`."""
        gains, motion, size = parts.gains, parts.motion, joint.shape[0] * joint.shape[1]
        # W_il of node i for node l's H_l' R_l^-1 z_l: K_l = W_l H_l' R_l^-1, K_l R_l K_l' = W_l S_l W_l'.
        measured = measurement_weights(gains.gain, present)
        blocks = error_transitions(gains, motion.matrix), measured @ parts.data.information[self.senders], measured
        m, ws, w = (scatter_blocks(jnp.asarray(each), self.senders, self.edges.present) for each in blocks)
        after = propagate_joint_covariance(joint.reshape(size, size), m, gains.innovation, motion.noise, ws, w)
        return jnp.asarray(after).reshape(joint.shape)

    def _split_by_group(self, mean: jax.Array, covariance: jax.Array) -> tuple[Estimate, ...]:
        """Return the estimates (1, node, ...) of the mesh's nodes in each of the network's groups."""
        return tuple(
            Estimate(mean[jnp.array(rows)][None], covariance[jnp.array(rows)][None], self.claim) for rows in self.places
        )


def _weigh_neighbours(rule: AbstractFusion, belief: NeighbourEstimates, *_: PyTree) -> NeighbourWeights:
    """Return the weights of an exchange that only intersects, with the covariance after it."""
    return rule.neighbour_weights(belief)


def _pad_to_degree(parts: jax.Array, degree: int) -> Float[jax.Array, "node degree n *n"]:
    """Return the weights of each node's messages, padded with zeros to `degree` messages."""
    return jnp.pad(parts, ((0, 0), (0, degree - parts.shape[1]), *[(0, 0)] * (parts.ndim - 2)))
