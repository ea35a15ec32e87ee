"""One step of a trust-region search, of many climbs at once: the best point of a quadratic model within a radius."""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float

FLAT_EIGENVALUE = 1e-10  # eigenvalue of the scaled information below which a direction is not identified
SECULAR_STEPS = 20  # Newton steps for the shift s at most; a few are enough
LONGEST_LOGARITHM = 5.0  # step of a logarithm or a logit: a factor of 150
ROUNDING = 1e-14  # of a matrix's eigenvalues, as a share of the largest
MARGIN_OF_SHIFT = 1e-6  # relative: how far beyond the least shift that makes a matrix positive the search begins
LEAST_INFORMATION = 1e-150  # information, of which the square is a number
LARGEST_CURVATURE = 1e12  # curvature in units of standard errors: beyond this a model is taken for rounding


class TrustRegionStep(NamedTuple):
    """The next step of each climb.

    Args:
        step: p, the change of the point (climbs, p).
        length: its length |D p| in the units of the trust region's radius, standard errors (climbs,).
        predicted: gain of log-likelihood that the model predicts, g' p - p' B p / 2, in nats (climbs,).
    """

    step: Float[np.ndarray, "climbs p"]
    length: Float[np.ndarray, " climbs"]
    predicted: Float[np.ndarray, " climbs"]


def trust_region_step(
    gradient: np.ndarray,
    information: np.ndarray,
    model: np.ndarray,
    radius: np.ndarray,
    moving: np.ndarray,
    free: np.ndarray,
) -> TrustRegionStep:
    """Return the step p that maximises g' p - p' B p / 2 over |D p| <= radius, its length |D p|, and the gain at p.

    It is p = (B + s D^2)^-1 g. The shift s >= 0 is the least for which B + s D^2 is not indefinite and |D p| <= radius;
    it is found by Newton's method for 1 / |D p| = 1 / radius.

    All is computed in units u of standard errors, in which B is of order 1; scaled by a diagonal, a matrix is solved as
    exactly as without. D is 1, but max(1, radius u / LONGEST_LOGARITHM) where a logarithm moves, so that it moves by
    LONGEST_LOGARITHM at most. To B is added v v' for each direction v that is not identified: its gradient is but
    rounding, and would else lead far.

    Args:
        gradient: g (climbs, p).
        information: its diagonal gives the standard errors (climbs, p, p).
        model: B, minus the Hessian or near it; it may be indefinite (climbs, p, p). Where it is not finite, or huge,
            the information takes its place.
        radius: of the trust region (climbs,).
        moving: which coordinates may move (climbs, p).
        free: which are no logarithms or logits, and so not limited by LONGEST_LOGARITHM (p,).

    Returns:
        p (climbs, p), |D p| (climbs,) and g' p - p' B p / 2 (climbs,).
    """
    # g, D and B in standard errors. A coordinate that stays has a unit of 0 and 1 on the diagonals of D and B, so that
    # its step is 0. Columns of `flat` are the directions that are not identified, in these units.
    unit, flat = find_errors_and_flat_directions(information, moving)
    stays = unit == 0
    d = np.where(free | stays, 1.0, np.maximum(1.0, radius[:, None] * unit / LONGEST_LOGARITHM))
    g = np.nan_to_num(gradient) * unit
    b = _scale_model(model, information, unit)  # u B u, or u I u where B is not finite or huge
    b = (b + b.swapaxes(1, 2)) / 2 + flat @ flat.swapaxes(1, 2) + np.eye(len(free)) * stays[:, :, None]
    # The step on or within the radius; one that is up to a hundredth longer is shortened to it.
    step = _find_step_within(radius, g, b, d)
    length = np.linalg.norm(d * step, axis=1)
    factor = np.minimum(1.0, radius / np.where(length > 0, length, 1.0))
    step = step * factor[:, None]
    length = length * factor
    # What the model gains there: g' p - p' B p / 2.
    predicted = np.sum(step * (g - multiply_each(b, step) / 2), axis=1)
    return TrustRegionStep(step=step * unit, length=length, predicted=predicted)


