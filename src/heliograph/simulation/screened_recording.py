"""Measurements of a recording without readings that their nodes refuse, and what is said of these and of silences."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from heliograph.model.checks.refusal_reasons import Reason, count_by_reason, number_of_reason
from heliograph.model.reading_limits import ReadingLimits
from heliograph.model.repeated_readings import Repeats
from heliograph.model.timeouts import find_long_silences
from heliograph.numerics.types import Float, Int
from heliograph.simulation.implausible_data import find_forbidden_rows
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node, ReceivingNode


class ScreenedRecording(NamedTuple):
    """A recording without the readings that its nodes refuse.

    Args:
        measurements: by node, (steps, received), NaN where nothing came or is kept.
        refused: by node the number of the reason of each reading, 0 where it is kept, (steps, received).
        said: what is said of that, of values that the rule of their sender forbids, which stay, and of silences that
            are longer than a node's timeout; a line each.
        repeats: the runs of equal readings with which rows end, by node with limits.
    """

    measurements: dict[str, np.ndarray]
    refused: dict[str, np.ndarray]
    said: list[str]
    repeats: dict[str, Repeats]


def screen_recording(
    network: Network, z: dict[str, np.ndarray], u: np.ndarray, before: Mapping[str, Repeats]
) -> ScreenedRecording:
    """Return the measurements without readings that their nodes refuse, with the reason of each.

    Args:
        network: the network.
        z: by node, (steps, received), NaN where nothing arrived.
        u: inputs (steps, inputs).
        before: the runs of equal readings with which the rows before these ended, by node; {} before the first ones.
    """
    kept, refused, said = dict[str, np.ndarray](), dict[str, np.ndarray](), list[str]()
    repeats = dict[str, Repeats]()
    for name, node in network.nodes.items():
        # Readings beyond limits, codes, and readings that are stuck; none of a node without limits.
        kept[name], refused[name] = z[name], np.zeros(z[name].shape, dtype=np.int8)
        lines = list[str]()
        if node.limits is not None:
            screened = node.limits.screen(z[name], before.get(name, Repeats()))
            repeats[name] = screened.repeats
            kept[name], refused[name] = screened.values, screened.refused.astype(np.int8)
            lines = [
                _describe_refused(reason, node.limits, z[name], refused[name], node)
                for reason in count_by_reason(refused[name])
            ]
        # Values that their sender should not have sent stay.
        if rows := find_forbidden_rows(node, kept[name]):
            lines.append(
                f"{len(rows)} values came that the rule of their sender forbids; row {rows[0] + 1}: "
                "within delta of the value before, and no heartbeat due"
            )
        said += [f"node {name!r}: {line}" for line in lines]
    # Silences longer than a node's timeout.
    timeouts = {name: node.timeout for name, node in network.nodes.items()}
    silences = find_long_silences(timeouts, kept, u, network.inputs)
    said += [f"node {name!r}: {found.describe()}" for name, found in silences.items()]
    return ScreenedRecording(kept, refused, said, repeats)


def _describe_refused(
    reason: Reason,
    limits: ReadingLimits,
    z: Float[np.ndarray, "steps m"],
    refused: Int[np.ndarray, "steps m"],
    node: Node | ReceivingNode,
) -> str:
    """Return how many readings a node refused for one reason, and which they are in the first such row, in words.

    Args:
        reason: the reason.
        limits: of the node.
        z: its measurements, NaN where nothing arrived.
        refused: number of the reason of each reading, 0 where it is kept.
        node: the node.
    """
    # The readings that were refused for this reason alone, in the first row that has some.
    refused_so = np.where(refused == number_of_reason(reason), refused, 0)
    row = int(np.argmax(refused_so.any(axis=1)))
    shares = f"{np.count_nonzero(refused_so)} of {np.count_nonzero(~np.isnan(z))} values"
    description = limits.describe_missing(z[row], refused_so[row], node.received_names)
    return f"{shares} count as not arrived, by {reason}; row {row + 1}: {description}"
