"""Sentences of a fit: on numbers at the end of their domain, and on forms of the likelihood that disagree."""

import numpy as np

from heliograph.learning.likelihood_maximum import Solution

APART = 3.0  # standard errors between the two forms that suggest an error of the model


def describe_boundaries(best: Solution) -> list[str]:
    """Return the sentences on numbers at the end of their domain."""
    return [f"{row.name}: {row.value}, {row.interval} (95 %)." for row in best.rows() if row.boundary]


def describe_forms(solutions: tuple[Solution, ...]) -> list[str]:
    """Return sentences on numbers on which the two forms of the likelihood disagree beyond their errors."""
    if len(solutions) < 2:
        return []
    sentences = []
    for a, b in zip(*(solution.rows() for solution in solutions), strict=True):
        distance = abs(a.estimate - b.estimate) / max(a.standard_error, b.standard_error)
        if np.isfinite(distance) and distance > APART:
            sentences.append(
                f"{a.name}: the two forms of the likelihood disagree by {distance:.1f} standard errors "
                f"({a.estimate:.4g} and {b.estimate:.4g}), so that the model is in doubt."
            )
    return sentences
