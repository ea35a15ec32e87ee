"""Fusion between neighbours inside a step: every node fuses what arrived, predicts once, and corrects."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.size_thresholds import MESH
from heliograph.fusion.covariance_intersection import invert_positive_definite
from heliograph.fusion.cross_covariance import Motion, propagate_state
from heliograph.fusion.mesh.joint_error_covariance import blocks_of
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.mesh.node_gains import (
    NeighbourEstimates,
    NeighbourWeights,
    NodeGains,
    NodeStep,
    gains_of,
)
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, Bool, Float, PyTree
from heliograph.simulation.centres.observation_model import SeparateObservations
from heliograph.simulation.mesh.late_and_quantized_messages import (
    ArrivingEstimates,
    MessagesOnTheWay,
    find_event_senders,
    gather_messages,
    step_messages_on_the_way,
)
from heliograph.simulation.mesh.neighbour_edges import MeshEdges
from heliograph.simulation.mesh.state_and_step import (
    Arrived,
    MeshState,
    MeshStep,
    NodeBucket,
    PrecomputedWeights,
    compute_information,
    propagate_joint,
    pull_to_neighbours,
    weigh_measurements,
    widen_for_events,
)


class Mesh(Module):
    """A fusion between neighbours: each step, every node fuses its neighbours' estimates and uses their measurements.

    Args:
        plant: the linear plant that all nodes estimate.
        buckets: the nodes, those of about as many neighbours together, so that little is padded.
        ranks: brings what the buckets give, one after another, into the order of the nodes.
        edges: by which messages arrive or get lost.
        observation_model: of the nodes' measurements.
        senders: numbers of the nodes of which each node receives (node, degree), itself first.
        indices: numbers in the mesh of the nodes of each group of the network that the mesh estimates at.
        nodes: their names.
        alpha: where nodes send on events, the threshold of `find_event_senders`.
        quantizer: of the estimates that are sent, stacked by node.
        needs_joint: whether the rule needs the joint covariance of all nodes' errors.
        claim: of the nodes' estimates.
    """

    plant: AnyPlant
    buckets: tuple[NodeBucket, ...]
    ranks: np.ndarray
    edges: MeshEdges
    observation_model: SeparateObservations
    senders: np.ndarray
    indices: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)
    alpha: np.ndarray | None
    quantizer: AbstractQuantizer | None
    needs_joint: bool = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    @property
    def has_long_step(self) -> bool:
        """Whether a step has more than MESH operations: too many to write out one by one as native code."""
        n = len(first(self.plant).states)
        # About n^2 operations for each message, and 2 N^2 for a joint covariance of N = (number of nodes) n numbers.
        messages = self.edges.rounds * int(np.count_nonzero(self.edges.present))
        size = len(self.senders) * n if self.needs_joint else 0
        return max(messages * n * n, 2 * size**2) > MESH

    def init(self) -> MeshState:
        """Return the state before the first step: the plant's mean and covariance at every node."""
        plant = at(self.plant, k=0)
        mean, covariance = jnp.asarray(plant.initial_mean), jnp.asarray(plant.initial_covariance)
        nodes, n = len(self.senders), len(mean)
        # Before any data all nodes have the same error, x_0 - E x_0.
        joint = jnp.broadcast_to(covariance[None, :, None], (nodes, n, nodes, n)) if self.needs_joint else None
        # With events all know the plant's mean, so that it stands for what each node received last.
        last_received = None if self.alpha is None else jnp.tile(mean, (*self.senders.shape, 1))
        way, ages = None, self.edges.past  # a row of messages for each age; none with a quantizer and no delay
        if ages or self.quantizer is not None:
            way = MessagesOnTheWay(jnp.tile(mean, (ages, nodes, 1)), jnp.tile(covariance, (ages, nodes, 1, 1)))
        return MeshState(
            mean=jnp.tile(mean, (nodes, 1)),
            covariance=jnp.tile(covariance, (nodes, 1, 1)),
            joint=joint,
            plant=(mean, covariance),
            sent=last_received,
            way=way,
        )

    def step(
        self, state: MeshState, z: Sequence[jax.Array], arrived: Arrived,
        u: jax.Array, k: jax.Array, precomputed: PrecomputedWeights = (),
    ) -> tuple[MeshState, tuple[Estimate, ...]]:  # fmt: skip
        """Exchange, fuse, predict and correct at step k: return the next state, and the estimates by group of nodes.

        The estimate xhat of a node, and xhat_j of its neighbours, become

          xhat+ = A xhat + b + sum_j M_j (xhat_j - xhat) + W (s - S (A xhat + b))

        with M_j = `gains.common_factor` `gains.neighbour_factors`, W = `gains.gain`; S = sum_j H_j' R_j^-1 H_j and
        s = sum_j H_j' R_j^-1 (z_j - offset_j) over the measurements that reach the node.

        Args:
            state: before the step.
            z: measurements (node, components) by group of nodes, NaN where one is missing.
            arrived: which messages arrive (node, rounds, degree); ages in steps, -1 of none, where they may be late.
            u, k: inputs of the plant over the step, and its number.
            precomputed: weights of this step by bucket, if they were computed before; else the rule computes them.
        """
        measured = jnp.concatenate([self._pad_to_longest(rows) for rows in z])[self.observation_model.order]
        present = ~jnp.isnan(measured)
        # Where messages may be late or quantized: which estimates arrive, and measurements with those sent just now.
        messages = self._gather_late_or_quantized(state, jnp.asarray(arrived))
        arrived = arrived if messages is None else messages.fresh
        # Weights and gains, none of which depends on the estimates.
        blocks = None if state.joint is None else blocks_of(state.joint, self.senders)
        step = self.compute_step_without_estimates(
            state.covariance, blocks, state.plant, present, arrived, u, k, precomputed, messages
        )
        # All rounds but the last only intersect: xhat_i + L_i sum_j D_ij (xhat_j - xhat_i).
        mean = state.mean
        for weights in step.exchanges:
            mean = mean + pull_to_neighbours(weights.common_factor, weights.neighbour_factors, mean, mean[self.senders])
        received = self._select_received_estimates(mean, state, jnp.asarray(arrived[:, -1]), messages)
        # Rows of `state` that only send, as those of a `NodeFilter`, end here: one row goes on for each node.
        mean = mean[self.senders[:, 0]]
        predicted = mean @ step.motion.matrix.T + step.motion.offset
        common = jnp.mean(predicted, axis=0)
        weighted = weigh_measurements(step.data, measured, present, common)
        innovation = self._compute_innovation(predicted, common, weighted, step, arrived)
        gains = step.gains
        pulled = pull_to_neighbours(gains.common_factor, gains.neighbour_factors, mean, received)
        mean = predicted + pulled + jnp.einsum("iab,ib->ia", gains.gain, innovation)
        # Covariance of all errors where the rule needs it; it is then what is claimed.
        joint = None
        if state.joint is not None:
            joint = propagate_joint(state.joint, step, arrived[:, -1], self.senders, self.edges.present)
        claimed = gains.covariance if joint is None else jnp.einsum("iaib->iab", joint)
        # What neighbours received last is predicted along, and messages go on towards them.
        last = None if state.sent is None else received @ step.motion.matrix.T + step.motion.offset
        way = None
        if messages is not None and state.way is not None:
            way = step_messages_on_the_way(messages, state.way, step.motion, common, weighted, step.data.information)
        after = MeshState(mean=mean, covariance=gains.covariance, joint=joint, plant=step.plant, sent=last, way=way)
        return after, self._split_by_group(mean, claimed)

    def _compute_innovation(
        self, predicted: jax.Array, common: jax.Array, weighted: jax.Array, step: MeshStep, arrived: Arrived
    ) -> Float[jax.Array, "node n"]:
        """Return s - S xb (node, n): what the measurements say beyond each node's predicted estimate xb (`predicted`).

        s = sum_j H_j' R_j^-1 (z_j - offset_j) over the measurements that reach the node, and S is `step.information`.
        It is computed as sum_j `weighted`_j - S (xb - m), with the terms H_j' R_j^-1 (z_j - offset_j - H_j m) and m =
        `common`, so that large means cost no digits.
        """
        sums = self._sum_over_reached_nodes(weighted, arrived)
        return sums - jnp.einsum("iab,ib->ia", step.information, predicted - common)

    def _gather_late_or_quantized(self, state: MeshState, arrived: jax.Array) -> ArrivingEstimates | None:
        """Return the estimates that arrive, if messages may be late or quantized; otherwise None.

        `state.way`: messages on the way, None if they all arrive unchanged at once or never. `arrived` (node, rounds,
        degree): whether a message arrives or, if messages may be late (`self.edges.past` > 0), its age in steps.
        """
        if state.way is None:
            return None
        ages = arrived if self.edges.past else jnp.where(arrived, 0, -1)  # 0: sent in this step, -1: no message
        return gather_messages(state.mean, state.covariance, state.way, self.quantizer, self.senders, ages)

    def _select_received_estimates(
        self, mean: jax.Array, state: MeshState, arrives: jax.Array, messages: ArrivingEstimates | None
    ) -> Float[jax.Array, "node degree n"]:
        """Return the estimate that each node uses of each neighbour: the present one, a late one, or the last received.

        Args:
            mean: estimates of the nodes now (node, n).
            state: before the step; with events, `state.sent` is what each node received last, predicted to this step.
            arrives: which messages arrive in the last round (node, degree).
            messages: late or quantized estimates that arrive; None where they are sent as they are.
        """
        if messages is not None:
            return messages.mean[messages.senders]
        present_estimates = mean[self.senders]
        if state.sent is None or self.alpha is None:
            return present_estimates
        # With events: a node sends if its estimate is further than `alpha` from what some neighbour received last.
        information = jax.vmap(invert_positive_definite)(state.covariance)[self.senders]
        are_sent = find_event_senders(
            self.alpha, present_estimates - state.sent, information, self.senders, self.edges.present
        )
        return jnp.where((arrives & are_sent[self.senders])[..., None], present_estimates, state.sent)

    def compute_step_without_estimates(
        self, covariance: Float[Array, "node n n"], blocks: Float[Array, "node degree n degree n"] | None,
        moments: tuple[Array, Array], measured: Bool[Array, "node m"], arrived: Arrived, u: Array, k: Array,
        precomputed: PrecomputedWeights = (), messages: ArrivingEstimates | None = None,
    ) -> MeshStep:  # fmt: skip
        """Return all of step k but the estimates: models, moments of the plant, weights and gains.

        Args:
            covariance: by which the nodes' estimates are weighed before the step.
            blocks: joint covariance of each neighbourhood's errors before it; None where the rule needs none.
            moments: mean (n,) and covariance (n, n) of the plant's state before it.
            measured: components of each node's measurement that are not missing.
            arrived: which messages arrive.
            u: inputs of the plant over the step.
            k: number of the step.
            precomputed: weights that were computed before, by bucket.
            messages: late or quantized estimates that arrive; None where they are sent as they are.
        """
        covariance, measured, arrived, u = (jnp.asarray(x) for x in (covariance, measured, arrived, u))
        blocks = None if blocks is None else jnp.asarray(blocks)
        # The plant over the step.
        plant: LinearPlant = at(self.plant, jnp.asarray(k))
        offset = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean()
        motion = Motion(jnp.asarray(plant.matrix), offset, plant.noise_covariance(u))
        mean_before, covariance_before = moments
        after = propagate_state(jnp.asarray(mean_before), jnp.asarray(covariance_before), motion)
        # Rounds before the last intersect estimates alone.
        exchanges = []
        for number in range(self.edges.rounds - 1):
            exchanges.append(self._map_nodes(_weigh_neighbours, covariance, None, arrived[:, number]))
            covariance = jnp.asarray(exchanges[-1].covariance)
        # Information that reaches each node from the measurements, and all that its neighbours could have measured.
        data = compute_information(self.observation_model.observe(*after, jnp.asarray(k)), measured)
        information = self._sum_over_reached_nodes(data.information, arrived)
        complete = self.sum_over_messages(data.complete, jnp.asarray(self.edges.present))
        # The last round fuses, predicts and corrects; late estimates are rows of their own beside the nodes'.
        arrives, senders = arrived[:, -1], None
        if messages is not None:
            covariance, senders, arrives = messages.covariance, messages.senders, messages.arrives[:, -1]
        gains = self.compute_gains(covariance, blocks, arrives, motion, information, complete, precomputed, senders)
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

    def _map_nodes(
        self,
        function: Callable[..., PyTree],
        covariance: jax.Array,
        blocks: jax.Array | None,
        present: jax.Array,
        *rest: jax.Array,
        precomputed: PrecomputedWeights = (),
        senders: Array | None = None,
    ) -> PyTree:
        """Return function(rule, estimates of the neighbours, *rest, precomputed) with a leading axis of nodes.

        Args:
            function: computation at one node; its result has a field `neighbour_factors`, one row for each message.
            covariance: of all estimates (row, n, n), one row for each node unless `senders` says otherwise.
            blocks: joint covariance of each neighbourhood (node, degree, n, degree, n); None where no rule needs it.
            present: which messages arrive (node, degree).
            *rest: further arguments, with a leading axis of nodes.
            precomputed: weights that were computed before, one for each bucket; () to compute them here.
            senders: row of `covariance` for each message that a node receives (node, degree); None for the graph's.
        """
        information, traces = jax.vmap(invert_positive_definite)(covariance), jnp.trace(covariance, axis1=1, axis2=2)
        # The axis of nodes is the last one of a rule's arrays, and the first one of all other arguments.
        over_nodes = eqx.filter_vmap(function, in_axes=(eqx.if_array(-1), *[0] * (2 + len(rest))))
        by_bucket = []  # nodes of about as many neighbours form a bucket, computed by one `vmap`
        for bucket, bucket_weights in zip(self.buckets, precomputed or [()] * len(self.buckets), strict=True):
            rows, width = bucket.rows, bucket.width
            # What these nodes received, without the padding beyond the bucket's width.
            sent_by = (self.senders if senders is None else senders)[rows, :width]
            received = NeighbourEstimates(
                covariance=covariance[sent_by[:, 0]],
                traces=traces[sent_by],
                information=information[sent_by],
                joint=None if blocks is None else blocks[rows, :width, :, :width],
                present=present[rows, :width],
            )
            if self.alpha is not None:
                received = widen_for_events(received, self.alpha)
            by_bucket.append(over_nodes(bucket.rule, received, *(leaf[rows] for leaf in rest), bucket_weights))
        if len(by_bucket) == 1:  # it has all nodes, in their order
            return by_bucket[0]
        # Pad the results to the same number of messages, and put them in the order of the nodes.
        degree = self.senders.shape[1]
        padded = [r._replace(neighbour_factors=_pad_to_degree(r.neighbour_factors, degree)) for r in by_bucket]
        return jax.tree.map(lambda *leaves: jnp.concatenate(leaves)[self.ranks], *padded)

    def _sum_over_reached_nodes(self, values: jax.Array, arrived: Arrived) -> jax.Array:
        """Return for each node the sum of `values` (node, ...) over all nodes that reach it in any round, each once."""
        if self.edges.rounds == 1:  # only a node's own senders can reach it
            return self.sum_over_messages(values, jnp.asarray(arrived[:, 0]))
        return jnp.tensordot(self.find_known_measurements(arrived).astype(values.dtype), values, 1)

    def find_known_measurements(self, arrived: Arrived) -> Bool[jax.Array, "node node"]:
        """Return which nodes' measurements (column) each node (row) has after all rounds, by the messages `arrived`."""
        has_measurement, arrived = jnp.eye(len(self.senders), dtype=bool), jnp.asarray(arrived)
        # In each round a node gets all measurements that the senders of its arriving messages had before the round.
        for round_number in range(self.edges.rounds):
            has_measurement = jnp.any(has_measurement[self.senders] & arrived[:, round_number, :, None], axis=1)
        return has_measurement

    def sum_over_messages(self, values: jax.Array, present: jax.Array) -> jax.Array:
        """Return for each node the sum of `values` (node, ...) over the senders whose messages are `present`."""
        # `present` and `self.senders` are (node, degree): the nodes that each node can receive.
        sums: jax.Array = jnp.einsum("id,id...->i...", present.astype(values.dtype), values[self.senders])
        return sums

    def compute_gains(
        self, covariance: jax.Array, blocks: jax.Array | None, present: jax.Array, motion: Motion,
        information: jax.Array, complete: jax.Array, precomputed: PrecomputedWeights = (),
        senders: Array | None = None,
    ) -> NodeGains:  # fmt: skip
        """Return the gains by which every node fuses, predicts and corrects, with a leading axis of nodes.

        A node fuses its own estimate with its neighbours' (weights by its rule of fusion), predicts the result, and
        corrects it by the measurements that reach it.

        Args:
            covariance: of all estimates before the step (row, n, n), one row for each node unless `senders` is given.
            blocks: joint covariance of each neighbourhood (node, degree, n, degree, n); None where no rule needs it.
            present: which messages arrive (node, degree).
            motion: the plant over the step: its matrix, offset, and noise covariance.
            information: sum of H_j' R_j^-1 H_j over the measurements that reach each node (node, n, n).
            complete: the same sum if none were missing (node, n, n).
            precomputed: weights computed before, by bucket; empty where the rule computes them.
            senders: row of `covariance` for each message that a node receives (node, degree); None for the graph's.
        """

        def compute_node_gains(
            rule: AbstractFusion,
            received: NeighbourEstimates,
            information: jax.Array,
            complete: jax.Array,
            node_weights: Sequence[jax.Array],
        ) -> NodeGains:
            """Return the gains of one node, by weights that were computed before if there are any, else by the rule."""
            step = NodeStep(motion.matrix, motion.noise, arrived=information, complete=complete)
            if node_weights:
                factors, fused_covariance = node_weights
                return gains_of(NeighbourWeights(jnp.eye(len(motion.offset)), factors, fused_covariance), step)
            return rule.neighbour_gains(received, step)

        gains: NodeGains = self._map_nodes(compute_node_gains, covariance, blocks, present, information, complete,
                                         precomputed=precomputed, senders=senders)  # fmt: skip
        return gains

    def compute_weights_of_steps(self, arrived: Bool[np.ndarray, "step node rounds degree"]) -> PrecomputedWeights:
        """Return frozen weights of many steps, with a leading axis of steps, for each bucket of nodes.

        Frozen weights depend on arrivals alone. The result is empty for other rules, and without native code for them.
        """
        weights = [bucket.rule.compute_weights_of_steps(arrived[:, bucket.rows, -1, : bucket.width])  # the last round
                 for bucket in self.buckets if isinstance(bucket.rule, FrozenWeights)]  # fmt: skip
        return () if None in weights else tuple(filter(None, weights))

    def _split_by_group(self, mean: jax.Array, covariance: jax.Array) -> tuple[Estimate, ...]:
        """Return the estimates (1, node, ...) of each group of nodes, from means and covariances in the mesh's order.

        `self.indices`: numbers of each group's nodes in the mesh. The first axis, of filters, has length 1.
        """
        groups = map(jnp.array, self.indices)
        return tuple(Estimate(mean[nodes][None], covariance[nodes][None], self.claim) for nodes in groups)


def _weigh_neighbours(rule: AbstractFusion, received: NeighbourEstimates, *_: PyTree) -> NeighbourWeights:
    """Return the weights by which a node only fuses the estimates that it received, and the covariance after it."""
    return rule.neighbour_weights(received)


def _pad_to_degree(factors: jax.Array, degree: int) -> Float[jax.Array, "node degree n *n"]:
    """Return the factors (node, message, ...) of each node's messages, padded with zeros to `degree` messages."""
    return jnp.pad(factors, ((0, 0), (0, degree - factors.shape[1]), *[(0, 0)] * (factors.ndim - 2)))
