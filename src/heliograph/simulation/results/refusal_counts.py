"""Readings of a recording that were refused, counted by reason."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from heliograph.filters.innovation import Weighed
from heliograph.model.checks.refusal_reasons import Reason, count_by_reason, number_of_reason
from heliograph.numerics.module import readable


@readable
@dataclass(frozen=True)
class Refusal:
    """How many readings of one component were refused for one reason.

    Args:
        node: name of the node, or "fused" of a filter in the centre.
        filter: the filter that left them out alone; "" where the node did, for all of them.
        component: place of the component among what is received.
        reason: "limits", "code", "stuck" or "implausible" by the node, "gate" by the filter.
        count: how many readings.
        row: the first of them, from 0.
    """

    node: str
    filter: str
    component: int
    reason: Reason
    count: int
    row: int


def list_refusals(
    refused: Mapping[str, np.ndarray], weighed: Mapping[str, Mapping[str, Weighed]]
) -> tuple[Refusal, ...]:
    """Count what nodes refused, and what filters that weigh left out, by component and reason.

    Args:
        refused: for each node, the number of each reading's reason (time, received), 0 if it is kept.
        weighed: for each node and filter, the weights of the components (time, received), NaN if nothing arrived.
    """
    refusals = [refusal for node, reasons in refused.items() for refusal in _count_refusals(node, "", reasons)]
    for node, filters in weighed.items():
        for filter, weighed_innovations in filters.items():
            # A weight of 0 means that the filter left the reading out, which is the reason "gate".
            is_left_out = np.asarray(weighed_innovations.weight) == 0
            refusals += _count_refusals(node, filter, np.where(is_left_out, number_of_reason("gate"), 0))
    return tuple(refusals)


def _count_refusals(node: str, filter: str, refused: np.ndarray) -> Iterator[Refusal]:
    """Yield, by component and reason, how many readings were refused, and the row of the first one.

    `filter`: name of the filter that refused, or "" if the node did. `refused`: number of each reading's reason
    (time, received), 0 if it is kept.
    """
    for reason, counts in count_by_reason(refused).items():
        for i in np.flatnonzero(counts).tolist():
            row = int(np.argmax(refused[:, i] == number_of_reason(reason)))
            yield Refusal(node, filter, i, reason, int(counts[i]), row)
