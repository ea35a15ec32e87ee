"""Counts of a node's messages by verdict, of lost ones (gaps in its running count), and of long silences."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from heliograph.live.clock_leap import Moments
from heliograph.live.event import CheckedEvent, Verdict
from heliograph.model.checks.refusal_reasons import Reason
from heliograph.model.readings.repeated_readings import Repeats

NO_REPEATS, NONE = Repeats(), dict[Reason, int]()  # no reading has come; nothing is refused
GAP = 1 << 14  # more messages in a row are not lost: the count began anew (LoRaWAN's MAX_FCNT_GAP)


class ScreenedEvent(NamedTuple):
    """An event without the values that count as not arrived.

    Args:
        event: the event, NaN for these values.
        refused: how many the node refuses, by reason that there is.
        why: which and why, in words.
        repeats: runs of equal readings of the node that end with this event.
    """

    event: CheckedEvent
    refused: Mapping[Reason, int] = NONE
    why: str = ""
    repeats: Repeats = NO_REPEATS

    @property
    def is_empty(self) -> bool:
        """Return whether values were removed and none is left."""
        return bool(self.why) and all(value != value for value in self.event.values)


@dataclass
class LinkCounts:
    """Counts of the messages of a node by verdict, and its running count, in which gaps are lost messages.

    The running count of the node goes from `first` to `newest`, which was measured at time `at`. A smaller number with
    a later time means that the node was restarted; a larger one with an earlier time is from before the restart.

    Attributes:
        first: smallest running count since the node's last start; -1 before the first message.
        newest: greatest running count since then.
        at: time of the measurement with the greatest count.
        lost: gaps in the running count that no message has filled.
        used, duplicate, conflict, late, future, implausible: numbers of messages by verdict.
        refused: by reason, single values that the node refuses, and messages for their flag or counter; until version
            0.4.0 one number, of those beyond limits and codes.
        latest: time of the newest measurement that was used; -1 before the first.
        repeats: newest readings, and how many in a row are equal to them, of a node that watches for it.
        timeouts: silences longer than the timeout of the node that a message has ended, in order of arrival.
    """

    first: int = -1
    newest: int = -1
    at: float = 0.0
    lost: int = 0
    used: int = 0
    duplicate: int = 0
    conflict: int = 0
    late: int = 0
    future: int = 0
    implausible: int = 0
    refused: "dict[Reason, int]" = field(default_factory=dict)
    latest: float = -1.0
    repeats: "Repeats" = field(default_factory=Repeats)
    timeouts: int = 0

    def __post_init__(self) -> None:
        """Convert fields that were read from a store: runs of equal readings, and refusals.

        Until version 0.4.0 refusals were one number, which is counted for the reason "limits".
        """
        self.repeats = Repeats.read(self.repeats)
        if isinstance(self.refused, int):
            self.refused = {"limits": self.refused} if self.refused else {}

    def count_screened(self, screened: ScreenedEvent, verdict: Verdict) -> None:
        """Count the values of an event that were refused, and take over its runs of equal readings.

        A copy of an event, or an event of a wrong time, does not count.
        """
        if verdict in ("used", "implausible"):
            for reason, count in screened.refused.items():
                self.count_refused(reason, count)
            self.repeats = screened.repeats

    def count_refused(self, reason: Reason, count: int = 1) -> None:
        """Count readings, or messages, that are refused for a reason."""
        self.refused = {**self.refused, reason: self.refused.get(reason, 0) + count}  # others keep what they copied

    @property
    def held(self) -> int:
        """Return how many runs of equal readings were longer than the sensor's noise allows, over all components."""
        return sum(self.repeats.found)

    def count_timeout(self, time: float, begun: float, timeout: float) -> None:
        """Count the silence that ends with a message of `time`, if it was longer than the timeout of its node.

        `begun`: when the silence began if the node has sent nothing before. Call this before `count`, which moves
        `latest`, the time of the newest measurement used, to this message.
        """
        silent_since = self.latest if self.used else begun
        self.timeouts += time - silent_since > timeout

    def count(self, verdict: Verdict, sequence: int, time: float, period: int = 0) -> None:
        """Count one message; a late, implausible or future message was received too, so it fills a gap.

        `period`: after how many messages the running count begins again at 0; 0 if it never does.
        """
        self.count_verdict(verdict)
        self._follow_sequence(verdict, sequence, time, period)

    def count_verdict(self, verdict: Verdict) -> None:
        """Count one verdict, but do not follow a running count, as for inputs that share a measurement's message."""
        # Each verdict has a count of the same name.
        setattr(self, verdict, getattr(self, verdict) + 1)

    def count_unread(self, sequence: int, time: float, period: int = 0) -> None:
        """Count a message of which only count and time could be read: it has no verdict, and fills a gap."""
        self._follow_sequence(None, sequence, time, period)

    def _follow_sequence(self, verdict: Verdict | None, sequence: int, time: float, period: int) -> None:
        """Update `first`, `newest`, `at` and `lost` from the running count that one message carries.

        The sender numbers its messages. `first` and `newest` are the least and the greatest number since its last
        start, `at` the time of the newest, and `lost` how many numbers between them no message has brought.

        Args:
            verdict: what became of the message: "used", or why it was not ("duplicate", "conflict" of two with one
                number, "late", "future", "implausible"); None where only its count and time could be read.
            sequence: the running count as sent.
            time: when the message was measured.
            period: after how many messages the sender counts from 0 again; 0 if it never does.
        """
        sequence = self._unwrap_count(sequence, time, period)
        if verdict == "used":
            is_first_used = self.used == 1  # it is counted already; times before it say nothing
            self.latest = time if is_first_used else max(self.latest, time)
            # The number after the newest, as of nearly all messages: nothing was lost.
            if sequence - 1 == self.newest >= 0 and time >= self.at:
                self.newest, self.at = sequence, time
                return
        # A second copy of a message says nothing that the first did not.
        if verdict in ("duplicate", "conflict"):
            return
        # A time that may be wrong says nothing of the order: take the newest's time, so that it means no restart.
        if verdict in ("future", "implausible", None):
            time = self.at
        # The first message; or a smaller number at a later time, since the sender was restarted: count from here.
        if self.newest < 0 or (sequence < self.newest and time > self.at):
            self.first, self.newest, self.at = sequence, sequence, time
        # Above the newest: the numbers between are lost until they arrive. A larger number at an earlier time is from
        # before a restart, and left out, unless it is the very next one: then the clock was set back.
        elif sequence > self.newest:
            if time >= self.at or sequence - 1 == self.newest:
                self.lost += sequence - self.newest - 1
                self.newest, self.at = sequence, max(time, self.at)
        # Below the newest only a used message fills a gap: any other may have been counted when it first arrived.
        elif verdict != "used":
            return
        # Before the first: the numbers between these two are lost until they arrive.
        elif sequence < self.first:
            self.lost += self.first - sequence - 1
            self.first = sequence
        # Between the first and the newest: it was not lost, others had overtaken it.
        elif sequence < self.newest:
            self.lost = max(self.lost - 1, 0)

    def _unwrap_count(self, sequence: int, time: float, period: int) -> int:
        """Return a running count that goes on although the node's own begins again at 0 after `period` messages.

        `newest` is the greatest count so far, -1 before the first message, and `at` the time of its measurement. The
        result is the nearest count above `newest` for a later measurement, and below it for an earlier one. If that is
        more than GAP away, the node was restarted, and its own count is returned. GAP is how many messages may be lost
        in a row.
        """
        if not period or self.newest < 0:
            return sequence
        ahead = (sequence - self.newest) % period  # least number of counts from `newest` on to a count that is sent so
        behind = (self.newest - sequence) % period
        if time >= self.at:
            return self.newest + ahead if ahead <= GAP else sequence
        return self.newest - behind if behind <= min(GAP, self.newest) else sequence

    def count_withdrawn(self, count: int, before: Moments | None) -> None:
        """Move `count` messages from the used ones to those from the future, as their clock turned out wrong.

        Also restore `at`, the time of the measurement with the greatest running count, and `latest`, the time of the
        newest one used. `before`: both before these messages; None if they were the node's first.
        """
        self.at, self.latest = before or (0.0, -1.0)
        self.used, self.future = max(self.used - count, 0), self.future + count
