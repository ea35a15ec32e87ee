"""Fusion between neighbours inside a step: every node fuses what arrived, predicts once, and corrects."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.cross_covariance import Motion, Observation, moved_state
from heliograph.fusion.intersection import inverse
from heliograph.fusion.mesh.gains import Believed, Gains, Step
from heliograph.fusion.mesh.graph import graph_of
from heliograph.fusion.rules import AbstractFusion, Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.module import Module
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import diagonal, solve, times, times_vector, transpose
from heliograph.numerics.types import Bool, Float
from heliograph.simulation.centres.centre import Listening, listening
from heliograph.simulation.centres.edges import Edges, edges_of
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


Arrived = Bool[jax.Array, "node rounds degree"]  # which messages arrived, each node's from itself first


class MeshState(NamedTuple):
    """Estimates of all nodes, the covariances by which they weigh, and what is known before any data.

    Shapes: mean (node, n), covariance (node, n, n); joint (node, n, node, n) covariance of all errors, None where the
    rule does without; plant: mean (n,) and covariance (n, n) of the state.
    """

    mean: Float[jax.Array, "node n"]
    covariance: Float[jax.Array, "node n n"]
    joint: Float[jax.Array, "node n node n"] | None
    plant: tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]


class Data(NamedTuple):
    """Messages about one step's measurements: S_j = H_j' R_j^-1 H_j and H_j' R_j^-1 (z_j - H_j x) about a common x.

    Shapes: information (node, n, n), innovation (node, n).
    """

    information: Float[jax.Array, "node n n"]
    innovation: Float[jax.Array, "node n"]


class Mesh(Module):
    """A fusion between neighbours: the graph, its edges, the rule placed on it, and models of the measurements.

    `groups`: models of the measurements of the network's groups of nodes, None for nodes without a sensor; `order`
    brings the nodes of all groups into the order of the mesh, `places` the mesh into that of the groups again.
    """

    plant: AnyPlant
    rule: AbstractFusion
    edges: Edges
    groups: tuple[Listening | None, ...]
    senders: np.ndarray
    order: np.ndarray
    counts: tuple[int, ...] = eqx.field(static=True)
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    def init(self) -> MeshState:
        """Return the state before the first step: the plant's mean and covariance at every node."""
        plant = at(self.plant, 0)
        mean, covariance = jnp.asarray(plant.initial_mean), jnp.asarray(plant.initial_covariance)
        nodes, n = len(self.senders), len(mean)
        joint = jnp.broadcast_to(covariance[None, :, None], (nodes, n, nodes, n)) if self.rule.needs_joint else None
        return MeshState(jnp.tile(mean, (nodes, 1)), jnp.tile(covariance, (nodes, 1, 1)), joint, (mean, covariance))

    def step(
        self, state: MeshState, z: Sequence[jax.Array], arrived: Arrived,
        u: jax.Array, k: jax.Array,
    ) -> tuple[MeshState, tuple[Estimate, ...]]:  # fmt: skip
        """Exchange, fuse, predict and correct at step k: next state, and estimates (1, node, ...) by group of nodes."""
        # Plant and measurement models of this step.
        plant: LinearPlant = at(self.plant, k)
        shift = jnp.asarray(plant.input_matrix) @ u + plant.noise_mean()
        motion = Motion(jnp.asarray(plant.matrix), shift, plant.noise_covariance(u))
        moments = moved_state(*state.plant, motion)
        # All rounds but the last only intersect.
        mean, covariance = state.mean, state.covariance
        for number in range(self.edges.rounds - 1):
            mean, covariance = self._exchanged(mean, covariance, arrived[:, number])
        predicted = mean @ motion.matrix.T + motion.shift
        common = jnp.mean(predicted, axis=0)
        data, complete = self.data(z, common, moments, k)
        # What each node learns of the measurements, and its gains.
        information, innovation = self._collected(data, arrived)
        total = self._sum_of(complete.information, jnp.asarray(self.edges.present))
        gains = self._gains(MeshState(mean, covariance, state.joint, state.plant), arrived[:, -1], motion, information,
                            total)  # fmt: skip
        # xhat+ = A xhat + b + sum M_j (xhat_j - xhat) + W (s - S (A xhat + b)).
        others = jnp.einsum("idab,idb->ia", gains.transition, mean[self.senders] - mean[:, None])
        off = innovation - jnp.einsum("iab,ib->ia", information, predicted - common)
        mean = predicted + others + jnp.einsum("iab,ib->ia", gains.gain, off)
        joint = None if state.joint is None else self._moved(state.joint, gains, motion, data, arrived[:, -1])
        claimed = gains.covariance if joint is None else jnp.einsum("iaib->iab", joint)
        return MeshState(mean, gains.covariance, joint, moments), self._by_group(mean, claimed)

    def data(
        self, z: Sequence[jax.Array], common: jax.Array, moments: tuple[jax.Array, jax.Array], k: jax.Array
    ) -> tuple[Data, Data]:
        """Messages about what was measured, and about what all nodes would say if no component were missing."""
        observation = self.observe(moments, k)
        rows = [jnp.pad(part, ((0, 0), (0, self.size - part.shape[1])), constant_values=jnp.nan) for part in z]
        values = jnp.concatenate(rows)[self.order]
        there = jnp.any(observation.gain != 0, axis=-1) | (jnp.einsum("imm->im", observation.noise) > 0)
        off = values - observation.offset - observation.gain @ common
        both = [jax.vmap(_message)(observation.gain, observation.noise, jnp.where(used, off, 0.0), used)
                for used in (there & ~jnp.isnan(values), there)]  # fmt: skip
        return Data(*both[0]), Data(*both[1])

    def observe(self, moments: tuple[jax.Array, jax.Array], k: jax.Array) -> Observation:
        """Measurement models of all nodes at step k, rows of zeros where a node has none."""
        n = len(moments[0])
        parts = []
        for group, count in zip(self.groups, self.counts, strict=True):
            shapes = (count, self.size, n), (count, self.size), (count, self.size, self.size)
            none = Observation(*(jnp.zeros(shape) for shape in shapes))
            parts.append(none if group is None else group.observe(*moments, k, self.size))
        return Observation(*(jnp.concatenate(leaves)[self.order] for leaves in zip(*parts, strict=True)))

    def _exchanged(self, mean: jax.Array, covariance: jax.Array, present: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Intersect once with the neighbours' estimates."""
        believed = self._believed(covariance, None, present)
        weights, fused = eqx.filter_vmap(lambda rule, item: rule.neighbour_weights(item),
                                         in_axes=(eqx.if_array(0), 0))(self.rule, believed)  # fmt: skip
        return mean + jnp.einsum("idab,idb->ia", weights, mean[self.senders] - mean[:, None]), fused

    def _believed(self, covariance: jax.Array, joint: jax.Array | None, present: jax.Array) -> Believed:
        information = jax.vmap(inverse)(covariance)
        block = None
        if joint is not None:
            rows, columns = self.senders[:, :, None], self.senders[:, None]
            block = jnp.moveaxis(joint[rows, :, columns, :], 3, 2)
        return Believed(covariance[self.senders], information[self.senders], block, present)

    def _collected(self, data: Data, arrived: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Sums of the measurements' messages that each node has after all rounds, each counted once."""
        if self.edges.rounds == 1:
            return self._sum_of(data.information, arrived[:, 0]), self._sum_of(data.innovation, arrived[:, 0])
        known = jnp.eye(len(self.senders), dtype=bool)
        for number in range(self.edges.rounds):
            known = jnp.any(known[self.senders] & arrived[:, number, :, None], axis=1)
        counted = known.astype(data.innovation.dtype)
        return jnp.tensordot(counted, data.information, 1), counted @ data.innovation

    def _sum_of(self, values: jax.Array, present: jax.Array) -> jax.Array:
        """Sum over what arrived of values by node."""
        result: jax.Array = jnp.einsum("id,id...->i...", present.astype(values.dtype), values[self.senders])
        return result

    def _gains(
        self, state: MeshState, present: jax.Array, motion: Motion, information: jax.Array, complete: jax.Array
    ) -> Gains:
        """Gains of all nodes."""
        believed = self._believed(state.covariance, state.joint, present)

        def single(rule: AbstractFusion, item: Believed, arrived: jax.Array, all_of_them: jax.Array) -> Gains:
            return rule.neighbour_gains(item, Step(motion.matrix, motion.noise, arrived, all_of_them))

        both = eqx.filter_vmap(single, in_axes=(eqx.if_array(0), 0, 0, 0))
        result: Gains = both(self.rule, believed, information, complete)
        return result

    def _moved(
        self, joint: jax.Array, gains: Gains, motion: Motion, data: Data, present: jax.Array
    ) -> Float[jax.Array, "node n node n"]:
        """J+ = M J M' + F Q F' + sum_l K_l R_l K_l', with K_il = W_i H_l' R_l^-1."""
        nodes, n = len(self.senders), len(motion.shift)
        itself = gains.innovation @ motion.matrix - gains.transition.sum(axis=1)
        m = self._spread(gains.transition.at[:, 0].set(itself))
        k = self._spread(jnp.where(present[:, :, None, None], gains.gain[:, None], 0.0))
        f = gains.innovation.reshape(nodes * n, n)
        weighted = jnp.einsum("ajb,jbc->ajc", k.reshape(nodes * n, nodes, n), data.information).reshape(k.shape)
        result = m @ joint.reshape(m.shape) @ m.T + f @ motion.noise @ f.T + weighted @ k.T
        return symmetrize(result).reshape(nodes, n, nodes, n)

    def _spread(self, blocks: Float[jax.Array, "node degree n n"]) -> Float[jax.Array, "N N"]:
        """Matrix of all nodes with these blocks; padding adds nothing."""
        nodes, _, n, _ = blocks.shape
        held = jnp.where(jnp.asarray(self.edges.present)[:, :, None, None], blocks, 0.0)
        rows = jnp.arange(nodes)[:, None]
        empty = jnp.zeros((nodes, nodes, n, n))
        return empty.at[rows, self.senders].add(held).swapaxes(1, 2).reshape(nodes * n, nodes * n)

    def _by_group(self, mean: jax.Array, covariance: jax.Array) -> tuple[Estimate, ...]:
        """Estimates (1, node, ...) of the mesh's nodes in each of the network's groups."""
        return tuple(
            Estimate(mean[jnp.array(rows)][None], covariance[jnp.array(rows)][None], self.claim) for rows in self.places
        )


@runs_last
def _message(
    gain: jax.Array, noise: jax.Array, off: jax.Array, used: jax.Array
) -> tuple[Float[jax.Array, "n n *#runs"], Float[jax.Array, "n *#runs"]]:
    """S = H' R^-1 H and H' R^-1 off of the components that are used."""
    there = used.astype(gain.dtype)
    h = there[:, None] * gain
    r = there[:, None] * noise * there[None] + diagonal(1 - there)
    weighted = transpose(solve(r, h))
    return times(weighted, h), times_vector(weighted, off)


def mesh_of(network: Network, name: str) -> Mesh:
    """Build the fusion `name` between neighbours of a network."""
    fusion = network.meshes[name]
    assert fusion.neighbours is not None
    nodes = network.mesh_nodes(name)
    graph = graph_of(fusion.neighbours, nodes)
    # Models of the measurements, group after group.
    place = {node: i for i, node in enumerate(nodes)}
    groups: list[Listening | None] = []
    order: dict[str, int] = {}
    for names in network.groups:
        sensors = [node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)]
        groups.append(listening([n.sensor for n in sensors], [n.channel for n in sensors]) if sensors else None)
        order |= {node: len(order) + i for i, node in enumerate(names)}
    kinds = [kind for kind in network.mesh_kinds if kind.filters == (name,)]
    mine = [tuple(place[node] for node in network.groups[kind.group]) for kind in kinds]
    return Mesh(
        plant=network.plant,
        rule=fusion.rule.placed(graph),
        edges=edges_of(fusion, graph),
        groups=tuple(groups),
        senders=graph.senders,
        order=np.array([order[node] for node in nodes]),
        counts=tuple(len(names) for names in network.groups),
        places=tuple(mine),
        nodes=graph.nodes,
        size=max(1, *(node.received for node in network.nodes.values())),
        claim=network.claims()[nodes[0]][name],
    )


def meshes_of(network: Network) -> dict[str, Mesh]:
    """Fusions between neighbours, by name."""
    return {name: mesh_of(network, name) for name in network.meshes}
