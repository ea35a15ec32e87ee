"""Fusion of estimates with unknown cross-correlations: covariance intersection and its relatives."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.fusion.covariance_intersection import (
    choose_shares_by_trace,
    equal_shares,
    intersect_covariances,
    intersect_inverse_covariances,
    intersection_weights,
    invert_covariances,
    restore_exact_components,
    trace_optimal_weights,
)
from heliograph.fusion.mesh.graph import Graph
from heliograph.fusion.mesh.node_gains import NeighbourEstimates, NeighbourWeights, NodeGains, NodeStep, gains_of
from heliograph.model.estimate import Claim, Estimate, weakest
from heliograph.model.plant import AnyPlant, read_manifold
from heliograph.numerics.angles.angle import wrap_angles, wrap_near
from heliograph.numerics.check import (
    array,
    fail,
    instance,
    items,
    probabilities,
)
from heliograph.numerics.masked_arrays import fill_masked
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.types import Array, ArrayLike, Float

Means = Float[jax.Array, "count n"]
Covariances = Float[jax.Array, "count n n"]
Fused = tuple[Float[jax.Array, "n"], Float[jax.Array, "n n"]]

POWER = 4.0  # shares between neighbours start in proportion to (tr P_j)^-POWER
IMPROVEMENTS = 8  # steps that improve these shares: the trace is then mostly within 1 % of its minimum


@readable
class AbstractFusion(Module):
    """Rule that fuses several estimates of one state.

    A fused claim is never stronger than the weakest of its inputs; what else a rule assumes is in `claim`.
    """

    @property
    def uses_reports(self) -> bool:
        """True if it uses reports that fade, are late, or never arrive."""
        return False

    def check(self, count: int) -> None:
        """Raise ValueError if the rule cannot fuse this number of estimates; by default it can fuse any number."""

    def claim(self, claims: list[Claim]) -> Claim:
        """Return what the fused covariance is said to be ("exact", "upper", "nominal"), from the inputs' claims."""
        raise unwritten(self, "claim")

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Return fused mean (n,) and covariance (n, n) of means (count, n) and covariances (count, n, n)."""
        raise unwritten(self, "combine")

    @property
    def between_neighbours(self) -> bool:
        """True if the rule can fuse estimates from neighbours: if its class defines weights or gains of neighbours."""
        own, base = type(self), AbstractFusion
        has_own_weights = own.neighbour_weights != base.neighbour_weights
        has_own_gains = own.neighbour_gains != base.neighbour_gains
        return has_own_weights or has_own_gains

    @property
    def needs_joint(self) -> bool:
        """True if it needs the joint covariance of all nodes' errors, or claims by it."""
        return False

    def placed(self, graph: Graph) -> "AbstractFusion":
        """Return the rule for the nodes of a graph: with arrays whose last axis is the node, where nodes differ.

        By default a rule is the same for all nodes.
        """
        return self

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the weights of the neighbours' estimates that arrived, and the fused covariance.

        Raises:
            ValueError: always here; a rule that can fuse between neighbours defines it.
        """
        raise fail("fusion between neighbours", "a rule such as CovarianceIntersection() or MatrixWeights()",
                   type(self).__name__)  # fmt: skip

    def neighbour_gains(self, believed: NeighbourEstimates, step: NodeStep) -> NodeGains:
        """Return the gains of one node's step: fuse the neighbours' estimates, predict once, correct with measurements.

        `believed`: covariances of the estimates, and which arrived. `step`: model of the plant and information of the
        measurements that arrived.
        """
        return gains_of(self.neighbour_weights(believed), step)


def fuse(rule: AbstractFusion, estimates: list[Estimate], angles: "Sequence[int] | AnyPlant" = ()) -> Estimate:
    """Fuse estimates of one state; leading axes (run, time) are carried along.

    Args:
        rule: the fusion rule, such as `CovarianceIntersection()`.
        estimates: estimates of one state, with means (..., n) and covariances (..., n, n).
        angles: indices of the states that are angles, or the plant, which knows them; none by default.

    Returns:
        The fused mean and covariance, with the claim (exact, upper bound or nominal) that the rule gives them.

    Raises:
        ValueError: no estimates, estimates of different state dimensions, angles that are no indices in the state.

    Source: cubature fusion under amplify-and-forward relays, equation (8).
    """
    instance("fusion rule", rule, AbstractFusion, "one such as CovarianceIntersection()")
    for estimate in (estimates := items("fusion", estimates, "estimates")):
        instance("fusion", estimate, Estimate, "estimates")
    if not estimates or len({np.shape(e.mean) for e in estimates}) != 1:
        raise fail("fusion", "estimates of one state dimension", [np.shape(e.mean) for e in estimates])
    rule.check(len(estimates))
    # Angles within half a turn of those of the first estimate.
    means = np.stack([np.asarray(fill_masked(e.mean)) for e in estimates], axis=-2)
    indices, attitude = read_manifold(angles, means.shape[-1])
    if attitude or any(estimate.attitude for estimate in estimates):
        raise fail("fusion", "estimates without attitudes", [estimate.attitude or attitude for estimate in estimates])
    means = wrap_near(means, means[..., :1, :], indices)
    # The rule, over all leading axes; the claim from those of the inputs.
    covariances = np.stack([np.asarray(fill_masked(e.covariance)) for e in estimates], axis=-3)
    mean, covariance = _combine_all(rule, means, covariances)
    return Estimate(wrap_angles(np.asarray(mean), indices), covariance, rule.claim([e.claim for e in estimates]))


@compile_on_call
def _combine_all(
    rule: AbstractFusion, means: Float[Array, "*batch count n"], covariances: Float[Array, "*batch count n n"]
) -> tuple[Float[Array, "*batch n"], Float[Array, "*batch n n"]]:
    """Return rule.combine(means, covariances) for each entry of the leading axes (`batch`, such as run and time)."""
    combine = rule.combine
    for _ in range(means.ndim - 2):
        combine = jax.vmap(combine)
    return combine(jnp.asarray(means), jnp.asarray(covariances))


class AbstractIntersection(AbstractFusion):
    """Covariance intersection, P = (sum_i w_i P_i^-1)^-1 and x = P sum_i w_i P_i^-1 x_i, with any weights w."""

    def claim(self, claims: list[Claim]) -> Claim:
        """Return the weakest of the claims and "upper": the intersection is a bound, whatever the correlations."""
        return _combine_claims(claims, "upper")

    def weights_of(self, covariances: Covariances, information: Covariances) -> Float[jax.Array, " count"]:
        """Return the weights on the simplex of estimates with these P_i and P_i^-1."""
        raise unwritten(self, "weights_of")

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Return the intersection of the estimates, with weights from their covariances."""
        information = invert_covariances(covariances)
        mean, covariance = intersect_covariances(means, information, self.weights_of(covariances, information))
        return restore_exact_components(mean, covariance, means, covariances)


