"""Best unbiased weights of estimates for a joint covariance of their errors, of all or of those that arrived."""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.fusion.covariance_intersection import invert_positive_definite
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.lapack import pseudo_solve, regular_solve
from heliograph.numerics.linalg import WRITTEN, psd_solve, rounding, symmetric, symmetrize
from heliograph.numerics.types import Array, Bool, Float

RANK = 4096  # an eigenvalue below so many roundings of the largest one counts as 0
RIDGE = 1e-8  # independent error that is added to each estimate, as a share of the mean variance


Weights = Callable[..., Float[jax.Array, "n node n"]]


def _with_joint_check(weights: Weights) -> Weights:
    """Decorate a function of a joint covariance Cov(e_i, e_j), so that it refuses another shape of its argument.

    The shape is (nodes, n, nodes, n).
    """

    @wraps(weights)
    def call(joint: Array, *rest: Array) -> Any:
        """Check the joint covariance, then compute its weights.

        `weights`: the function of the joint covariance that is decorated.
        """
        shape = np.shape(joint) if isinstance(joint, np.ndarray | jax.Array) else ()
        if len(shape) != 4 or shape[:2] != shape[2:]:
            raise fail("joint covariance", "an array of shape (nodes, n, nodes, n)", shape or show_value(joint))
        return weights(joint, *rest)

    return call


@_with_joint_check
@compile_on_call
def matrix_weights(joint: Float[Array, "node n node n"]) -> Float[jax.Array, "n node n"]:
    """Return the matrix weights W_i with sum_i W_i = I that minimise W P W', for P = `joint` (node, n, node, n).

    The estimates of all nodes, x + e_i, are fused to sum_i W_i (x + e_i); these weights make the covariance of its
    error least. They are W = (E' U^+ E)^-1 E' U^+ with E = [I; ...; I] and U = P + E D E'. P^+ (the pseudoinverse)
    alone would be wrong if a combination of the estimates has no error. With D > 0 the range of E is in that of U, and
    U gives the weights of P since W E = I. D is diagonal, the mean of the estimates' variances, so that units do not
    matter. An eigenvalue below RANK roundings counts as 0.

    Args:
        joint: Cov(e_i, e_j) of all pairs, shape (node, n, node, n).

    Source: Rao, Linear Statistical Inference and its Applications (1973), 4i.4, the unified theory of least squares.
    """
    nodes, n = joint.shape[:2]
    joint = jnp.asarray(joint)
    # The diagonal of D, and P in units of its roots.
    variances = jnp.einsum("iaia->a", joint) / nodes
    unit = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    P = joint / (unit[:, None, None] * unit)
    # U = P + E E' in these units, in which D = I.
    U = symmetrize((P + jnp.eye(n)[None, :, None, :]).reshape(nodes * n, nodes * n))
    E = jnp.tile(jnp.eye(n), (nodes, 1))
    E_U_inverse = pseudo_solve(U, E, rounding(0.0, U, RANK)).T  # E' U^+
    # (E' U^+ E)^-1 E' U^+, then back to the states' own units.
    weights = regular_solve(E_U_inverse @ E, E_U_inverse).reshape(n, nodes, n)
    return jnp.asarray(unit[:, None, None] * weights / unit)


