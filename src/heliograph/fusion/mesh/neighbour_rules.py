"""Rules of fusion for neighbours: cheap shares of intersection, fixed shares, and best weights that were frozen."""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.fusion.covariance_intersection import choose_shares_by_trace, intersection_weights
from heliograph.fusion.mesh.graph import Graph
from heliograph.fusion.mesh.node_gains import (
    NeighbourEstimates,
    NeighbourWeights,
    NodeGains,
    NodeStep,
    correct_by_information,
)
from heliograph.fusion.rules import AbstractFusion, AbstractIntersection, Covariances, Fused, Means
from heliograph.model.estimate import Claim
from heliograph.numerics.check import InputError, check_count, fail, scalar, table
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import Array, ArrayLike, Bool, Float

# Weights of many steps: the neighbours' factors D_j (step, row, ...) and fused covariances (step, row, n, n).
WeightsOfSteps = tuple[np.ndarray, np.ndarray]

SUM = 1e-9  # shares are decimal fractions, whose sum is 1 up to rounding


class TraceIntersection(AbstractIntersection):
    """Covariance intersection with shares from the traces: proportional to (tr P_j)^-power, or equal.

    Of the two the one whose fused covariance has the smaller trace: shares by trace alone ignore a neighbour of large
    variance who alone knows some state. Nothing is searched, so it costs little on thousands of nodes.

    Args:
        power: of the traces; 4 by default.
        improvements: steps of a multiplicative search from there towards the least trace; 0 by default.

    Claim: "upper", whatever the losses, as `CovarianceIntersection`.

    Source: Julier and Uhlmann (1997); Niehsen, Information fusion based on fast covariance intersection (2002).
    """

    power: float = eqx.field(static=True)
    improvements: int = eqx.field(static=True)

    def __init__(self, power: Float[ArrayLike, ""] = 4.0, improvements: int = 0):
        """Check and hold the power of the traces, and the number of steps of the search that begins there."""
        self.power = float(scalar("power of the traces", power, 0.0))
        self.improvements = check_count("improvements", improvements, 0)

    def weights_of(self, covariances: Covariances, information: Covariances) -> Float[jax.Array, " count"]:
        """Return the shares of several estimates, all of which are present.

        Shares are proportional to (tr P_j)^-`self.power`, and then improved `self.improvements` times.
        """
        traces = jnp.trace(covariances, axis1=1, axis2=2)
        estimates = NeighbourEstimates(
            covariance=covariances[0],  # "the node itself", of which shares by trace need no covariance
            traces=traces,
            information=information,
            joint=None,
            present=jnp.ones(len(covariances), dtype=bool),
        )
        shares, *_ = choose_shares_by_trace(estimates, self.power, self.improvements)
        return shares

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the weights of covariance intersection, with shares by the traces, of the estimates that arrived."""
        return intersection_weights(believed, choose_shares_by_trace(believed, self.power, self.improvements))


class _NeighbourRule(AbstractFusion):
    """Rule that fuses estimates of neighbours only, not at a fusion centre."""

    def claim(self, claims: list[Claim]) -> Claim:
        """Raise ValueError: the rule is for neighbours, and a fusion centre has none."""
        raise self._refuse_without_neighbours()

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Raise ValueError: the rule is for neighbours, and a fusion centre has none."""
        raise self._refuse_without_neighbours()

    def _refuse_without_neighbours(self) -> InputError:
        """Return the error that the rule is used at a fusion centre, where it needs neighbours."""
        return fail(f"fusion by {type(self).__name__}", "neighbours (Fusion(..., neighbours=...))", "a fusion centre")