class CovarianceIntersection(AbstractIntersection):
    """Covariance intersection with the weights that minimise the trace.

    P = (sum_i w_i P_i^-1)^-1 and x = P sum_i w_i P_i^-1 x_i, w on the simplex; tr P is convex in w. An upper bound for
    any correlation if the inputs are and if weights do not depend on the data. Where covariances depend on the data, so
    do the weights, and the smallest may be too small: then the inputs are "nominal", and so is the result.

    Source: Julier and Uhlmann (1997); cubature fusion under amplify-and-forward relays, equations (8) and (34).
    """

    def weights_of(self, covariances: Covariances, information: Covariances) -> Float[jax.Array, " count"]:
        """Return the weights w that minimise tr (sum_i w_i P_i^-1)^-1."""
        return trace_optimal_weights(information)

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the weights of covariance intersection with shares that nearly minimise the trace.

        An exact search at every node would cost too much: IMPROVEMENTS steps of the search of `TraceIntersection` do.
        """
        return intersection_weights(believed, choose_shares_by_trace(believed, POWER, IMPROVEMENTS))


class EqualIntersection(AbstractIntersection):
    """Covariance intersection with equal weights: nothing is chosen, so data-dependent covariances cannot mislead.

    Source: cubature fusion under amplify-and-forward relays, equation (8) with w_i = 1 / M.
    """

    def weights_of(self, covariances: Covariances, information: Covariances) -> Float[jax.Array, " count"]:
        """Return 1 / count for each estimate."""
        return jnp.full(len(information), 1 / len(information))

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the weights of covariance intersection with equal shares of the estimates that arrived."""
        return intersection_weights(believed, equal_shares(believed))