def _scale_model(model: np.ndarray, information: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return U B U (climbs, p, p) for each climb's model B, or for its information if B is huge or not finite.

    U = diag(unit), with the standard errors `unit` (climbs, p). A climb is one of several searches side by side.
    LARGEST_CURVATURE: a curvature beyond it, in these units, is only rounding.
    """
    scaled_model = _scale_both_sides(model, unit)
    is_usable = np.all(np.abs(scaled_model) < LARGEST_CURVATURE, axis=(1, 2))  # neither huge nor NaN
    return np.where(is_usable[:, None, None], scaled_model, _scale_both_sides(information, unit))


def _find_step_within(radius: np.ndarray, g: np.ndarray, b: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return p = (B + s D^2)^-1 g (climbs, p) with the least shift s >= 0 that keeps |D p| within 1.01 of the radius.

    The shift is found by Newton's method for 1 / |D p| = 1 / radius, which is nearly linear in s. It begins at the
    least s that makes the matrix positive. Eigenvalues above -ROUNDING count as not negative; the first shift lies
    MARGIN_OF_SHIFT beyond the least one, relative. At most SECULAR_STEPS (20) steps are made.

    Args:
        radius: of the trust region (climbs,).
        g: gradient (climbs, p).
        b: B, minus the Hessian or near it (climbs, p, p).
        d: diagonal of D (climbs, p).
    """
    # D^-1 B D^-1 + s I is positive for s above minus the least eigenvalue.
    least = np.linalg.eigvalsh(b / d[:, :, None] / d[:, None, :])[:, 0]
    shift = np.where(least > -ROUNDING, 0.0, -least * (1 + MARGIN_OF_SHIFT))
    for _ in range(SECULAR_STEPS):
        step = _solve_shifted(b, shift, d, g)
        length = np.linalg.norm(d * step, axis=1)
        beyond = length > 1.01 * radius
        if not beyond.any():
            break
        # Newton's step for 1 / |D p| - 1 / radius: |D p|^2 / slope (|D p| - radius) / radius.
        slope = np.sum(d * d * step * _solve_shifted(b, shift, d, d * d * step), axis=1)  # -|D p| d|D p| / ds
        newton = length**2 / np.where(beyond, slope, 1.0) * (length - radius) / radius
        shift = np.where(beyond, shift + newton, shift)
    return step


def _solve_shifted(b: np.ndarray, shift: np.ndarray, d: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return (B + s D^2)^-1 r of each climb (climbs, p), or 0 along directions in which the matrix is singular.

    An eigenvalue below ROUNDING times the largest counts as 0.

    Args:
        b: B of each climb, one of several searches side by side (climbs, p, p).
        shift: s (climbs,).
        d: diagonal of D (climbs, p).
        right: r (climbs, p).
    """
    matrix = b + (shift[:, None] * d * d)[:, :, None] * np.eye(b.shape[1])
    try:
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])
    except np.linalg.LinAlgError:  # a pivot that is exactly 0
        return multiply_each(np.linalg.pinv(matrix, ROUNDING, hermitian=True), right)


def expected_gain(
    gradient: np.ndarray, information: np.ndarray, counting: Bool[np.ndarray, "climbs p"]
) -> Float[np.ndarray, " climbs"]:
    """Return g' I^-1 g (climbs,), twice what a full step gains: gradient g (climbs, p), information I (climbs, p, p).

    Only coordinates marked in `counting` (climbs, p) and identified directions count. A direction with an eigenvalue of
    at most FLAT_EIGENVALUE, in units of standard errors, is not identified. The matrix is solved in units of standard
    errors, in its eigenvectors.

    Args:
        gradient: g (climbs, p).
        information: I (climbs, p, p).
        counting: coordinates that count (climbs, p).
    """
    unit, _ = find_errors_and_flat_directions(information, counting)
    scaled = _scale_both_sides(information, unit)
    eigenvalues, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    components = np.einsum("lij,li->lj", vectors, np.nan_to_num(gradient) * unit)  # of g along the eigenvectors
    is_identified = eigenvalues > FLAT_EIGENVALUE
    gains = np.where(is_identified, components**2 / np.where(is_identified, eigenvalues, 1.0), 0.0)
    return np.asarray(np.sum(gains, axis=1))


def find_errors_and_flat_directions(information: np.ndarray, moving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each coordinate's standard error if all others were known (climbs, p), and the flat directions.

    Each climb is a point with its `information` I (climbs, p, p); the errors are 1 / sqrt(I_ii), or 0 of coordinates
    that are not `moving`. A flat direction is an eigenvector of I_ij / sqrt(I_ii I_jj) without information, eigenvalue
    <= FLAT_EIGENVALUE. It is a column of the result (climbs, p, p), in units of the errors; the columns of other
    eigenvectors are 0.

    Args:
        information: I of each climb (climbs, p, p).
        moving: coordinates that move (climbs, p).
    """
    diagonal = np.diagonal(information, axis1=1, axis2=2)
    # Information below LEAST_INFORMATION counts as none, since its square would underflow.
    has_information = moving & (diagonal > LEAST_INFORMATION) & np.isfinite(diagonal)
    errors = np.where(has_information, 1 / np.sqrt(np.where(has_information, diagonal, 1.0)), 0.0)
    scaled = _scale_both_sides(information, errors)
    eigenvalues, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    is_flat = eigenvalues <= FLAT_EIGENVALUE
    return errors, np.where(is_flat[:, None, :], vectors, 0.0) * has_information[:, :, None]


def _scale_both_sides(matrix: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Return U A U (climbs, p, p), U = diag(unit), `unit` (climbs, p); 0 in rows and columns whose unit is 0."""
    stays = (unit == 0)[:, :, None] | (unit == 0)[:, None, :]
    return np.where(stays, 0.0, matrix * unit[:, :, None] * unit[:, None, :])


def multiply_each(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the product A x of each climb, (climbs, p), of matrices A (climbs, p, p) and vectors x (climbs, p)."""
    return np.asarray(np.einsum("lij,lj->li", matrix, vector))
