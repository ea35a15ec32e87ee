"""Fusion with the joint covariance of the local errors: best weights of the present estimates."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.fusion.cross_covariance import ErrorMoments, ErrorStep
from heliograph.fusion.joint_covariance_weights import (
    component_weights,
    diagonal_weights,
    matrix_weights,
    scalar_weights,
    solve_regularised_scalar_weights,
    solve_regularised_weights,
    solve_regularised_weights_by_component,
    weigh_covariance,
    weigh_covariance_by_component,
)
from heliograph.fusion.mesh.node_gains import NeighbourEstimates, NeighbourWeights
from heliograph.fusion.rules import AbstractFusion, Covariances, Fused, Means
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail
from heliograph.numerics.linalg import WRITTEN
from heliograph.numerics.module import unwritten
from heliograph.numerics.types import Array, Bool, Float, PyTree

Joint = Float[jax.Array, "node n node n"]


class CentreStep(NamedTuple):
    """What the centre knows of one step, before any data.

    step: linear recursion of the plant's state and the nodes' errors, with its noises. errors: their mean and joint
    covariance after it.
    """

    step: ErrorStep
    errors: ErrorMoments


class AbstractInformedFusion(AbstractFusion):
    """A rule that needs the joint covariance of the local errors; a `Network` propagates it for the rule.

    `start` is the rule's state before the first step, `fuse_step` updates it with the reports of one step.
    """

    @property
    def needs_plant_moments(self) -> bool:
        """True if it needs the mean and the covariance of the plant's state before any data."""
        return False

    def claim(self, claims: list[Claim]) -> Claim:
        """Raise ValueError: what local covariances claim to be does not determine the joint covariance."""
        raise self._refuse_without_joint()

    def combine(self, means: Means, covariances: Covariances) -> Fused:
        """Raise ValueError: without the joint covariance the local means and covariances are not enough."""
        raise self._refuse_without_joint()

    def start(self, errors: ErrorMoments) -> PyTree:
        """Return the rule's state before the first step, from the moments of x_0 and the errors; none by default."""
        return ()

    def fuse_step(self, state: PyTree, happened: CentreStep, means: Means) -> tuple[PyTree, Fused]:
        """Fuse the nodes' means after a step: return the next state, and fused mean and covariance."""
        raise unwritten(self, "fuse_step")

    def _refuse_without_joint(self) -> ValueError:
        """Make the ValueError of a rule that is called without the joint covariance of the errors."""
        what = "the errors' joint covariance, which a Network of linear filters has"
        return fail(f"fusion by {type(self).__name__}", what, "estimates with a covariance each")


