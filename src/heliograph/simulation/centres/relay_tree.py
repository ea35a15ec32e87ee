"""Trees of relays over very many nodes that differ in numbers alone, at a cost linear in nodes."""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.smoother_step import gaussian_of
from heliograph.fusion.cross_covariance import ErrorSources, initial_factors
from heliograph.fusion.joint_covariance_fusion import MatrixWeights
from heliograph.fusion.joint_covariance_weights import matrix_weights
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.numerics.check import check_count, fail, function, instance
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.centres.centre import FusionCentre
from heliograph.simulation.centres.observation_model import Apart, ObservationModel, describe_channel
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node
from heliograph.simulation.runs.side_by_side import StackedFilters

BLOCK = 1000  # nodes that are followed together


@readable
@dataclass(frozen=True)
class RelayTree:
    """A tree whose leaves are filters, whose relays forward the matrix-weighted estimate of those below, to a root.

    Relay r receives the children r d, ..., r d + d - 1 of the level below, d the degree.

    Args:
        degree: number d of children of a relay.
        claim: claim of the fused covariances.
        covariances: of the errors at each level, from the leaves (nodes, n, n) to the root (1, n, n).
        weights: of each level above the leaves, (relay, n, child, n), zero for children that the last relay lacks.
    """

    degree: int
    claim: Claim
    covariances: tuple[Float[np.ndarray, "node n n"], ...]
    weights: tuple[Float[np.ndarray, "relay n child n"], ...]

    @property
    def root(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the root's error."""
        return np.asarray(self.covariances[-1][0])

    def fused(self, estimates: ArrayLike) -> Float[np.ndarray, "... n"]:
        """Estimate of the root from those of the leaves, (..., node, n), for filters whose model is the world.

        Raises:
            ValueError: another number of estimates than of leaves; leading axes are free.
        """
        nodes, n, _ = self.covariances[0].shape
        values = np.asarray(estimates, dtype=float)
        if values.shape[-2:] != (nodes, n):
            raise fail("estimates of the leaves", f"shape (..., {nodes}, {n})", f"shape {values.shape}")
        for weights in self.weights:
            lacking = len(weights) * self.degree - values.shape[-2]
            filled = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(0, lacking), (0, 0)])
            apart = filled.reshape(*filled.shape[:-2], len(weights), self.degree, n)
            values = np.einsum("raib,...rib->...ra", weights, apart)
        return np.asarray(values[..., 0, :])