class DiffusionWeights(_NeighbourRule):
    """Fixed shares c_ij of the neighbours' estimates: diffusion, whose gains do not depend on what arrives.

    xhat_i+ = A xhat_i + sum_j c_ij F_i A (xhat_j - xhat_i) + sum_j K_ij (z_j - H_j A xhat_i) over what arrived, with
    the gains K_ij and F_i of a filter at i that receives all its neighbours' measurements and no estimate.

    Args:
        shares: c_ij of each node's neighbours by name, {"a": {"b": .3, ...}, ...}, not negative, with what is left of 1
            for the node itself; by default equal shares of a node and all its neighbours.

    Claim: "exact" between neighbours, by the joint covariance of all errors; a fusion centre cannot use it.

    Raises:
        ValueError: negative shares, or a node whose shares sum to more than one.

    Source: Cattivelli and Sayed, Diffusion strategies for distributed Kalman filtering and smoothing (2010).
    """

    shares: Float[Array, "..."] | None
    given: dict[str, dict[str, float]] | None

    def __init__(self, shares: Mapping[str, Mapping[str, float]] | None = None):
        """Check and store the shares by node and sender; None: equal shares of a node and all its neighbours.

        They are stored by name in `self.given`. The array `self.shares` is None until `placed` knows the graph.
        """
        self.shares, self.given = None, None
        if shares is not None:
            rows = table("diffusion shares", shares, "shares by neighbour")
            self.given = {name: _check_shares(name, row) for name, row in rows.items()}

    @property
    def needs_joint(self) -> bool:
        """Always True: the fixed shares do not need it, but the errors' covariance comes from it."""
        return True

    def placed(self, graph: Graph) -> "DiffusionWeights":
        """Return the rule with the shares as an array (degree, row), from the shares by name or equal ones.

        A row of `graph.senders` lists a node, first, and its neighbours. The node's own share is set to zero: it is 1
        minus the neighbours' shares, and gains are computed for the neighbours alone.
        """
        if unknown := sorted(set(self.given or {}) - set(graph.nodes)):
            raise fail("diffusion shares", f"those of nodes of the fusion {list(graph.nodes)[:5]}", unknown)
        shares = np.where(graph.present, 1.0 / graph.present.sum(axis=1, keepdims=True), 0.0)
        # Shares by name, if there are any; a neighbour that is not named has none.
        for i, senders in enumerate(graph.senders if self.given is not None else ()):
            name, *neighbours = (graph.nodes[j] for j in senders[graph.present[i]])
            row = (self.given or {}).get(name, {})
            if unknown := sorted(set(row) - {name, *neighbours}):
                raise fail(f"diffusion shares of {name!r}", f"those of its neighbours {sorted(neighbours)}", unknown)
            shares[i, 1 : 1 + len(neighbours)] = [row.get(neighbour, 0.0) for neighbour in neighbours]
        shares[:, 0] = 0.0  # of the node itself
        placed: DiffusionWeights = eqx.tree_at(
            lambda r: (r.shares, r.given), self, (shares.T, None), is_leaf=lambda leaf: leaf is None
        )
        return placed

    def neighbour_gains(self, believed: NeighbourEstimates, step: NodeStep) -> NodeGains:
        """Return the gains of one node: M_ij = (I - P S) A c_ij of neighbour j's estimate, and P of the measurements.

        They are those of a filter that receives all its neighbours' measurements, whatever arrives: with the predicted
        covariance Pb and the information S = `step.complete`, P = (Pb^-1 + S)^-1. An estimate that did not arrive gets
        the gain 0. The measurements that arrived have the information `step.arrived`.
        """
        a = jnp.asarray(step.matrix)
        predicted = symmetrize(a @ believed.covariance @ a.T + step.noise)
        corrected, complete_correction_map = correct_by_information(predicted, jnp.asarray(step.complete))
        assert self.shares is not None
        shares = jnp.where(believed.present, jnp.asarray(self.shares), 0.0)
        # M_ij = (I - P S) A c_ij; what the correction leaves of an error is I - P S_arrived.
        return NodeGains(
            common_factor=complete_correction_map @ a,
            neighbour_factors=shares[:, None] * jnp.ones(len(a)),
            gain=corrected,
            correction_map=jnp.eye(len(a)) - corrected @ step.arrived,
            covariance=corrected,
        )


