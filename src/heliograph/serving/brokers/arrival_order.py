"""Messages of a file in the order in which they arrived, whatever the order of its lines."""

from collections import defaultdict
from collections.abc import Sequence
from datetime import datetime
from heapq import heappop, heappush, heappushpop

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.times.row_order import SECOND, YEAR, find_unset_stamps
from heliograph.serving.message import Message, NumberedMessage, Payload, UnreadMessage

HELD = 250_000  # messages that wait for earlier ones


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
        self._source, self._steps = source, steps
        self._held = list[tuple[float, int, Payload]]()
        self._count, self._last = 0, float("-inf")

    def add(self, payloads: Sequence[Payload]) -> list[Payload]:
        """Take messages; return those that no longer wait, since more than HELD would."""
        results = list[Payload]()
        for payload in payloads:
            self._last = self._moment(payload)
            entry = self._last, self._count, payload
            self._count += 1
            if len(self._held) < HELD:
                heappush(self._held, entry)
            else:
                results.append(heappushpop(self._held, entry)[2])
        return results

    def end(self) -> list[Payload]:
        """Return all messages that still wait, in order."""
        if self._count == len(self._held):  # all are here, so that times can be compared with all others
            self._refuse_astray()
        return [heappop(self._held)[2] for _ in range(len(self._held))]

    def _refuse_astray(self) -> None:
        """Put errors in the place of messages whose times were not set."""
        nodes = defaultdict[tuple[str, str, bool], list[tuple[float, int, Payload]]](list)
        for entry in sorted(self._held, key=lambda entry: entry[1]):
            if isinstance(message := entry[2], Message | NumberedMessage):
                nodes[message.plant, message.node, isinstance(message.time, datetime)].append(entry)
        for (_, node, dated), entries in nodes.items():
            known = any(getattr(message, "arrival", None) is not None for *_, message in entries)
            if known or (self._steps and not dated):
                continue
            times = np.array([moment for moment, *_ in entries])
            for i in np.flatnonzero(find_unset_stamps(times, YEAR / SECOND)):
                moment, number, message = entries[i]
                time = getattr(message, "time", moment)
                where, expected = f"{self._source}, {node}", "a time that was set, near the others in order"
                error = str(fail(where, expected, time.isoformat() if isinstance(time, datetime) else time))
                self._held[self._held.index(entries[i])] = (moment, number, error)

    def _moment(self, payload: Payload) -> float:
        """Return when a payload arrived, or else was measured; for what is no message, the moment of the one before."""
        message = payload.read if isinstance(payload, UnreadMessage) else payload
        if not isinstance(message, Message | NumberedMessage):
            return self._last
        moment = message.time if message.arrival is None else message.arrival
        return moment.timestamp() if isinstance(moment, datetime) else moment