def relay_tree(
    plant: AnyPlant,
    node: Callable[[PyTree], Node],
    numbers: PyTree,
    degree: int,
    horizon: int,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> RelayTree:
    """Return the covariances and weights of a tree of relays after `horizon` steps of complete data, before any data.

    Time and memory are linear in leaves.

    Args:
        plant: a linear plant.
        node: `node(one)` makes a leaf, a `Node` with one linear filter of the plant, from its numbers; traced by JAX.
        numbers: numbers of all leaves, with a leading axis.
        degree: number of neighbours of the level below that a relay receives (the last one may have fewer), from 2. It
            forwards their matrix-weighted estimate.
        horizon: number of steps.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Claim: "exact"; "nominal" where probabilities are uncertain.

    Raises:
        ValueError: numbers without a common leading axis, a degree below two, leaves that fusion refuses.

    Source: Bar-Shalom, On the track-to-track correlation problem (1981), with the second moments of random gains.
    """
    check_count("degree of a tree", degree, 2)
    function("node", node, "the numbers of one leaf that returns a Node")
    count, steps = _count_leaves(numbers), check_count("horizon", horizon)
    with jax.enable_x64(True):
        # One leaf stands for the structure of all.
        leaf = instance("leaf", node(_slice(numbers, 0)), Node, "a Node")
        if len(leaf.filters) != 1:
            raise fail("leaf", "a Node with one filter", f"{len(leaf.filters)} filters")
        (name,) = leaf.filters
        alone = Network(plant, {"leaf": leaf}, {"all": Fusion(name, MatrixWeights())})
        alone.check_horizon(steps)
        u = read_plant_inputs(alone, inputs, steps)
        # Leaves in blocks, whole relays each: covariances, weights, and the relays as nodes.
        width = degree * max(BLOCK // degree, 1)
        blocks = [_slice(numbers, slice(i, i + width)) for i in range(0, count, width)]
        block_results = [to_numpy(_propagate_leaves((plant, name, node, degree), block, u)) for block in blocks]
        covariances, weights, level = (list(leaves) for leaves in zip(*block_results, strict=True))
        level_covariances, used, shared = [np.concatenate(covariances)], [np.concatenate(weights)], _join_blocks(level)
        # ErrorSources by level up to the root.
        while True:
            level_covariances.append(np.asarray(shared.covariances()))
            if len(level_covariances[-1]) == 1:
                return RelayTree(degree, alone.claims()[FUSED]["all"], tuple(level_covariances), tuple(used))
            groups = [_slice(shared, slice(i, i + degree)) for i in range(0, len(level_covariances[-1]), degree)]
            outputs = [to_numpy(_relay(group)) for group in groups]
            used.append(np.stack([_pad_to_degree(relay_weights, degree) for relay_weights, _ in outputs]))
            shared = jax.tree.map(lambda *leaves: np.stack(leaves), *(relay for _, relay in outputs))


@quickly_compiled
def _propagate_leaves(
    leaf: tuple[AnyPlant, str, Callable[[object], Node], int], numbers: PyTree, u: np.ndarray
) -> tuple[Array, Array, ErrorSources]:
    """Propagate the leaves of one block over all steps.

    Returns: covariances of the leaves' errors (leaf, n, n), weights of the relays above them, and the relays' errors.
    """
    plant, name, node, degree = leaf
    # All leaves of the block from their numbers.
    nodes = eqx.filter_vmap(node)(numbers)
    count = len(jax.tree.leaves(numbers)[0])
    channels = eqx.filter_vmap(lambda values: describe_channel(node(values).channel))(numbers)
    alike = StackedFilters(nodes.filters[name], 0, 1, count)
    size = nodes.filters[name].received
    centre = FusionCentre(
        plant=plant,
        observation_model=Apart((ObservationModel(nodes.sensor, channels),), np.arange(count), size),
        rules={},
        order=np.arange(count),
        sources=((0, 0),),
        size=size,
        claim="exact",
    )
    zeros = jnp.zeros((count, size))  # measurements: covariances depend on none

    # Errors by their sources, over the horizon.
    state = alike.init()
    n = len(first(plant).states)
    begin = initial_factors(centre.init([gaussian_of(state).mean]).errors, n * len(u))
    factors = centre.factors(
        (state, begin),
        lambda states, u_k, k: alike.matrices(centre.read, states, 0, zeros, u_k, k),
        lambda states, u_k, k: alike.step(states, zeros, u_k, k)[0],
        u,
    )
    level = factors.errors
    # Full relays at once, then the last one.
    full = count - count % degree
    weights, above = jax.vmap(_fuse)(jax.tree.map(lambda a: a[:full].reshape(-1, degree, *a.shape[1:]), level))
    if count > full:
        last, rest = _fuse(jax.tree.map(lambda a: a[full:], level))
        last = jnp.pad(last, ((0, 0), (0, degree - last.shape[1]), (0, 0)))
        weights = jnp.concatenate([weights, last[None]])
        above = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), above, rest)
    return level.covariances(), weights, above


@quickly_compiled
def _relay(children: ErrorSources) -> tuple[jax.Array, ErrorSources]:
    """Return the weights of a relay for its children, and the error of its estimate."""
    return _fuse(children)


def _fuse(children: ErrorSources) -> tuple[jax.Array, ErrorSources]:
    """Return the best weights (n, child, n) of these children, and the error of their weighted estimate."""
    children = ErrorSources(*map(jnp.asarray, children))
    weights = matrix_weights(children.joint())
    return weights, ErrorSources(*children.weigh(weights))


def _join_blocks(blocks: list[ErrorSources]) -> ErrorSources:
    """Return the errors of the relays above all blocks, one after another."""
    return ErrorSources(*(np.concatenate(leaves) for leaves in zip(*blocks, strict=True)))


def _pad_to_degree(weights: np.ndarray, degree: int) -> np.ndarray:
    """Return a relay's weights (n, child, n) with zeros for the children that it lacks."""
    return np.pad(weights, ((0, 0), (0, degree - weights.shape[1]), (0, 0)))


def _slice(numbers: PyTree, rows: int | slice) -> PyTree:
    """Return some rows of every array."""
    return jax.tree.map(lambda leaf: leaf[rows], numbers)


def _count_leaves(numbers: PyTree) -> int:
    """Return how many nodes the arrays have along their leading axis; raise if they differ."""
    lengths = {np.shape(leaf)[0] if np.ndim(leaf) else None for leaf in jax.tree.leaves(numbers)}
    if len(lengths) != 1 or lengths & {None, 0}:
        raise fail("numbers of the leaves", "arrays with one leading axis of nodes", sorted(map(str, lengths)))
    return len(jax.tree.leaves(numbers)[0])
