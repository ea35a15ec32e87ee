"""Messages of a file in the order in which they arrived, whatever the order of its lines."""

from collections.abc import Sequence
from datetime import datetime
from heapq import heappop, heappush, heappushpop

from heliograph.serving.message import Message, NumberedMessage, Payload, UnreadMessage

HELD = 250_000  # messages that wait for earlier ones


class ArrivalOrder:
    """Messages put in the order of their arrivals, or of their times where those are not known; of equal ones as given.

    What is no message stays behind the one before it. A file of more than `HELD` messages is put in order as far as
    these reach.
    """

    def __init__(self) -> None:
        self._held = list[tuple[float, int, Payload]]()
        self._count, self._last = 0, float("-inf")

    def add(self, payloads: Sequence[Payload]) -> list[Payload]:
        """Return the messages that no longer wait."""
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
        """Return the others."""
        return [heappop(self._held)[2] for _ in range(len(self._held))]

    def _moment(self, payload: Payload) -> float:
        """Return when a payload arrived; what says nothing of that, when the one before it did."""
        message = payload.read if isinstance(payload, UnreadMessage) else payload
        if not isinstance(message, Message | NumberedMessage):
            return self._last
        moment = message.time if message.arrival is None else message.arrival
        return moment.timestamp() if isinstance(moment, datetime) else moment
