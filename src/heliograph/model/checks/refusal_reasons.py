"""Why a reading that came counts as missing: one list of reasons, for recordings, live objects, pages and metrics."""

from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np

from heliograph.numerics.check import InputError
from heliograph.numerics.types import Int

Reason = Literal["limits", "code", "stuck", "flag", "counter", "implausible", "gate"]
REASONS: tuple[Reason, ...] = get_args(Reason)

# Reasons of a node, before any filter: of single readings, and of whole messages.
SCREENED: tuple[Reason, ...] = ("limits", "code", "stuck")
OF_MESSAGES: tuple[Reason, ...] = ("flag", "counter")
OF_NODES = (*SCREENED, *OF_MESSAGES)

WORDS: dict[Reason, str] = {
    "limits": "beyond the limits of its node",
    "code": "a code, which is no reading",
    "stuck": "equal for longer than its noise allows: it is stuck",
    "flag": "of a message that says it cannot be trusted",
    "counter": "of a message whose count has another modulus",
    "implausible": "implausible to all filters of its node",
    "gate": "left out by a filter, with a weight of 0",
}


class RefusedError(InputError):
    """A message that is refused for one of these reasons, in the words of an error."""

    def __init__(self, reason: Reason, error: InputError):
        """Make the error with the words of `error`, and the reason under which the refused message is counted."""
        super().__init__(str(error))
        self.reason: Reason = reason


def number_of_reason(reason: Reason) -> int:
    """Return the number that stands for a reason in an array, from 1; 0 stands for a reading that is kept."""
    return 1 + REASONS.index(reason)


def count_by_reason(refused: Int[np.ndarray, "time m"]) -> dict[Reason, Int[np.ndarray, " m"]]:
    """Count the refused readings of each component (m,), by reason; reasons without refusals are left out.

    Args:
        refused: the number of each reading's reason (time, m), 0 if it is kept.
    """
    counts = {reason: np.count_nonzero(refused == number_of_reason(reason), axis=0) for reason in REASONS}
    return {reason: count for reason, count in counts.items() if count.any()}


def describe_counts(counts: Mapping[Reason, int]) -> str:
    """Say how many were refused, by reason: "12 by limits, 3 by stuck"; "" where none was."""
    return ", ".join(f"{count:,} by {reason}" for reason, count in counts.items() if count)
