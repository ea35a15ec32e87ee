"""Trees of relays over very many nodes that differ in numbers alone, at a cost linear in nodes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.smoother_step import gaussian_of
from heliograph.fusion.cross_covariance import ErrorSources, make_initial_factors
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
from heliograph.simulation.centres.fusion_centre import FusionCentre
from heliograph.simulation.centres.observation_model import (
    ObservationModel,
    SeparateObservations,
    compute_channel_moments,
)
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node
from heliograph.simulation.runs.stacked_filters import StackedFilters

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
        """Return the root's estimate (..., n) from the leaves' estimates (..., node, n) by filters of the true model.

        Raises:
            ValueError: the last two axes are not (number of leaves, n). Leading axes are free.
        """
        nodes, n, _ = self.covariances[0].shape  # of the lowest level, the leaves
        values = np.asarray(estimates, dtype=float)
        if values.shape[-2:] != (nodes, n):
            raise fail("estimates of the leaves", f"shape (..., {nodes}, {n})", f"shape {values.shape}")
        for weights in self.weights:  # (relay, n, child, n), level after level up to the root
            missing = len(weights) * self.degree - values.shape[-2]
            padded = np.pad(values, [(0, 0)] * (values.ndim - 2) + [(0, missing), (0, 0)])
            by_relay = padded.reshape(*padded.shape[:-2], len(weights), self.degree, n)
            values = np.einsum("raib,...rib->...ra", weights, by_relay)
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
    check_count("degree of a tree", degree, least=2)
    function("node", node, "the numbers of one leaf that returns a Node")
    count, steps = _count_leaves(numbers), check_count("horizon", horizon)
    with jax.enable_x64(True):
        # One leaf stands for the structure of all: a network of it is checked as one of all leaves would be.
        leaf = instance("leaf", node(_take_rows(numbers, 0)), Node, "a Node")
        if len(leaf.filters) != 1:
            raise fail("leaf", "a Node with one filter", f"{len(leaf.filters)} filters")
        (name,) = leaf.filters
        one_leaf = Network(plant, {"leaf": leaf}, {"all": Fusion(name, MatrixWeights())})
        one_leaf.check_horizon(steps)
        one_leaf.check_sends_each_step("covariances before data")
        one_leaf.check_sends_numbers("covariances before data")
        u = read_plant_inputs(one_leaf, inputs, steps)
        # Leaves in blocks of about BLOCK, each of them all leaves of some relays; of each block the covariances, the
        # weights, and the errors of the relays above.
        width = degree * max(BLOCK // degree, 1)
        blocks = [_take_rows(numbers, slice(i, i + width)) for i in range(0, count, width)]
        outputs = [to_numpy(_propagate_block(_Leaves(plant, name, node, degree), block, u)) for block in blocks]
        covariances, weights, relays = (list(leaves) for leaves in zip(*outputs, strict=True))
        # The relays' errors, level by level up to the root.
        level_covariances, level_weights = [np.concatenate(covariances)], [np.concatenate(weights)]
        errors = _join_blocks_of_relays(relays)
        while len(errors.independent) > 1:
            level_covariances.append(np.asarray(errors.covariances()))
            relay_weights, errors = _fuse_level_of_relays(errors, degree)
            level_weights.append(relay_weights)
        level_covariances.append(np.asarray(errors.covariances()))
    return RelayTree(
        degree=degree,
        claim=one_leaf.claims()[FUSED]["all"],
        covariances=tuple(level_covariances),
        weights=tuple(level_weights),
    )


class _Leaves(NamedTuple):
    """What the leaves of a tree have in common.

    Args:
        plant: that they estimate.
        filter: name of the filter that each has.
        node: makes a leaf from its numbers.
        degree: number of children of a relay.
    """

    plant: AnyPlant
    filter: str
    node: Callable[[object], Node]
    degree: int


@quickly_compiled
def _propagate_block(leaves: _Leaves, numbers: PyTree, u: np.ndarray) -> tuple[Array, Array, ErrorSources]:
    """Propagate the errors of a block of leaves (nodes with sensors) over all steps, and fuse them at their relays.

    Args:
        leaves: the plant, the filter's name, the function that makes a leaf, and the number of leaves of a relay
            (`degree`).
        numbers: arguments of that function, arrays with a leading axis of leaves.
        u: inputs of the plant (step, inputs).

    Returns:
        Covariances of the leaves' errors (leaf, n, n), weights of each relay for its children's estimates (relay, n,
        child, n), and the errors of the relays' fused estimates.
    """
    errors = _propagate_leaves(leaves, numbers, u)  # every array has a leading axis of leaves
    # A relay fuses the estimates of the next `degree` leaves. First all relays with `degree` children at once, then the
    # last relay if it has fewer; its weights are padded with 0 for the children that it lacks.
    count, degree = len(errors.independent), leaves.degree
    count_in_full = count - count % degree
    errors_by_relay = jax.tree.map(lambda a: a[:count_in_full].reshape(-1, degree, *a.shape[1:]), errors)
    weights, relay_errors = jax.vmap(_weigh_children)(errors_by_relay)
    if count > count_in_full:
        last_weights, last_error = _weigh_children(jax.tree.map(lambda a: a[count_in_full:], errors))
        last_weights = jnp.pad(last_weights, ((0, 0), (0, degree - last_weights.shape[1]), (0, 0)))
        weights = jnp.concatenate([weights, last_weights[None]])
        relay_errors = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), relay_errors, last_error)
    return errors.covariances(), weights, relay_errors


def _propagate_leaves(leaves: _Leaves, numbers: PyTree, u: np.ndarray) -> ErrorSources:
    """Return the errors of a block of leaves after all steps, as roots times shared sources and independent parts.

    In a tree of relays the leaves are nodes with filters, whose estimates relays fuse on the way to the root. The error
    of leaf i is root_i s + a_i: s are sources that all leaves share (x_0 and the plant's noise at each step), and a_i
    is independent, from its own measurements.

    Args:
        leaves: what all leaves have in common: plant, name of the filter, and a function that makes a leaf.
        numbers: numbers of each leaf, with a leading axis of leaves.
        u: inputs of the plant (step, inputs).
    """
    # All leaves of the block from their numbers, with their filters stacked, and a centre that propagates their errors;
    # it fuses nothing (no rules).
    nodes = eqx.filter_vmap(leaves.node)(numbers)
    count = len(jax.tree.leaves(numbers)[0])
    channels = eqx.filter_vmap(lambda values: compute_channel_moments(leaves.node(values).channel))(numbers)
    filters = nodes.filters[leaves.filter]
    stacked = StackedFilters(filters=filters, group=0, count=1, nodes=count)
    centre = FusionCentre(
        plant=leaves.plant,
        observation_model=SeparateObservations(
            (ObservationModel(nodes.sensor, channels),), np.arange(count), filters.received
        ),
        rules={},
        order=np.arange(count),
        sources=((0, 0),),
        size=filters.received,
        claim="exact",
    )
    # Errors by their sources, over the horizon. Covariances depend on no measurement: the filters are stepped with
    # measurements of zero.
    zeros = jnp.zeros((count, filters.received))
    states = stacked.init()
    n = len(first(leaves.plant).states)
    factors_before = make_initial_factors(centre.init([gaussian_of(states).mean]).errors, n * len(u))
    factors = centre.propagate_error_factors(
        (states, factors_before),
        compute_matrices=lambda before, u_k, k: stacked.compute_by_node(
            centre.compute_matrices, before, 0, zeros, u_k, k
        ),
        step_filters=lambda before, u_k, k: stacked.step(before, zeros, u_k, k)[0],
        u=u,
    )
    return factors.errors


def _fuse_level_of_relays(errors: ErrorSources, degree: int) -> tuple[np.ndarray, ErrorSources]:
    """Return the weights (relay, n, child, n) of one level of relays, and the errors of their estimates.

    `errors`: the errors of the nodes below, with a leading axis of nodes. Each relay fuses the next `degree` nodes, its
    children. The last relay may have fewer, and its weights are padded with zeros.
    """
    weights, relay_errors = [], []
    for start in range(0, len(errors.independent), degree):
        children = _take_rows(errors, slice(start, start + degree))
        relay_weights, relay_error = to_numpy(_fuse_at_relay(children))
        weights.append(_pad_to_degree(relay_weights, degree))
        relay_errors.append(relay_error)
    return np.stack(weights), jax.tree.map(lambda *leaves: np.stack(leaves), *relay_errors)


@quickly_compiled
def _fuse_at_relay(children: ErrorSources) -> tuple[jax.Array, ErrorSources]:
    """Return the weights of a relay for its children, and the error of its estimate: `_weigh_children`, compiled."""
    return _weigh_children(children)


def _weigh_children(children: ErrorSources) -> tuple[jax.Array, ErrorSources]:
    """Return the best weights (n, child, n) of the estimates of a relay's children, and the fused error.

    `children`: the errors of their estimates, as sources that they share and independent parts.
    """
    children = ErrorSources(*map(jnp.asarray, children))
    weights = matrix_weights(children.joint())
    return weights, ErrorSources(*children.weigh(weights))


def _join_blocks_of_relays(blocks: list[ErrorSources]) -> ErrorSources:
    """Return the errors of the relays above all blocks, one after another."""
    return ErrorSources(*(np.concatenate(leaves) for leaves in zip(*blocks, strict=True)))


def _pad_to_degree(weights: np.ndarray, degree: int) -> np.ndarray:
    """Return a relay's weights (n, child, n) with zeros for the children that it lacks."""
    return np.pad(weights, ((0, 0), (0, degree - weights.shape[1]), (0, 0)))


def _take_rows(numbers: PyTree, rows: int | slice) -> PyTree:
    """Return these rows of every array: of some leaves, or of one without the leading axis."""
    return jax.tree.map(lambda leaf: leaf[rows], numbers)


def _count_leaves(numbers: PyTree) -> int:
    """Return how many nodes the arrays have along their leading axis; raise ValueError if lengths differ or are 0."""
    # Lengths of all leading axes, None of a number without axes: there has to be one length, above 0.
    arrays = jax.tree.leaves(numbers)
    lengths = {np.shape(leaf)[0] if np.ndim(leaf) else None for leaf in arrays}
    if len(lengths) != 1 or None in lengths or 0 in lengths:
        raise fail("numbers of the leaves", "arrays with one leading axis of nodes", sorted(map(str, lengths)))
    return len(arrays[0])
