"""One step of a node that estimates from what arrived: weights of the estimates, then prediction and correction.

With the estimates xhat_j of the step before and the measurements z_j of this one; sums over what arrived, the node's
own included:

  fused      xc = sum_j C_j xhat_j,  sum_j C_j = I,  of covariance Pc
  predicted  A xc + b,  Pb = A Pc A' + Q
  corrected  P = (Pb^-1 + S)^-1,  S = sum_j H_j' R_j^-1 H_j,  xhat+ = xb + P sum_j H_j' R_j^-1 (z_j - H_j xb)

In one line, xhat+ = A xhat + b + sum_j M_j (xhat_j - xhat) + W sum_j H_j' R_j^-1 (z_j - H_j (A xhat + b)), with W = P,
M_j = (I - W S) A C_j; the sum of M_j (xhat_j - xhat) needs no digits of xhat itself.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, eliminate
from heliograph.factors.factored_gaussian import condition_on_observation, from_covariance
from heliograph.factors.pivots import square_root
from heliograph.numerics.linalg import psd_solve, symmetrize
from heliograph.numerics.types import Array, Bool, Float


class NeighbourEstimates(NamedTuple):
    """What one node knows of the estimates that its neighbours sent, itself first: covariances, and which arrived.

    Shapes: covariance (n, n) of the node itself; traces (degree,) of all covariances, information (degree, n, n), their
    inverses; joint (degree, n, degree, n), None where it is not propagated; present (degree,).
    """

    covariance: Float[jax.Array, "n n"]
    traces: Float[jax.Array, " degree"]
    information: Float[jax.Array, "degree n n"]
    joint: Float[jax.Array, "degree n degree n"] | None
    present: Bool[jax.Array, " degree"]


class NeighbourWeights(NamedTuple):
    """Weights C_j = L D_j of the neighbours' estimates, and the covariance Pc of the fused estimate.

    L = common_factor (n, n), D_j = neighbour_factors (degree, n, n) or their diagonals (degree, n), covariance (n, n).
    Covariance intersection has C_j = P (w_j P_j^-1), so that all weights share the factor L = P.
    """

    common_factor: Float[jax.Array, "n n"]
    neighbour_factors: Float[jax.Array, "degree n *n"]
    covariance: Float[jax.Array, "n n"]


class NodeStep(NamedTuple):
    """Plant over one step, A and Q, and information H' R^-1 H of measurements: of those that arrived, and of all."""

    matrix: Float[Array, "n n"]
    noise: Float[Array, "n n"]
    arrived: Float[Array, "n n"]
    complete: Float[Array, "n n"]


class NodeGains(NamedTuple):
    """Gains of one node's step: M_j = L D_j of neighbours' estimates, W of measurements, F = I - W S, and P after it.

    L = common_factor, W = gain, F = correction_map (what the correction leaves of an error) and P = covariance (n, n);
    D_j = neighbour_factors (degree, n, n) or their diagonals (degree, n).
    """

    common_factor: Float[jax.Array, "n n"]
    neighbour_factors: Float[jax.Array, "degree n *n"]
    gain: Float[jax.Array, "n n"]
    correction_map: Float[jax.Array, "n n"]
    covariance: Float[jax.Array, "n n"]


def gains_of(weights: NeighbourWeights, step: NodeStep) -> NodeGains:
    """Return the gains of a step that fuses estimates with weights C_j = L D_j, predicts once, and corrects.

    S = `step.arrived` is the information sum_j H_j' R_j^-1 H_j of the measurements that arrived.
    """
    a = jnp.asarray(step.matrix)
    # Pb = A Pc A' + Q; P = (Pb^-1 + S)^-1 and F = I - P S.
    predicted = symmetrize(a @ weights.covariance @ a.T + step.noise)
    corrected, correction_map = correct_by_information(predicted, jnp.asarray(step.arrived))
    # M_j = F A L D_j. The correction is P sum_j H_j' R_j^-1 (z_j - H_j xb): the gain of these sums is P itself.
    return NodeGains(
        common_factor=correction_map @ a @ weights.common_factor,
        neighbour_factors=weights.neighbour_factors,
        gain=corrected,
        correction_map=correction_map,
        covariance=corrected,
    )


def correct_by_information(
    predicted: Float[jax.Array, "n n"], information: Float[jax.Array, "n n"]
) -> tuple[Float[jax.Array, "n n"], Float[jax.Array, "n n"]]:
    """Return P = (Pb^-1 + S)^-1 and F = I - P S from a predicted Pb, which may be singular, and information S.

    With S = L diag(d) L', the measurements tell as much as L' x + v with Cov v = diag(d)^-1.
    """
    n, factors = len(predicted), eliminate(information)
    rows = jnp.diag(square_root(factors.weights)) @ factors.matrix.T  # diag(d)^1/2 L', of unit noise
    x = from_covariance(np.zeros(n), predicted)
    unit_noise = WeightedColumns(np.eye(n), jnp.ones(n))
    corrected, _ = condition_on_observation(x, rows @ x.root, jnp.zeros(n), unit_noise)
    return corrected.covariance, np.eye(n) - corrected.covariance @ information


def information_of(
    gain: jax.Array, noise: jax.Array, used: jax.Array
) -> tuple[Float[jax.Array, "n m"], Float[jax.Array, "n n"]]:
    """Return H' R^-1 (n, m) and the information H' R^-1 H (n, n) of a measurement z = H x + v, R = Cov v.

    Only the components of z that are `used`, such as those that arrived, count.

    Args:
        gain: H (m, n).
        noise: R (m, m).
        used: True where a component is used (m,).
    """
    mask = used.astype(gain.dtype)
    # Components that are not used get rows of zeros in H, and independent noise of variance 1.
    h = mask[:, None] * gain
    r = mask[:, None] * noise * mask[None] + jnp.diag(1 - mask)
    weighted = psd_solve(r, h).T
    return weighted, weighted @ h
