"""Leaps in time: which clock made them, and what confirms them or takes them back.

A leap is a jump ahead in the dates of events by more than a limit. So far one clock alone has shown it, and that clock
may be wrong. An event "goes on from before the leap" if it is dated in the jump's gap, so that it contradicts the leap.
"""

from collections.abc import Iterator
from math import inf
from typing import NamedTuple, TypeAlias

Moments: TypeAlias = tuple[float, float]  # of a node: time of its greatest count, and of its newest measurement
ARRIVAL = ""  # the clock by which arrivals are dated, which is no node's


class ClockLeap(NamedTuple):
    """A leap in time that one clock has made so far.

    Another clock confirms it: that of another node, the one on the wall, or that of an arrival where it agrees with the
    node's. A second message by the same clock makes it believed where no other node was heard shortly before: there is
    nothing else that could confirm it. In the end it is confirmed by the plant having gone on after it for as long as
    it leapt, so that whoever goes back is late for no longer than that.

    What goes on from before it takes it back: one message as long as it is not believed, or if it is another node's;
    else two in a row.

    Attributes:
        time: the first moment after it.
        since: the first moment after the newest of several, one after the other, that are taken as one.
        now: the newest arrival before it; -inf where the plant began with it.
        moments: those of each node before it.
        clock: name of the node whose message it was, or `ARRIVAL`.
        believed: whether rows become final by it although no other clock confirms it.
        back: time of a message that goes on from before it, where nothing that came since goes on after it; else None.
        earlier: the believed leap after which it came.
    """

    time: float
    since: float
    now: float
    moments: dict[str, Moments]
    clock: str = ARRIVAL
    believed: bool = False
    back: float | None = None
    earlier: "ClockLeap | None" = None

    def list_with_earlier(self) -> Iterator["ClockLeap"]:
        """Yield this leap and then the leaps before it (`earlier`, all believed), the newest first."""
        leap: ClockLeap | None = self
        while leap is not None:
            yield leap
            leap = leap.earlier

    def is_over(self, now: float) -> bool:
        """Return whether the plant has gone on after the leap for as long as the jump was.

        It went on from the first moment after the leap (`since`) to the newest arrival, the argument `now`. The jump
        was from `self.now`, the newest arrival before the leap, to `since`.
        """
        return now - self.since >= self.since - self.now

    def as_believed(self) -> "ClockLeap":
        """Return this leap as believed: rows become final by its time although no other clock confirms it.

        If an earlier leap is believed already, the two become one, which begins where the earlier one began and ends
        (`since`) where this one ends. The leap with which a plant begins has no time before it (`now` is -inf) and is
        not joined. A message that contradicted the leap before (`back`) is forgotten.
        """
        if self.earlier is None or self.earlier.now == -inf:
            return self._replace(believed=True, back=None)
        return self.earlier._replace(since=self.since, back=None)

    def with_back(self, of: "ClockLeap", back: float | None) -> "ClockLeap":
        """Return this leap and the earlier ones, with `back` set in the leap `of`, which is one of them.

        `back` is the time of a message that came after the leap but is dated in its gap: the first sign that the clock
        was wrong. None if there is no such message.
        """
        if self is of:
            return self._replace(back=back)
        return self._replace(earlier=self.earlier and self.earlier.with_back(of, back))

    def is_taken_back_by(self, clock: str, time: float, now: float) -> bool:
        """Return whether a message that is dated inside the leap's gap shows that the leap never happened.

        It does if the leap is not `believed`. Otherwise it does not if it may just be late: if the plant went on after
        the leap, from `since` to `now`, for at least as long as the message is late. Otherwise one message of another
        clock is enough. The leap's own clock must say so twice, the second time shortly after the first (`back`).

        Args:
            clock: the clock by which the message is dated.
            time: the message's date.
            now: the newest arrival after the leap.
        """
        if not self.believed:
            return True
        if now - self.since >= self.since - time:
            return False  # it may be late
        if clock != self.clock:
            return True
        # The leap's own clock: this second message is dated after the first (`back`), and nearer to the first than to
        # the far side of the gap: time - back < self.time - time.
        return self.back is not None and self.back < time < self.back + self.time - time


def find_contradicted_leap(
    leap: ClockLeap | None, now: float, time: float, most: float
) -> tuple[ClockLeap, float] | None:
    """Return the leap that `time` contradicts, and the newest arrival after that leap; None if there is no such leap.

    In a leap, a jump that one clock alone showed, time goes on by more than `most` at once: from the newest arrival
    before it (`leap.now`) to its far side (`leap.time`). If it really is `time`, inside this gap, the leap was an
    error: leap.now < time < leap.time - most.

    Args:
        leap: the newest leap, which leads to the earlier ones; None if there is none.
        now: the newest arrival.
        time: the time that a clock says.
        most: the longest gap that is no leap.
    """
    for candidate in leap.list_with_earlier() if leap else ():
        if candidate.now < time < candidate.time - most:
            return candidate, now
        now = candidate.now  # of the next, earlier leap: all arrivals after it came before this one
    return None


def make_first_leap(time: float, clock: str) -> ClockLeap:
    """Return the leap with which a plant begins, from -inf to the time of its first message, by this clock.

    So an error in the first message's date can be undone like a later one.
    """
    return ClockLeap(time, time, -inf, {}, clock)
