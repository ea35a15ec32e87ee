"""Covariance intersection on arrays: the intersection, weights of least trace, and cheap shares of neighbours."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.fusion.mesh.node_gains import NeighbourEstimates, NeighbourWeights
from heliograph.numerics.linalg import factor, psd_solve, rounding, solver, symmetric
from heliograph.numerics.types import Float

GAP = 1e-10  # certified relative excess of the trace over its minimum; rounding leaves about 1e-13
LOOP = 1000  # units of rounding below which the certificate makes no progress
ITERATIONS = 60  # most of the interior point method, which needs about 12
STEP_BACK = 0.99  # share of the way to the boundary that a step goes
KNOWN = 1e-8  # share of a variance that replaces zero, so that neither it nor the rounding of others exceeds this
HALVINGS = 50  # of the interval of one weight, which shrinks to 1e-15
FLAT = 1e-15  # share of its terms below which a slope is rounding


def intersect_covariances(
    means: Float[jax.Array, "count n"],
    information: Float[jax.Array, "count n n"],
    weights: Float[jax.Array, " count"],
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return x_0 + (sum w J)^-1 sum w J (x - x_0) and (sum w J)^-1, with x_0 the first of the means x.

    J are the information matrices, inverses of the covariances, and w weights of sum 1. Differences from x_0 are used
    since means may be millions of deviations from zero, while nearly dependent components cost the matrices digits.
    """
    covariance = invert_positive_definite(_sum_weighted(weights, information))
    differences = jnp.einsum("k,kab,kb->a", weights, information, means - means[0])
    return means[0] + covariance @ differences, covariance


class _InteriorPointState(NamedTuple):
    """State of the interior point method: weights w, multipliers s of w >= 0, whether to go on, count of steps."""

    weights: jax.Array
    slack: jax.Array
    goes_on: jax.Array
    iteration: jax.Array


def trace_optimal_weights(information: Float[jax.Array, "count n n"]) -> Float[jax.Array, " count"]:
    """Return the weights w >= 0, sum w = 1, that minimise tr P, P = (sum w_k J_k)^-1, for information matrices J_k.

    J_k is the inverse of the k-th estimate's covariance. The method is a primal-dual interior point method. The
    gradient is g_k = -tr(P J_k P); since tr P is convex in w, tr P exceeds its minimum by at most
    max_k tr(P J_k P) - tr P. The iteration stops when this certificate is below GAP tr P.
    """
    count = information.shape[0]
    # In a unit in which traces are 1 on average: the first multipliers below are of that size.
    scaled = information / (jnp.sum(jax.vmap(jnp.trace)(information)) / count)

    def improve_weights(progress: _InteriorPointState) -> _InteriorPointState:
        """Return the search after one Newton step, or unchanged weights if they are good enough by the certificate.

        w: the weights. `slack`: multipliers s of w >= 0. `scaled`: the information matrices J. P = (sum w J)^-1. g: the
        gradient of tr P. GAP: 1e-10, the relative excess of the trace that is allowed.
        """
        w, slack = progress.weights, progress.slack
        trace, gradient, hessian = _trace_derivatives(scaled, w)
        # At the optimum s = g - min g. Start there with a tenth of the trace added, so that multipliers are positive.
        slack = jnp.where(progress.iteration == 0, gradient - jnp.min(gradient) + 0.1 * trace, slack)
        new_w, new_slack = _take_newton_step(_PointWithDerivatives(w, slack, gradient, hessian))
        # Certificate: weights are good enough if max_k tr(P J_k P) is at most (1 + GAP) tr P.
        is_unfinished = jnp.max(-gradient) > (1 + rounding(GAP, trace, LOOP)) * trace
        w = jnp.where(is_unfinished, new_w, w)
        slack = jnp.where(is_unfinished, new_slack, slack)
        return _InteriorPointState(weights=w, slack=slack, goes_on=is_unfinished, iteration=progress.iteration + 1)

    def goes_on(progress: _InteriorPointState) -> jax.Array:
        """Return whether the weights are not good enough yet, and steps are left."""
        return progress.goes_on & (progress.iteration < ITERATIONS)

    # From equal weights, which are inside the simplex.
    w = jnp.full(count, 1 / count)
    start = _InteriorPointState(weights=w, slack=jnp.zeros_like(w), goes_on=jnp.asarray(True), iteration=jnp.asarray(0))
    return jnp.asarray(jax.lax.while_loop(goes_on, improve_weights, start).weights)