@compile_on_call
def solve_factored_weights(
    shared: Float[Array, "node n sources"], independent: Float[Array, "node n n"]
) -> Float[jax.Array, "n node n"]:
    """Return the best weights W = (E' P^-1 E)^-1 E' P^-1 of nodes' estimates whose errors have the joint covariance P.

    P = L L' + B, B = blockdiag(B_i) with every B_i positive definite, and E = [I; ...; I]. By the matrix inversion
    lemma P^-1 E = B^-1 E - B^-1 L (I + L' B^-1 L)^-1 L' B^-1 E, at a cost linear in the number of nodes.

    Args:
        shared: blocks of L, one for each node: how each of the sources that the nodes' errors share moves its error.
        independent: B_i, the covariance of the rest of each node's error.

    Returns:
        W: W[:, i] (n, n) multiplies the estimate of node i; all of them sum to I.
    """
    nodes, n, sources = shared.shape
    # With B = F F': F^-1 L and F^-1 E, where the independent parts of errors have the covariance I.
    factors = jnp.linalg.cholesky(jnp.asarray(independent))
    l_and_e = jnp.concatenate([jnp.asarray(shared), jnp.broadcast_to(jnp.eye(n), (nodes, n, n))], axis=-1)
    whitened = jax.lax.linalg.triangular_solve(factors, l_and_e, left_side=True, lower=True).reshape(nodes * n, -1)
    f_l, f_e = whitened[:, :sources], whitened[:, sources:]
    # F' P^-1 E by the lemma.
    inner = jnp.linalg.cholesky(jnp.eye(sources) + f_l.T @ f_l)
    f_p_e = f_e - f_l @ jax.scipy.linalg.cho_solve((inner, True), f_l.T @ f_e)
    # E' P^-1 E, and P^-1 E (nodes, n, n), whose axes are then moved to give E' P^-1 (n, nodes n).
    information = f_e.T @ f_p_e
    p_e = jax.lax.linalg.triangular_solve(factors, f_p_e.reshape(nodes, n, n), left_side=True, lower=True,
                                          transpose_a=True)  # fmt: skip
    weights = jnp.linalg.solve(information, jnp.moveaxis(p_e, 2, 0).reshape(n, -1)).reshape(n, nodes, n)
    # Rounding takes the sum of the weights off I: divide by it.
    unbiased = jnp.linalg.solve(weights.sum(axis=1), weights.reshape(n, -1))
    return jnp.asarray(unbiased.reshape(n, nodes, n))


@_with_joint_check
@compile_on_call
def diagonal_weights(joint: Float[Array, "node n node n"]) -> Float[jax.Array, "n node n"]:
    """Compute diagonal weights: the best for each component of the state by itself, for `joint` P (node, n, node, n).

    Args:
        joint: Cov(e_i, e_j) of all pairs, shape (node, n, node, n).
    """
    return _weigh_components(matrix_weights, jnp.asarray(joint))


@_with_joint_check
@compile_on_call
def scalar_weights(joint: Float[Array, "node n node n"]) -> Float[jax.Array, "n node n"]:
    """Compute scalar weights: one number per node, W_i = w_i I, of least tr W P W', for `joint` P (node, n, node, n).

    Args:
        joint: Cov(e_i, e_j) of all pairs, shape (node, n, node, n).
    """
    return _weigh_by_trace(matrix_weights, jnp.asarray(joint))


def _weigh_components(weigh: Weights, joint: Float[jax.Array, "node n node n"]) -> Float[jax.Array, "n node n"]:
    """Return diagonal weights: those that `weigh` gives for each component of the state by itself."""
    nodes, n = joint.shape[:2]
    # Component a of all nodes has a joint covariance like that of a state with one component, (node, 1, node, 1).
    component = jnp.stack([joint[:, a, :, a] for a in range(n)])
    # The weights of one component are (1, node, 1): [0, :, 0] leaves one number for each node.
    weights = jax.vmap(lambda block: weigh(block.reshape(nodes, 1, nodes, 1))[0, :, 0])(component)
    return jnp.einsum("ai,ab->aib", weights, jnp.eye(n))


def _weigh_by_trace(weigh: Weights, joint: Float[jax.Array, "node n node n"]) -> Float[jax.Array, "n node n"]:
    """Return weights of one number for each estimate, computed as if covariances were their traces.

    `joint`: Cov(e_i, e_j) of all estimates. Its traces replace it, like the covariances of a state of one component.
    """
    nodes, n = joint.shape[:2]
    traces = jnp.einsum("iaja->ij", joint).reshape(nodes, 1, nodes, 1)
    weights = weigh(traces)[0, :, 0]
    return jnp.einsum("i,ab->aib", weights, jnp.eye(n))


def weigh_covariance(
    weights: Float[Array, "n node n"], joint: Float[Array, "node n node n"]
) -> Float[jax.Array, "n n"]:
    """Return the covariance W P W' of the weighted sum of the errors, with weights W and P = `joint`."""
    return symmetrize(jnp.einsum("aib,ibjc,djc->ad", weights, joint, weights))