class FrozenWeights(_NeighbourRule):
    """Best weights for joint covariances of each neighbourhood that do not move: means over losses in the steady state.

    `freeze` makes it. Weights are solved for what arrived at each step, from these blocks alone.

    Args:
        rule: the rule of best weights.
        blocks: joint covariances (node, degree, n, degree, n) of each node and its neighbours, itself first.

    Claim: "nominal": the blocks are means over drawn losses, of the steady state.
    """

    rule: AbstractFusion
    blocks: Float[Array, "..."]

    def placed(self, graph: Graph) -> "FrozenWeights":
        """Return the rule with the blocks (degree, n, degree, n, row) of the graph's rows.

        A block is the joint covariance of a node and its neighbours. Blocks were given as (nodes, degree, n, degree,
        n); here the axis of rows is last.
        """
        width = graph.senders.shape[1]
        if len(self.blocks) != len(graph.nodes) or np.shape(self.blocks)[1] < width:
            raise fail("frozen weights", f"blocks of {len(graph.nodes)} nodes and {width} of each or more",
                       f"shape {np.shape(self.blocks)}")  # fmt: skip
        blocks = np.asarray(self.blocks)[graph.senders[:, 0], :width, :, :width]
        return FrozenWeights(self.rule, np.ascontiguousarray(np.moveaxis(blocks, 0, -1)))

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the weights of what arrived, and the covariance that the blocks give them."""
        return self.rule.neighbour_weights(believed._replace(joint=jnp.asarray(self.blocks)))

    def compute_weights_of_steps(self, arrived: Bool[np.ndarray, "step row degree"]) -> WeightsOfSteps | None:
        """Return weights and fused covariances (step, row, ...) of many steps, by native code; None if there is none.

        Weights depend on nothing but what arrives at a step (`arrived`) and the frozen blocks (`self.blocks`: joint
        covariances of each node and its neighbours, nodes along the last axis). So all steps of a node are computed
        at once, and its block is read once.
        """
        blocks_by_row = np.moveaxis(np.asarray(self.blocks), -1, 0)
        arrived_by_row = np.swapaxes(arrived, 0, 1)
        with jax.enable_x64(True):
            # The native code runs once for each row, as it does elsewhere for each run; the rule is the same in all.
            choice = choose_code(
                _weigh_neighbours, (self.rule, blocks_by_row, arrived_by_row), differs_by_run=(False, True, True)
            )
            if choice.code is None:
                return None
            weights: WeightsOfSteps = jax.tree.map(lambda leaf: np.swapaxes(leaf, 0, 1), choice.results())
            return weights


def _weigh_neighbours(
    rule: AbstractFusion, joint: Float[jax.Array, "degree n degree n"], arrived: Bool[jax.Array, "step degree"]
) -> tuple[jax.Array, jax.Array]:
    """Return the neighbours' factors and fused covariances (step, ...) of one node's weights for many steps.

    `joint`: Cov(e_i, e_j) of the node and its neighbours. `arrived`: which estimates came at each step.
    """
    degree, n = joint.shape[:2]
    # Rules of best weights only read the joint covariance, so that the other fields are zeros.
    believed = NeighbourEstimates(jnp.zeros((n, n)), jnp.zeros(degree), jnp.zeros((degree, n, n)), joint, arrived[0])

    def body(_: None, present: jax.Array) -> tuple[None, tuple[jax.Array, jax.Array]]:
        """Return no carry, and the neighbours' factors and fused covariance for what arrived in one step."""
        weights = rule.neighbour_weights(believed._replace(present=present))
        return None, (weights.neighbour_factors, weights.covariance)

    return jax.lax.scan(body, None, arrived)[1]


def _check_shares(name: str, row: object) -> dict[str, float]:
    """Return the shares that a node gives to others by name; raise ValueError unless they are valid.

    Shares are not negative. Their sum is at most 1, and it is 1 if the node's own share is among them.
    """
    what = f"diffusion shares of {name!r}"
    unchecked = table(what, row, "shares by neighbour")
    shares = {sender: float(scalar(what, share, 0.0)) for sender, share in unchecked.items()}
    total = sum(shares.values())
    if total > 1 + SUM or (name in shares and total < 1 - SUM):  # SUM: rounding
        raise fail(what, "shares that sum to 1", f"{total:g}")
    return shares