class _PointWithDerivatives(NamedTuple):
    """Weights and their multipliers; the gradient of tr P and its Hessian."""

    weights: Float[jax.Array, " count"]
    slack: Float[jax.Array, " count"]
    gradient: Float[jax.Array, " count"]
    hessian: Float[jax.Array, "count count"]


def _trace_derivatives(
    information: Float[jax.Array, "count n n"], w: Float[jax.Array, " count"]
) -> tuple[Float[jax.Array, ""], Float[jax.Array, " count"], Float[jax.Array, "count count"]]:
    """Return tr P, its gradient -tr(P J_k P) and its Hessian 2 tr(P J_k P J_l P), with P = (sum w J)^-1.

    J: information matrices of the estimates; w: their weights.
    """
    p = invert_positive_definite(_sum_weighted(w, information))
    j_p = information @ p  # J_k P of each k
    p_j_p = p @ j_p
    hessian = 2 * symmetric(jnp.einsum("kab,jba->kj", j_p, p_j_p))
    return jnp.trace(p), -jnp.trace(p_j_p, axis1=1, axis2=2), hessian


def _sum_weighted(w: Float[jax.Array, " count"], information: Float[jax.Array, "count n n"]) -> Float[jax.Array, "n n"]:
    """Return sum_k w_k J_k."""
    return jnp.einsum("k,kab->ab", w, information)