def solve_regularised_weights(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """Return unbiased weights of least C (P + ridge D) C' for the estimates that arrived; the ridge keeps them bounded.

    C = (E' U^-1 E)^-1 E' U^-1, E = [I; ...; I], U = P + RIDGE D, D the mean of the variances: the best weights of
    estimates with a little more independent error. Without it weights of nearly equal estimates, such as those of the
    first steps, grow without bound, and rounding with them. C P C' is the covariance whatever C is.
    """
    degree, n = joint.shape[:2]
    arrived = present.astype(joint.dtype)
    # U in units of the deviations; the rows of absent estimates are those of I, and in E they are zero.
    variances = jnp.einsum("iaia,i->a", joint, arrived) / arrived.sum()
    unit = jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    both = arrived[:, None, None, None] * arrived[None, None, :, None]
    scaled = (both * joint / (unit[:, None, None] * unit)).reshape(degree * n, degree * n)
    total = scaled + jnp.diag(jnp.repeat(jnp.where(present, RIDGE, 1.0), n))
    ones = (arrived[:, None, None] * jnp.eye(n)).reshape(degree * n, n)
    # U^-1 E, and what makes the weights sum to I.
    solved = psd_solve(total, ones) if degree * n <= WRITTEN else regular_solve(total, ones)
    weights = (invert_positive_definite(ones.T @ solved) @ solved.T).reshape(n, degree, n)
    return unit[:, None, None] * weights / unit


def solve_regularised_weights_by_component(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """Return the diagonal weights of the estimates that are `present`, the best for each component by itself.

    `joint`: Cov(e_i, e_j) of a node and its neighbours, `degree` of them. Up to WRITTEN of them, the solution is
    written out.
    """
    degree, n = joint.shape[:2]
    if degree <= WRITTEN:
        return jnp.einsum("ia,ab->aib", component_weights(joint, present), jnp.eye(n))
    return _weigh_components(partial(solve_regularised_weights, present=present), joint)


def component_weights(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "degree n"]:
    """Return the diagonals c_i of the weights that are best for each component by itself.

    `joint`: Cov(e_i, e_j) of a node and its neighbours, `degree` of them. `present`: which estimates arrived; the
    others have weight 0.
    """
    component = jnp.stack([joint[:, a, :, a] for a in range(joint.shape[1])])
    return jax.vmap(_weigh_component, in_axes=(0, None), out_axes=1)(component, present.astype(joint.dtype))


def _weigh_component(
    joint: Float[jax.Array, "degree degree"], arrived: Float[jax.Array, " degree"]
) -> Float[jax.Array, " degree"]:
    """Return c = U^-1 1 / (1' U^-1 1) over estimates that arrived (`arrived` is 1, else 0), for one component.

    U = P + ridge I, with P the joint covariance of the component. The ridge, RIDGE (1e-8) of the mean variance, makes U
    regular.
    """
    mean = jnp.sum(arrived * jnp.diagonal(joint)) / jnp.sum(arrived)
    # What U adds to P; the rows of absent estimates are those of I.
    ridge = jnp.where(arrived > 0, RIDGE * jnp.where(mean > 0, mean, 1.0), 1.0)
    U = arrived[:, None] * arrived * joint + jnp.diag(ridge)
    U_inverse_of_ones = psd_solve(U, arrived[:, None])[:, 0]  # U^-1 1
    return U_inverse_of_ones / jnp.sum(U_inverse_of_ones)


def weigh_covariance_by_component(
    weights: Float[jax.Array, "degree n"], joint: Float[jax.Array, "degree n degree n"]
) -> Float[jax.Array, "n n"]:
    """Return the covariance C P C' with diagonal weights C, computed as one sum over senders after another.

    `weights`: the diagonals of C (degree, n). `joint`: P = Cov(e_i, e_j) of all estimates.
    """
    sums = jnp.einsum("iajb,jb->iab", joint, weights)
    return symmetric(jnp.einsum("ia,iab->ab", weights, sums))


def solve_regularised_scalar_weights(
    joint: Float[jax.Array, "degree n degree n"], present: Bool[jax.Array, " degree"]
) -> Float[jax.Array, "n degree n"]:
    """Return one weight for each estimate that is present, so that the fused error has the least trace.

    `joint`: Cov(e_i, e_j) of the estimates of a node and its neighbours.
    """
    return _weigh_by_trace(partial(solve_regularised_weights, present=present), joint)
