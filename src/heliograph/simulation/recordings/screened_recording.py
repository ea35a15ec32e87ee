"""Measurements of a recording without readings that their nodes refuse, and what is said of these and of silences."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.model.checks.refusal_reasons import Reason, count_by_reason, number_of_reason
from heliograph.model.over_time import first
from heliograph.model.readings.reading_limits import ReadingLimits
from heliograph.model.readings.repeated_readings import Repeats
from heliograph.model.readings.timeouts import find_long_silences
from heliograph.model.trigger import AbstractThreshold, Periodic
from heliograph.numerics.types import Bool, Float, Int
from heliograph.simulation.node import Node, ReceivingNode

RIM = 1e-9  # share of delta by which a value may lie inside for rounding


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
    nodes: Mapping[str, Node | ReceivingNode],
    inputs: Sequence[str],
    z: dict[str, np.ndarray],
    u: np.ndarray,
    before: Mapping[str, Repeats],
) -> ScreenedRecording:
    """Return the measurements without readings that their nodes refuse, with the reason of each refusal.

    A node with limits refuses readings beyond them, error codes of the sensor, and readings of a sensor that is stuck.
    The result also has lines of text for the user on refused readings, on values that the sender's rule forbids, and on
    silences longer than a node's timeout.

    Args:
        nodes: nodes of the network, by name.
        inputs: names of the plant's inputs.
        z: measurements by node, (steps, received), NaN where nothing arrived.
        u: inputs (steps, inputs).
        before: the runs of equal readings with which the rows before these ended, by node, so that a stuck sensor is
            seen across calls; {} before the first rows.
    """
    accepted, refused, lines_to_say = dict[str, np.ndarray](), dict[str, np.ndarray](), list[str]()
    repeats = dict[str, Repeats]()
    for name, node in nodes.items():
        # Without limits all is accepted; `refused` has a code of the reason for each value, 0 for none.
        accepted[name], refused[name] = z[name], np.zeros(z[name].shape, dtype=np.int8)
        lines = list[str]()
        if node.limits is not None:
            screened = node.limits.screen(z[name], before.get(name, Repeats()))
            repeats[name] = screened.repeats
            accepted[name], refused[name] = screened.values, screened.refused.astype(np.int8)
            if isinstance(node, Node) and node.trigger is not None:
                left = node.trigger.leave_out_refused(z[name], refused[name] > 0, len(node.outputs))
                accepted[name] = np.asarray(left)
            lines = [
                _describe_refused(reason, node.limits, z[name], refused[name], node) + say_taken_for_silence(node)
                for reason in count_by_reason(refused[name])
            ]
        # A sender with a rule (send on delta) should not have sent these values. They are reported, but stay in use.
        if rows := find_forbidden_rows(node, accepted[name], np.any(refused[name], axis=1)):
            lines.append(
                f"{len(rows)} values came that the rule of their sender forbids; row {rows[0] + 1}: "
                "within delta of the value before, and no heartbeat due"
            )
        lines_to_say += [f"node {name!r}: {line}" for line in lines]
    # Silences longer than a node's timeout.
    timeouts = {name: node.timeout for name, node in nodes.items()}
    silences = find_long_silences(timeouts, accepted, u, inputs)
    lines_to_say += [f"node {name!r}: {silence.describe()}" for name, silence in silences.items()]
    return ScreenedRecording(measurements=accepted, refused=refused, said=lines_to_say, repeats=repeats)


def leave_out_values(node: Node | ReceivingNode, z: Float[np.ndarray, "rows received"]) -> np.ndarray:
    """Return rows of a node of which no value counts: NaN in place of values, so that they are missing.

    A sender with a trigger also tells, beside its values, of messages that were lost: that side information stays.
    """
    trigger = node.trigger if isinstance(node, Node) else None
    if trigger is None:
        return np.full_like(z, np.nan)
    is_value = np.arange(z.shape[1]) < z.shape[1] - trigger.side_information(len(node.outputs))
    return np.asarray(trigger.leave_out_refused(z, np.broadcast_to(is_value, z.shape), len(node.outputs)))


def say_taken_for_silence(node: Node | ReceivingNode) -> str:
    """Return what to add to a line on refused values if filters take them for silence of the node's sender; else "".

    A sender that decides by its value sent one that is refused, too. Where the receiver is not told of losses, a filter
    cannot know that, and takes its absence for a value near the last one.
    """
    trigger = node.trigger if isinstance(node, Node) else None
    if trigger is None or isinstance(trigger, Periodic) or trigger.losses != "unknown":
        return ""
    return '; its sender\'s losses are "unknown", so that it is taken for silence, and errors exceed the claims'


def _describe_refused(
    reason: Reason,
    limits: ReadingLimits,
    z: Float[np.ndarray, "steps m"],
    refused: Int[np.ndarray, "steps m"],
    node: Node | ReceivingNode,
) -> str:
    """Return in words how many readings a node refused for one reason, and those of the first such row.

    Args:
        reason: the reason.
        limits: limits of the node's readings.
        z: its measurements, NaN where nothing arrived.
        refused: number of the reason of each reading, 0 where it is kept.
        node: the node.
    """
    # Keep only readings refused for this reason, and find the first row that has some.
    refused_so = np.where(refused == number_of_reason(reason), refused, 0)
    row = int(np.argmax(refused_so.any(axis=1)))
    values = (
        z
        if not isinstance(node, Node) or node.trigger is None
        else z[:, : -node.trigger.side_information(len(node.outputs)) or None]
    )
    shares = f"{np.count_nonzero(refused_so)} of {np.count_nonzero(~np.isnan(values))} values"
    description = limits.describe_missing(z[row], refused_so[row], node.received_names)
    return f"{shares} count as not arrived, by {reason}; row {row + 1}: {description}"


def find_forbidden_rows(
    node: Node | ReceivingNode, z: Float[np.ndarray, "steps received"], refused: Bool[np.ndarray, " steps"]
) -> list[int]:
    """Return the rows with values that their sender's rule forbids: no further than delta from the last value sent.

    Such rows show that the network describes the sender wrongly. A sender on delta sends if its measurement differs
    from the value that it sent last by more than delta, in its norm (region "ball") or in some component, or if a
    heartbeat is due after so many steps. Rules that compare with a prediction, or send each component by itself (region
    "each"), are not judged; nor are channels that lose or change what is sent. Forbidden values are used all the same.

    Args:
        node: a node of the network, with its sender's rule (`trigger`) if it has one.
        z: the node's measurements, NaN where nothing came or is kept.
        refused: rows of which a value was refused; the sender goes on from that value, so that the next is not judged.
    """
    trigger = node.trigger if isinstance(node, Node) else None
    if not isinstance(trigger, AbstractThreshold) or trigger.reference != "sent" or trigger.region == "each":
        return []
    assert isinstance(node, Node)  # as it has a trigger
    channel = first(node.channel)
    arrives_as_sent = not channel.erases and not channel.remembers and channel.outputs == len(node.outputs)
    if not arrives_as_sent:
        return []
    # Compare each row that arrived with the one that arrived before it; RIM leaves room for rounding.
    forbidden, last_row = list[int](), None
    for k, row in enumerate(z[:, : len(node.outputs)]):
        if np.isnan(row).any():
            last_row = None if refused[k] else last_row
            continue
        if last_row is not None:
            heartbeat_is_due = trigger.heartbeat is not None and k - last_row >= trigger.heartbeat
            change = np.abs(row - z[last_row, : len(row)])
            delta = (1 - RIM) * np.asarray(trigger.delta)
            is_within = np.linalg.norm(change) <= delta if trigger.region == "ball" else np.all(change <= delta)
            if is_within and not heartbeat_is_due:
                forbidden.append(k)
        last_row = k
    return forbidden