class AbstractJointWeights(AbstractInformedFusion):
    """x = sum_i W_i x_i with sum_i W_i = I, best for the joint covariance P of the errors, which is then W P W'.

    Known means of the errors are subtracted. `with_mean`: the plant's mean before any data is one estimate more; it
    costs no communication, and no direction gets worse.
    """

    with_mean: eqx.AbstractVar[bool]

    @property
    def needs_plant_moments(self) -> bool:
        """True if the plant's mean is one of the estimates."""
        return self.with_mean

    @property
    def needs_joint(self) -> bool:
        """Always True: the weights minimise the fused covariance, which depends on the joint covariance."""
        return True

    def weights(self, joint: Float[Array, "node n node n"]) -> Float[Array, "n node n"]:
        """Return the weights W (n, node, n) that are best for the joint covariance P = `joint` of the errors."""
        raise unwritten(self, "weights")

    def weights_of_arrived(self, joint: Joint, present: Bool[jax.Array, " node"]) -> Float[jax.Array, "n node n"]:
        """Return the best weights of the estimates that arrived (`present`), for P = `joint`; the others have zeros."""
        raise unwritten(self, "arrived")

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the best weights W_j of the neighbours' estimates that arrived, and the fused covariance W P W'.

        P = `believed.joint` is the joint covariance of the estimates' errors. Estimates that did not arrive have zero
        weights.
        """
        if believed.joint is None or self.with_mean:
            raise fail(f"fusion by {type(self).__name__} between neighbours", "with_mean=False", True)
        weights = self.weights_of_arrived(believed.joint, believed.present)
        # A weight is a factor that all share, here I, times one of each neighbour, here W_j.
        return NeighbourWeights(
            common_factor=jnp.eye(len(weights)),
            neighbour_factors=jnp.swapaxes(weights, 0, 1),
            covariance=weigh_covariance(weights, believed.joint),
        )

    def fuse_step(self, state: PyTree, happened: CentreStep, means: Means) -> tuple[PyTree, Fused]:
        """Return the present estimates fused with the best weights for their joint covariance.

        `happened.errors`: means E e_i and joint covariance of the nodes' errors e_i = x - m_i. If `self.with_mean`, the
        plant's mean before any data is one more estimate, with the error x - E x.
        """
        errors = happened.errors
        # E x = E m_i + E e_i: adding the mean error makes an estimate unbiased.
        unbiased = jnp.asarray(means) + errors.bias
        joint = errors.joint
        if self.with_mean:
            unbiased = jnp.concatenate([unbiased, errors.state_mean[None]])
            count, n = unbiased.shape
            # `errors.covariance` is that of (x, e_1, ..., e_nodes); rolled by n it is that of (e_1, ..., e_nodes, x).
            joint = jnp.roll(errors.covariance, (-n, -n), (0, 1)).reshape(count, n, count, n)
        weights = self.weights(joint)
        # W sums to I, so that it can weigh differences of the means. Rounding of W then only affects these.
        mean = unbiased[0] + jnp.einsum("aib,ib->a", weights, unbiased - unbiased[0])
        return state, (mean, weigh_covariance(weights, joint))


class MatrixWeights(AbstractJointWeights):
    """Best linear unbiased fusion: a matrix weight for each node.

    Args:
        with_mean: whether the plant's mean before any data is one estimate more; False by default.

    Claim: "exact" in a network of linear filters behind known laws without memory; needs the moments that a `Network`
    propagates.

    Source: Bar-Shalom and Campo, The effect of the common process noise on the two-sensor fused-track covariance
    (1986); Sun and Deng, Multi-sensor optimal information fusion Kalman filter (2004).
    """

    with_mean: bool = eqx.field(static=True, default=False)

    def weights(self, joint: Float[Array, "node n node n"]) -> Float[Array, "n node n"]:
        """Return the matrix weights W_i = weights[:, i] that minimise the fused covariance; shape (n, node, n)."""
        return matrix_weights(joint)

    def weights_of_arrived(self, joint: Joint, present: Bool[jax.Array, " node"]) -> Float[jax.Array, "n node n"]:
        """Return the matrix weights of the estimates that arrived, zero for the others; a small ridge bounds them."""
        return solve_regularised_weights(joint, present)


class DiagonalWeights(AbstractJointWeights):
    """Best unbiased fusion component by component: cheaper than `MatrixWeights`, and never better.

    Args:
        with_mean: whether the plant's mean before any data is one estimate more; False by default.

    Claim: as `MatrixWeights`.

    Source: Sun and Deng, Multi-sensor optimal information fusion Kalman filter (2004).
    """

    with_mean: bool = eqx.field(static=True, default=False)

    def weights(self, joint: Float[Array, "node n node n"]) -> Float[Array, "n node n"]:
        """Return the best weights that are diagonal matrices, W_i = weights[:, i]; shape (n, node, n)."""
        return diagonal_weights(joint)

    def weights_of_arrived(self, joint: Joint, present: Bool[jax.Array, " node"]) -> Float[jax.Array, "n node n"]:
        """Return the diagonal weights of the estimates that arrived, zero for the others; a small ridge bounds them."""
        return solve_regularised_weights_by_component(joint, present)

    def neighbour_weights(self, believed: NeighbourEstimates) -> NeighbourWeights:
        """Return the diagonal weights W_j of the neighbours' estimates that arrived, and the covariance W P W'.

        P = `believed.joint` is the joint covariance of the estimates' errors. Up to WRITTEN neighbours only the
        diagonals (neighbour, n) of the W_j are computed and multiplied, which is cheaper; for more, whole matrices.
        """
        if believed.joint is None or self.with_mean or len(believed.present) > WRITTEN:
            return super().neighbour_weights(believed)  # which also refuses with_mean and a missing joint covariance
        diagonals = component_weights(believed.joint, believed.present)
        # A weight is a factor that all neighbours share, here I, times one of each neighbour, here diagonal.
        return NeighbourWeights(
            common_factor=jnp.eye(diagonals.shape[1]),
            neighbour_factors=diagonals,
            covariance=weigh_covariance_by_component(diagonals, believed.joint),
        )


class ScalarWeights(AbstractJointWeights):
    """Best unbiased fusion with one number per node, for the trace.

    The trace depends on units; poor where nodes see different states.

    Args:
        with_mean: whether the plant's mean before any data is one estimate more; False by default.

    Claim: as `MatrixWeights`.

    Source: Sun and Deng, Multi-sensor optimal information fusion Kalman filter (2004).
    """

    with_mean: bool = eqx.field(static=True, default=False)

    def weights(self, joint: Float[Array, "node n node n"]) -> Float[Array, "n node n"]:
        """Return the best weights w_i I = weights[:, i], one number for each node; shape (n, node, n)."""
        return scalar_weights(joint)

    def weights_of_arrived(self, joint: Joint, present: Bool[jax.Array, " node"]) -> Float[jax.Array, "n node n"]:
        """Return the weights w_i I of the estimates that arrived, zero for the others; a small ridge bounds them."""
        return solve_regularised_scalar_weights(joint, present)
