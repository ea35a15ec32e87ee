"""Messages of a file in the order in which they arrived, whatever the order of its lines."""

from collections import defaultdict
from collections.abc import Sequence
from datetime import datetime
from heapq import heappop, heappush, heappushpop
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.times.timestamp_order import SECOND, YEAR, find_unset_stamps
from heliograph.serving.message import Message, NumberedMessage, Payload, UnreadMessage

HELD = 250_000  # messages that wait for earlier ones


class HeldPayload(NamedTuple):
    """A payload that waits: the moment by which it is ordered, its number among all, and itself."""

    moment: float
    number: int
    payload: Payload


class ArrivalOrder:
    """Puts messages in the order of their arrivals, or of their times where those are not known.

    Messages of equal moments keep their order, and what is no message stays behind the one before it. Of messages that
    say nothing of their arrival, those whose times are more than a year outside of all others of their node were not
    set: each is refused alone, as by a run. A file of more than `HELD` messages is put in order as far as these reach.

    Args:
        source: name of the file, for errors.
        steps: whether times that are numbers are steps, none of which is astray.
    """

    def __init__(self, source: str, steps: bool) -> None:
        """Begin without messages. `source`: name of the file, for errors. `steps`: whether times are step numbers."""
        self._source, self._steps = source, steps
        self._held = list[HeldPayload]()  # a heap, ordered by moment and then by number
        self._count = 0  # how many payloads came so far
        self._last = float("-inf")  # moment of the newest payload, which one that is no message gets too

    def add_messages(self, payloads: Sequence[Payload]) -> list[Payload]:
        """Add messages to those that wait; return the earliest ones, so that at most HELD still wait.

        They are ordered by moment, when they arrived or else were measured, and by number if moments are equal.
        """
        results = list[Payload]()
        for payload in payloads:
            self._last = self._find_moment(payload)
            entry = HeldPayload(self._last, self._count, payload)
            self._count += 1
            if len(self._held) < HELD:
                heappush(self._held, entry)
            else:
                results.append(heappushpop(self._held, entry).payload)
        return results

    def take_rest(self) -> list[Payload]:
        """Return all messages that still wait, in order.

        If no message was returned before, messages whose clock was never set are refused.
        """
        if self._count == len(self._held):  # all messages are here, so that their times can be compared
            self._refuse_unset_times()
        return [heappop(self._held).payload for _ in range(len(self._held))]

    def _refuse_unset_times(self) -> None:
        """Put errors in the place of messages whose times were not set: far from the others of their node.

        This holds for messages that do not say when they arrived. Step numbers are never far.
        """
        # By (plant, node, whether times are dates), in the order of the lines.
        by_node = defaultdict[tuple[str, str, bool], list[HeldPayload]](list)
        for entry in sorted(self._held, key=lambda entry: entry.number):
            if isinstance(message := entry.payload, Message | NumberedMessage):
                by_node[message.plant, message.node, isinstance(message.time, datetime)].append(entry)
        for (_, node, dated), entries in by_node.items():
            has_arrivals = any(getattr(entry.payload, "arrival", None) is not None for entry in entries)
            if has_arrivals or (self._steps and not dated):
                continue
            times = np.array([entry.moment for entry in entries])
            for i in np.flatnonzero(find_unset_stamps(times, YEAR / SECOND)):
                entry = entries[i]
                time = getattr(entry.payload, "time", entry.moment)
                where, expected = f"{self._source}, {node}", "a time that was set, near the others in order"
                error = str(fail(where, expected, time.isoformat() if isinstance(time, datetime) else time))
                self._held[self._held.index(entry)] = entry._replace(payload=error)

    def _find_moment(self, payload: Payload) -> float:
        """Return when a payload arrived, or if that is not known when it was measured.

        The moment is in seconds since 1970, or the number that the message has. A payload that is no message gets the
        moment of the previous payload.
        """
        message = payload.read if isinstance(payload, UnreadMessage) else payload
        if not isinstance(message, Message | NumberedMessage):
            return self._last
        moment = message.time if message.arrival is None else message.arrival
        return moment.timestamp() if isinstance(moment, datetime) else moment
