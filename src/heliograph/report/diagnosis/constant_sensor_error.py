"""A constant error of one sensor of several, found by what it does to all innovations of the filter that joins them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.numerics.types import Bool, Float
from heliograph.report.diagnosis.sensor_output_health import round_to

SMALL = 1e-3  # of an innovation's deviation: the step by which responses are found
MOST = 24  # outputs of which each is tried
CLEAR = 2 * np.log(1000)  # of twice the logarithm of a likelihood ratio: 1000 to 1
LARGEST = 10.0  # response to a step of one: beyond it an angle went around


class ConstantError(NamedTuple):
    """The output whose constant error explains innovations best.

    Args:
        outputs: names of the outputs, of which one has the error; several where they cannot be told apart.
        error: the error of the first of them, in the output's unit.
        standard_error: its standard error if all else is as the model says.
        explained: share of the excess of squared innovations over the claim that the error explains.
        squares: innovations less the error's effect on them, squared, over their variances (time, m).
        white: innovations less the error's effect on them, in units of the filter's claim (time, m).
        size: the error's absolute value, in deviations of the output's innovations.
        significance: mean of what the rows say for the error, over its standard error by their own spread and memory.
        nothing_else: whether the innovations without the error's effect are as the filter claims.
    """

    outputs: tuple[str, ...]
    error: float
    standard_error: float
    explained: float
    squares: np.ndarray
    white: np.ndarray
    size: float
    significance: float
    nothing_else: bool = False

    def __str__(self) -> str:
        """Return the output (or those that it may be) and its error, with half the 95 % interval: "y, of 1.0 ± 0.2"."""
        half_interval = 1.96 * self.standard_error
        size = f"{round_to(self.error, self.standard_error)} ± {round_to(half_interval, self.standard_error)}"
        return f"{' or '.join(self.outputs)}, of {size}"


def find_constant_error(
    names: Sequence[str],
    filter: AbstractFilter,
    measurements: Float[np.ndarray, "time m"],
    inputs: Float[np.ndarray, "time inputs"],
) -> ConstantError | None:
    """Return the output whose constant error explains the innovations best; None with one output or more than MOST.

    A constant b added to output j moves the innovations e of a filter by b r_j, of which the response r_j is found by
    adding a small step. With S their covariance, twice the logarithm of the likelihood ratio of b over 0 is greatest at
    b = sum r_j' S^-1 e / sum r_j' S^-1 r_j, and is (sum r_j' S^-1 e)^2 / sum r_j' S^-1 r_j there (the generalised
    likelihood ratio of Willsky and Jones). So the one that is off is told from those that it pulls away with it.

    An output is left out if nothing arrived of it or its claimed variance is not finite.

    Args:
        names: of the outputs (m).
        filter: a filter that claims a covariance.
        measurements: what it received (time, m), NaN where nothing arrived.
        inputs: its inputs (time, inputs).
    """
    if not 2 <= len(names) <= MOST:
        return None
    outcome = filter.run(measurements, inputs)
    e = np.asarray(outcome.innovations)
    s = np.asarray(outcome.innovation_covariances)
    arrived, variance = ~np.isnan(e), np.diagonal(s, axis1=1, axis2=2)
    # Usual deviation of each output's innovations (m,): root of the median claimed variance, 0 if none arrived.
    by_output = zip(variance.T, arrived.T, strict=True)
    deviations = np.sqrt([np.median(claimed[came]) if came.any() else 0.0 for claimed, came in by_output])
    # Innovations in units of the claim, S^-1/2 e, which are white where it holds.
    whiten = _compute_inverse_square_roots(s, arrived)
    white = np.einsum("tij,tj->ti", whiten, np.where(arrived, e, 0.0))
    # The likeliest error of each output by itself; outputs of which nothing usable arrived are left out.
    candidates = []
    for j in np.flatnonzero((deviations > 0) & np.isfinite(deviations)).tolist():
        response = np.where(arrived, _find_response(filter, measurements, inputs, e, j, deviations), 0.0)
        white_response = np.einsum("tij,tj->ti", whiten, response)
        candidate = _estimate_error(
            output=names[j],
            white=white,
            response=response,
            white_response=white_response,
            received=arrived.any(axis=1),
            deviation=deviations[j],
        )
        if candidate is not None:
            candidates.append(candidate)
    return _choose_likeliest_error(candidates, e, variance, white) if candidates else None


def _choose_likeliest_error(
    candidates: "Sequence[_ErrorCandidate]",
    e: Float[np.ndarray, "time m"],
    variance: Float[np.ndarray, "time m"],
    white: Float[np.ndarray, "time m"],
) -> ConstantError:
    """Return the likeliest of the errors of single outputs, and what innovations are without its effect.

    Args:
        candidates: for each output its likeliest constant error: `gain`, twice the log of its likelihood ratio to no
            error, and `response`, the change of the innovations by an error of one.
        e: innovations, NaN where nothing arrived.
        variance: their variances as the filter states them.
        white: innovations whitened by the covariance that the filter states, 0 where nothing arrived.
    """
    arrived = ~np.isnan(e)
    best = max(candidates, key=lambda candidate: candidate.gain)
    # Outputs whose error explains nearly as much (CLEAR: up to odds of 1000 to 1) cannot be told from the best.
    others = tuple(c.output for c in candidates if c is not best and best.gain - c.gain < CLEAR)
    without_error = np.where(arrived, e - best.error * best.response, np.nan)
    # Squares of white innovations sum to their number, on average, where the claim holds.
    excess = float(np.sum(white**2)) - np.count_nonzero(arrived)
    return ConstantError(
        outputs=(best.output, *others),
        error=best.error,
        standard_error=best.standard_error,
        explained=best.gain / excess if excess > 0 else 0.0,
        squares=without_error**2 / np.where(variance > 0, variance, np.nan),
        white=np.where(arrived, white - best.error * best.white_response, np.nan),
        size=float(best.size),
        significance=float(best.significance),
    )


class _ErrorCandidate(NamedTuple):
    """The likeliest constant error of one output, and what it does to the innovations (time, m).

    gain: twice the logarithm of its likelihood ratio. response: change of the innovations by an error of one, also
    (white_response) in units of the filter's claim. size: the error in deviations of the output's innovations.
    significance: mean of what the rows say for it, over its standard error.
    """

    gain: float
    output: str
    error: float
    standard_error: float
    response: np.ndarray
    white_response: np.ndarray
    size: float
    significance: float


def _estimate_error(
    output: str,
    white: Float[np.ndarray, "time m"],
    response: Float[np.ndarray, "time m"],
    white_response: Float[np.ndarray, "time m"],
    received: Bool[np.ndarray, " time"],
    deviation: float,
) -> _ErrorCandidate | None:
    """Return the likeliest constant error b of one output; None where the innovations do not depend on it.

    If a sensor output has a constant error b, each row's whitened innovation is w = r b + N(0, I), r the response to an
    error of 1. Least squares over all rows gives b = sum r' w / sum r' r, and twice the log likelihood ratio to no
    error is (sum r' w)^2 / sum r' r, the `gain`.

    Args:
        output: name of the output.
        white: innovations w in units of the filter's claim, that is of the covariance that it states (time, m).
        response: change of the innovations by an error of one (time, m).
        white_response: this change in units of the filter's claim: r (time, m).
        received: whether anything arrived in each row (time,).
        deviation: standard deviation of the output's innovations.
    """
    # r' w of each row; sum r' r and sum r' w over all rows.
    row_agreements = np.sum(white_response * white, axis=1)
    weight = float(np.sum(white_response**2))
    agreement = float(np.sum(white_response * white))
    if not (weight > 0 and np.isfinite(agreement)):
        return None
    error = agreement / weight
    # Another test of the same, which does not trust the claim: the mean of r' w over the rows, and the standard error
    # that their own scatter and correlation give it.
    mean, standard_error_of_mean = average_correlated(np.where(received, row_agreements, np.nan))
    return _ErrorCandidate(
        gain=agreement * error,
        output=output,
        error=error,
        standard_error=weight**-0.5,  # of b, if the claim holds
        response=response,
        white_response=white_response,
        size=abs(error) / deviation,
        significance=abs(mean) / standard_error_of_mean if standard_error_of_mean > 0 else 0.0,
    )


def _find_response(
    filter: AbstractFilter,
    measurements: Float[np.ndarray, "time m"],
    inputs: Float[np.ndarray, "time inputs"],
    innovations: Float[np.ndarray, "time m"],
    output: int,
    deviations: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "time m"]:
    """Return the derivative of all innovations by a constant error of one output, 0 where an angle jumped by a turn.

    It is a difference quotient: the filter is run again with a small step added to the output's measurements. SMALL is
    1e-3 deviations, LARGEST 10.

    Args:
        filter: the filter.
        measurements: what it received (time, m).
        inputs: its inputs (time, inputs).
        innovations: its innovations without the step (time, m).
        output: index of the output.
        deviations: usual standard deviations of the outputs' innovations (m,); the step is SMALL of the output's.
    """
    step = SMALL * deviations[output]
    moved = np.array(measurements, dtype=float)
    moved[:, output] += step
    response = (np.asarray(filter.run(moved, inputs).innovations) - innovations) / step
    # An error of one deviation of the output moves no innovation by LARGEST deviations, unless an angle has jumped.
    return np.where(np.abs(response) * deviations[output] < LARGEST * deviations, response, 0.0)


def _compute_inverse_square_roots(s: Float[np.ndarray, "time m m"], arrived: Float[np.ndarray, "time m"]) -> np.ndarray:
    """Return S^(-1/2) of each row, (time, m, m), over the components that arrived, and zero for the others.

    A row whose S is not finite is zero. A direction with an eigenvalue of S that is not positive gets zero.
    """
    both_arrived = np.asarray(arrived[:, :, None] & arrived[:, None, :])  # components i and j of a row
    # Ones on the diagonal stand for what did not arrive, or is not finite, so that all rows are inverted at once.
    identity = np.eye(s.shape[1])
    filled = np.where(both_arrived, s, identity)
    is_finite = np.asarray(np.isfinite(filled).all(axis=(1, 2)))
    filled = np.where(is_finite[:, None, None], filled, identity)
    # S = V diag(eigenvalues) V', so that S^(-1/2) = V diag(eigenvalues^(-1/2)) V'.
    eigenvalues, vectors = np.linalg.eigh(filled)
    inverse_roots = np.where(eigenvalues > 0, np.abs(eigenvalues), np.inf) ** -0.5
    inverse_root_of_s = np.einsum("tij,tj,tkj->tik", vectors, inverse_roots, vectors)
    return np.asarray(np.where(both_arrived & is_finite[:, None, None], inverse_root_of_s, 0.0))
