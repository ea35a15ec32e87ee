"""Weights for estimates with H-infinity levels, and the level and error norm of their weighted fusion."""

import numpy as np

from heliograph.numerics.check import array, fail, probabilities
from heliograph.numerics.types import ArrayLike, Float


def level_weights(levels: Float[ArrayLike, " N"]) -> Float[np.ndarray, "N"]:
    """Return the weights c_i proportional to 1 / gamma_i^2, which minimise sum c_i^2 gamma_i^2 on the simplex.

    A level gamma_i bounds a node's ratio of error to disturbance. By Cauchy's inequality,
    1 = (sum c g 1/g)^2 <= sum c^2 g^2 sum 1/g^2, with equality for these weights. The sharper `fused_level` is linear
    in c, so the best single node minimises it.

    Args:
        levels: gamma_i of the nodes (N,), positive.

    Raises:
        ValueError: levels that are not positive.

    Source: H-infinity quantized fusion over amplify-and-forward relays, Theorem 4, in closed form.
    """
    gamma = _check_levels(levels)
    inverse_squares = (gamma.min() / gamma) ** 2  # relative to the smallest level: at most 1, so that none overflows
    return np.asarray(inverse_squares / inverse_squares.sum())


def fused_level(levels: Float[ArrayLike, " N"], weights: Float[ArrayLike, " N"]) -> float:
    """Return sum_i c_i gamma_i, an H-infinity level of the weighted fusion sum_i c_i xhat_i of unquantized estimates.

    A level gamma_i says ||e_i|| <= gamma_i ||w_i|| for the error e_i of node i and any disturbance w_i of finite
    energy. If all ||w_i|| are the same number ||w||, the fused error sum_i c_i e_i has at most the norm
    sum_i c_i gamma_i ||w|| (Minkowski). So the fused level is never above the largest local one.

    Args:
        levels: gamma_i of the nodes (N,), positive.
        weights: c_i (N,), not negative, of sum 1.

    Raises:
        ValueError: levels that are not positive, weights off the simplex or not as many.

    Source: Minkowski's inequality, in place of H-infinity quantized fusion, equation (34).
    """
    gamma, c = _check_levels_and_weights(levels, weights)
    return float(c @ gamma)


def fused_error_norm(
    levels: Float[ArrayLike, " N"],
    weights: Float[ArrayLike, " N"],
    disturbances: Float[ArrayLike, " N"],
    matrix: Float[ArrayLike, "outputs n"],
    errors: Float[ArrayLike, "N time n"],
) -> float:
    """Return a bound on ||z - zhat|| of a weighted fusion of quantized estimates, zhat = M sum_i c_i xq_i.

    Each local H-infinity filter i guarantees ||M e_i|| <= gamma_i ||w_i|| for its error e_i and its disturbance w_i.
    Its estimate is sent as xq_i, quantized with an error mu_i, |mu_i| <= D_i by component. The fused error is
    z - zhat = sum c_i (M e_i - M mu_i), so the bound is sum_i c_i (gamma_i ||w_i|| + ||M|| ||D_i||). ||D_i|| is the
    root of the sum of squares over steps and components. NaN where a quantizer saturated: its D is NaN, and nothing is
    guaranteed.

    Args:
        levels: gamma_i (N,).
        weights: c_i (N,), on the simplex.
        disturbances: norms ||w_i|| (N,).
        matrix: output matrix M (outputs, n).
        errors: bounds D_i of the quantizers (N, time, n).

    Raises:
        ValueError: levels that are not positive, weights off the simplex, negative norms or errors, shapes that do not
            fit.

    Source: Minkowski's inequality, in place of H-infinity quantized fusion, equations (34) to (37).
    """
    # Check shapes and signs.
    gamma, c = _check_levels_and_weights(levels, weights)
    norms, m = array("disturbances", disturbances, (len(gamma),)), array("output matrix", matrix, (None, None))
    d = np.asarray(errors, dtype=np.float64)
    if d.ndim != 3 or (d.shape[0], d.shape[2]) != (len(gamma), m.shape[1]):
        raise fail("errors", f"shape ({len(gamma)}, any, {m.shape[1]})", f"shape {d.shape}")
    if np.any(norms < 0) or np.any(d < 0):
        raise fail("disturbances and errors", "no negative number", float(min(norms.min(), np.nanmin(d))))
    # ||M|| ||D_i|| of each node, ||M|| the largest singular value.
    quantization = np.linalg.norm(m, 2) * np.sqrt(np.sum(d**2, axis=(1, 2)))
    return float(c @ (gamma * norms + quantization))


def _check_levels(levels: ArrayLike) -> Float[np.ndarray, "N"]:
    """Return levels gamma_i (N,) as an array; raise ValueError unless all are positive."""
    gamma = np.asarray(array("levels", levels, (None,)))
    if not len(gamma) or np.any(gamma <= 0):
        raise fail("levels", "positive numbers", gamma.tolist())
    return gamma


def _check_levels_and_weights(
    levels: ArrayLike, weights: ArrayLike
) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """Return levels and weights as arrays of one length; raise ValueError unless they fit."""
    gamma = _check_levels(levels)
    return gamma, probabilities("fusion weights", weights, len(gamma))