class FixedIntersection(AbstractIntersection):
    """Covariance intersection with fixed weights.

    Args:
        weights: on the simplex (count,).

    Raises:
        ValueError: weights off the simplex.

    Source: cubature fusion under amplify-and-forward relays, equation (8).
    """

    weights: Float[Array, "count"]

    def __init__(self, weights: Float[ArrayLike, " count"]):
        """Check and hold the weight of each estimate; they are not negative, and their sum is 1."""
        self.weights = probabilities("fusion weights", weights)

    def check(self, count: int) -> None:
        """Raise ValueError unless there are as many weights as estimates."""
        array("fusion weights", self.weights, (count,))

    def weights_of(self, covariances: Covariances, information: Covariances) -> Float[jax.Array, " count"]:
        """Return the fixed weights, whatever the covariances are."""
        return jnp.asarray(self.weights)


class WeightedFusion(AbstractFusion):
    """Weighted mean sum_i c_i x_i, with fixed weights on the simplex.

    The error is sum_i c_i e_i, so E[e e'] <= sum_i c_i E[e_i e_i'] for any correlation (convexity): the bound is
    sum_i c_i P_i. It needs no covariance, so it fuses estimates that claim none.

    Args:
        weights: c_i on the simplex (count,).

    Raises:
        ValueError: weights off the simplex.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equation (15).
    """

    weights: Float[Array, "count"]

    def __init__(self, weights: Float[ArrayLike, " count"]):
        """Check and hold the weight c_i of each estimate; they are not negative, and their sum is 1."""
        self.weights = probabilities("fusion weights", weights)

    def check(self, count: int) -> None:
        """Raise ValueError unless there are as many weights as estimates."""
        array("fusion weights", self.weights, (count,))

    def claim(self, claims: list[Claim]) -> Claim:
        """Return the weakest of the claims and "upper": the sum of c_i P_i is a bound, by convexity."""
        return weakest([*claims, "upper"])

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Return the mean sum_i c_i x_i, and the bound sum_i c_i P_i of its error's covariance."""
        weights = jnp.asarray(self.weights)
        return weights @ means, jnp.tensordot(weights, covariances, axes=1)


class InverseCovarianceIntersection(AbstractFusion):
    """Inverse covariance intersection, two estimates at a time in the order of the nodes.

    P^-1 = A^-1 + B^-1 - (w A + (1 - w) B)^-1 with the w that minimises the trace. Tighter than covariance intersection,
    and valid only for estimates that share information of a certain form; so it claims "nominal".

    Source: Noack, Sijs, Reinhardt and Hanebeck, Decentralized data fusion with inverse covariance intersection (2017).
    """

    def claim(self, claims: list[Claim]) -> Claim:
        """Lower a claim to "nominal": the assumed form of the correlation is not checked."""
        return _combine_claims(claims, "nominal")

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Fuse the first two by inverse covariance intersection, the result with the third, and so on."""
        mean, covariance = means[0], covariances[0]
        for other, other_covariance in zip(means[1:], covariances[1:], strict=True):
            mean, covariance = intersect_inverse_covariances(mean, covariance, other, other_covariance)
        return mean, covariance


def _combine_claims(claims: list[Claim], strongest: Claim) -> Claim:
    """Return the weakest of the claims and of `strongest`, the rule's own, for rules with weights by covariances."""
    if "none" in claims:
        raise fail("fusion by covariances", "estimates that claim one", "the claim 'none' (WeightedFusion needs none)")
    return weakest([*claims, strongest])