def _take_newton_step(point: _PointWithDerivatives) -> tuple[jax.Array, jax.Array]:
    """Return weights w and multipliers s after one Newton step for g - s + m 1 = 0, sum w = 1, w s = target.

    The weights w minimise tr (sum_k w_k J_k)^-1, with the gradient g. s are the multipliers of w >= 0 (`slack`), and m
    is that of sum w = 1. An interior point method lets w s go to 0 by a target that shrinks with each step; it follows
    from where the step with target 0 would end (Mehrotra's predictor and corrector).

    Args:
        point: weights w, multipliers s, gradient g and Hessian H of the trace.
    """
    w, slack, gradient = point.weights, point.slack, point.gradient
    # With H the Hessian, s = (target - s dw) / w is eliminated: (H + diag(s / w)) dw + m 1 = target / w - g. In the
    # unit root(w) of each weight the matrix stays well conditioned as weights vanish.
    root = jnp.sqrt(w)
    matrix = root[:, None] * point.hessian * root[None] + jnp.diag(slack)
    solve = solver(matrix)
    for_ones = root * solve(root[:, None])[:, 0]  # the solution for a right side of ones

    def find_moves(target: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the moves dw and ds of the weights w and their multipliers s (`slack`) towards w s = target.

        (H + diag(s / w)) dw = target / w - gradient - m 1, where m makes the dw sum to 0. `solve` solves it in units of
        `root` = w^1/2, and `for_ones` is its solution for the right side 1.
        """
        without_sum = root * solve((target / root - root * gradient)[:, None])[:, 0]  # for m = 0
        m = jnp.sum(without_sum) / jnp.sum(for_ones)
        weight_moves = without_sum - m * for_ones
        return weight_moves, (target - slack * weight_moves) / w - slack

    # Predictor: the step with target 0, and the mean of w s before it and where it would end.
    before = jnp.mean(w * slack)
    move, slack_move = find_moves(jnp.zeros_like(w))
    after = jnp.mean((w + _longest_step(w, move) * move) * (slack + _longest_step(slack, slack_move) * slack_move))
    # Corrector: towards equal w s, smaller by Mehrotra's (after / before)^3, less the predictor's second-order term.
    target = before * jnp.clip(after / before, 0.0, 1.0) ** 3 - move * slack_move
    move, slack_move = find_moves(target)
    length = jnp.minimum(_longest_step(w, move), _longest_step(slack, slack_move))
    w = w + length * move
    return w / jnp.sum(w), slack + length * slack_move


def _longest_step(value: Float[jax.Array, " count"], move: Float[jax.Array, " count"]) -> Float[jax.Array, ""]:
    """Return the largest step, at most 1, that keeps value + step move positive."""
    to_zero = jnp.where(move < 0, -value / jnp.where(move < 0, move, -1.0), jnp.inf)
    return jnp.minimum(1.0, STEP_BACK * jnp.min(to_zero))


def intersect_inverse_covariances(
    a: Float[jax.Array, " n"], p: Float[jax.Array, "n n"], b: Float[jax.Array, " n"], q: Float[jax.Array, "n n"]
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return the inverse covariance intersection of (a, P) and (b, Q), with the weight w of least trace.

    With C = (w P + (1 - w) Q)^-1 and V = (P^-1 + Q^-1 - C)^-1, tr V is convex in w, and its slope is
    -tr(V C (P - Q) C V). The weight is where the slope changes its sign, which is known to rounding; the least trace
    itself is too flat to tell weights apart that differ by 1e-8. Estimates of one covariance have equal weights.

    Args:
        a: the first mean.
        p: its covariance P.
        b: the second mean.
        q: its covariance Q.

    Returns:
        The fused mean and its covariance V.
    """
    both = jnp.stack([p, q])
    p_information, q_information = invert_covariances(both)

    def fuse_covariances(w: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return V = (P^-1 + Q^-1 - C)^-1 and C = (w P + (1 - w) Q)^-1 for the weight w of P."""
        common = invert_covariances((w * p + (1 - w) * q)[None])[0]
        return invert_positive_definite(p_information + q_information - common), common

    def halve_interval(_: jax.Array, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the half of the interval in which the slope changes its sign, or its midpoint if the slope is 0 there.

        `ends`: of the interval of the weight w that is searched. p, q: the two covariances. FLAT: 1e-15, the share of
        its terms up to which a slope is rounding.
        """
        low, high = ends
        w = jnp.mean(jnp.stack(ends))
        covariance, common = fuse_covariances(w)
        factor = covariance @ common
        # The slope is a difference of terms; `size` is their sum.
        slope, size = (-jnp.sum((factor @ change) * factor) for change in (p - q, p + q))
        is_flat = jnp.abs(slope) <= FLAT * jnp.abs(size)
        return jnp.where(is_flat | (slope < 0), w, low), jnp.where(is_flat | (slope > 0), w, high)

    low, high = jax.lax.fori_loop(0, HALVINGS, halve_interval, (jnp.asarray(0.0), jnp.asarray(1.0)))
    # Covariance and mean at the best weight.
    w = (low + high) / 2
    covariance, common = fuse_covariances(w)
    # V (Q^-1 - (1 - w) C) is the weight of b, and I minus it that of a: the mean is a and a multiple of the difference,
    # so that large equal means cost no digits.
    mean = a + covariance @ ((q_information - (1 - w) * common) @ (b - a))
    return restore_exact_components(mean, symmetric(covariance), jnp.stack([a, b]), both)


def invert_positive_definite(a: Float[jax.Array, "n n"]) -> Float[jax.Array, "n n"]:
    """Return the inverse of a positive definite matrix, symmetric also in its rounding errors."""
    return symmetric(psd_solve(a, jnp.eye(len(a))))


def invert_covariances(matrices: Float[jax.Array, "count n n"]) -> Float[jax.Array, "count n n"]:
    """Return the inverses of covariances P_k of one state, where a component of variance 0 counts as known to KNOWN.

    KNOWN is 1e-8, the share of a variance that stands for none. A component that has less than KNOWN of its variance
    left, given earlier ones, gets KNOWN of it added. A component of variance 0 gets KNOWN of the largest variance that
    any estimate has for it, or of 1 if all are 0.
    """
    variances = jnp.diagonal(matrices, axis1=1, axis2=2)
    largest = jnp.max(variances, axis=0)
    reference = jnp.where(variances > 0, variances, jnp.where(largest > 0, largest, 1.0))
    return jax.vmap(_invert_widened)(matrices, KNOWN * reference)


def _invert_widened(a: jax.Array, least: jax.Array) -> jax.Array:
    """Return the inverse of a covariance, with `least` added to components of too little variance.

    These are components whose variance, given earlier ones, is below `least`.
    """
    # 1 / sqrt(variance of each component given earlier ones), or 0 if that is rounding.
    _, scales = factor(a)
    is_small = jnp.where((scales == 0) | (scales**2 * least > 1), 1.0, 0.0)
    return invert_positive_definite(a + jnp.diag(is_small * least))


def restore_exact_components(
    mean: Float[jax.Array, " n"],
    covariance: Float[jax.Array, "n n"],
    means: Float[jax.Array, "count n"],
    inputs: Float[jax.Array, "count n n"],
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return the fused estimate, with an input's mean and variance 0 in components where that input has variance 0.

    `invert_covariances` takes a small number for no variance, so that the fused mean would keep 1e-8 of other inputs.
    """
    is_exact_in_input = jnp.diagonal(inputs, axis1=1, axis2=2) == 0
    # Go from the last input to the first, so that the first exact one prevails.
    for mean_of_input, is_exact in zip(reversed(list(means)), reversed(list(is_exact_in_input)), strict=True):
        mean = jnp.where(is_exact, mean_of_input, mean)
    is_exact_in_any = jnp.any(is_exact_in_input, axis=0)
    return mean, jnp.where(is_exact_in_any[:, None] | is_exact_in_any, 0.0, covariance)


Shared = tuple[Float[jax.Array, " degree"], Float[jax.Array, "n n"]]  # shares pi, and (sum_j pi_j P_j^-1)^-1


def equal_shares(believed: NeighbourEstimates) -> Shared:
    """Return equal shares of the estimates that arrived, and the covariance of their intersection."""
    present = believed.present.astype(believed.traces.dtype)
    return intersect_shares(believed, present / present.sum())


def choose_shares_by_trace(believed: NeighbourEstimates, power: float, improvements: int) -> Shared:
    """Return the shares of covariance intersection, and its covariance P, that have the smallest trace tr P found.

    Tried are shares in proportion to (tr P_j)^-power and equal ones: the former alone would ignore a neighbour of large
    variance, even one who alone knows some direction. From the middle of the two, each improvement multiplies each
    share pi_j by the root of tr(P J_j P) / tr P, P = (sum pi J)^-1, which is 1 at the minimum where pi_j is positive.

    Source: Silvey, Titterington and Torsney, An algorithm for optimal designs on a finite design space (1978).
    """
    # Relative to the smallest trace that arrived, so that no power overflows.
    least = jnp.min(jnp.where(believed.present, believed.traces, jnp.inf))
    by_trace = jnp.where(believed.present, (least / believed.traces) ** power, 0.0)
    equal = equal_shares(believed)
    best = _smaller_trace(intersect_shares(believed, by_trace / by_trace.sum()), equal)
    # An improvement leaves a share of zero at zero, so the first shares are all positive.
    (best_shares, _), (shares_if_equal, _) = best, equal
    shares = (best_shares + shares_if_equal) / 2
    for _ in range(improvements):
        _, covariance = intersect_shares(believed, shares)
        ratio = jnp.einsum("ab,jbc,ca->j", covariance, believed.information, covariance) / jnp.trace(covariance)
        shares = shares * jnp.sqrt(jnp.maximum(ratio, 0.0))
        shares = shares / shares.sum()
        best = _smaller_trace(best, intersect_shares(believed, shares))
    return best


def intersect_shares(believed: NeighbourEstimates, shares: Float[jax.Array, " degree"]) -> Shared:
    """Return the shares with the covariance (sum_j pi_j P_j^-1)^-1 of their intersection."""
    return shares, invert_positive_definite(jnp.einsum("j,jab->ab", shares, believed.information))


def intersection_weights(believed: NeighbourEstimates, shared: Shared) -> NeighbourWeights:
    """Return the weights C_j = P (pi_j P_j^-1) of covariance intersection with shares pi_j, and its covariance P.

    `believed`: the estimates that arrived, with P_j^-1. `shared`: (shares, P).
    """
    shares, covariance = shared
    return NeighbourWeights(
        common_factor=covariance,
        neighbour_factors=shares[:, None, None] * believed.information,
        covariance=covariance,
    )


def _smaller_trace(a: Shared, b: Shared) -> Shared:
    """Return the one of two intersections, each (shares, covariance), whose covariance has the smaller trace."""
    (a_shares, a_covariance), (b_shares, b_covariance) = a, b
    is_first = jnp.trace(a_covariance) <= jnp.trace(b_covariance)
    return jnp.where(is_first, a_shares, b_shares), jnp.where(is_first, a_covariance, b_covariance)
