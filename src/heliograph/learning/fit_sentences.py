"""Sentences of a fit: on climbs that ended early or apart, numbers at the end of their domain, forms that disagree."""

import numpy as np

from heliograph.learning.estimate_table import Solution
from heliograph.numerics.types import Float

LOWER_END = 0.01  # of the log-likelihood: a start that ends so far below the best ended elsewhere
FORMS_APART = 3.0  # standard errors between the two forms that suggest an error of the model


def describe_unfinished_climbs(
    solutions: tuple[Solution, ...], ends: Float[np.ndarray, " starts"], stopped: bool
) -> list[str]:
    """Return the sentences on climbs that were stopped, did not converge, or ended below the best.

    Args:
        solutions: the maximum of each form.
        ends: log-likelihood at which the climb of the first form from each start ended (starts,); NaN where nowhere.
        stopped: whether the search was interrupted.
    """
    sentences = []
    if stopped:
        sentences.append("Stopped before the end: this is the best so far.")
    for solution in solutions:
        if not solution.converged and not stopped:
            why = f"The {solution.form} form did not converge: {solution.top.reason}."
            sentences.append(f"{why} The estimates are the best point found.")
    # How far below the best each start ended; those within LOWER_END ended at the same maximum.
    below = solutions[0].total - ends
    lower = np.count_nonzero(~(below < LOWER_END))
    if lower and not stopped:
        least = np.nanmin(np.where(below < LOWER_END, np.nan, below))
        sentences.append(f"Best of {len(below)} starts, of which {lower} ended lower, by {least:.3g} or more.")
    return sentences


def describe_boundaries(best: Solution) -> list[str]:
    """Return a sentence on each number whose estimate is the end of its domain, such as a variance of 0."""
    return [f"{row.name}: {row.value}, {row.interval} (95 %)." for row in best.rows() if row.boundary]


def describe_form_conflict(solutions: tuple[Solution, ...]) -> list[str]:
    """Return a sentence for each number on which the two forms of the likelihood disagree beyond their errors.

    They disagree if the estimates differ by more than FORMS_APART times the larger standard error. `solutions`: the
    maximum of each form, linear and conditional; of one form alone there is nothing to compare.
    """
    if len(solutions) < 2:
        return []
    sentences = []
    for a, b in zip(*(solution.rows() for solution in solutions), strict=True):
        distance = abs(a.estimate - b.estimate) / max(a.standard_error, b.standard_error)
        if np.isfinite(distance) and distance > FORMS_APART:
            sentences.append(
                f"{a.name}: the two forms of the likelihood disagree by {distance:.1f} standard errors "
                f"({a.estimate:.4g} and {b.estimate:.4g}), so that the model is in doubt."
            )
    return sentences
