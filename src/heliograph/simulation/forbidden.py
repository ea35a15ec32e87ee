"""Values in a recording that the rule of their sender forbids."""

import numpy as np

from heliograph.model.over_time import first
from heliograph.model.trigger import AbstractThreshold
from heliograph.numerics.types import Float
from heliograph.simulation.node import Listener, Node

RIM = 1e-9  # share of delta by which a value may lie inside for rounding


def forbidden_rows(node: Node | Listener, z: Float[np.ndarray, "steps received"]) -> list[int]:
    """Rows at which a value came though it was within delta of the value before, and no heartbeat was due.

    Only of a sender on delta whose values all arrive as they are: elsewhere no single value is impossible. A filter
    uses such a value and gives it a floor of 1e-6 as its probability.
    """
    trigger = node.trigger if isinstance(node, Node) else None
    if not isinstance(trigger, AbstractThreshold) or trigger.reference != "sent" or trigger.region == "each":
        return []
    assert isinstance(node, Node)  # as it has a trigger
    channel = first(node.channel)
    if channel.erases or channel.remembers or channel.outputs != len(node.outputs):
        return []
    # Each value against the one before it.
    result, last = list[int](), None
    for k, row in enumerate(z[:, : len(node.outputs)]):
        if np.isnan(row).any():
            continue
        if last is not None:
            due = trigger.heartbeat is not None and k - last >= trigger.heartbeat
            error = np.abs(row - z[last, : len(row)])
            delta = (1 - RIM) * np.asarray(trigger.delta)
            inside = np.linalg.norm(error) <= delta if trigger.region == "ball" else np.all(error <= delta)
            if inside and not due:
                result.append(k)
        last = k
    return result
