"""Leaps in time: which clock made them, and what confirms them or takes them back."""

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
        """Yield this leap, then those before it that are believed, the newest first."""
        leap: ClockLeap | None = self
        while leap is not None:
            yield leap
            leap = leap.earlier

    def is_over(self, now: float) -> bool:
        """Return whether the plant has gone on after it for as long as it leapt."""
        return now - self.since >= self.since - self.now

    def as_believed(self) -> "ClockLeap":
        """Return this leap, believed; one that follows an earlier believed one is joined with that into one leap.

        Not with the leap with which the plant begins (`now` is -inf), which has no time before it.

        Believed: rows become final by it, although no other clock confirms it. `back`: time of a message that
        spoke against it; `since`: the first moment after the newest of leaps that are joined.
        """
        if self.earlier is None or self.earlier.now == -inf:
            return self._replace(believed=True, back=None)
        return self.earlier._replace(since=self.since, back=None)

    def with_back(self, of: "ClockLeap", back: float | None) -> "ClockLeap":
        """Return this chain of leaps, in which the leap `of` has this `back`.

        `back`: time of a message that goes on from before the leap, a first sign that it was none; None without
        one. `earlier`: the leap before this one in the chain.
        """
        if self is of:
            return self._replace(back=back)
        return self._replace(earlier=self.earlier and self.earlier.with_back(of, back))

    def is_taken_back_by(self, clock: str, time: float, now: float) -> bool:
        """Return whether `clock` takes the leap back by saying `time`, which lies between the leap's two sides.

        `now`: the newest arrival after it.

        `believed`: rows become final by it; `since`: the first moment after the newest of leaps that are
        joined; `back`: time of the first message by its own clock that went on from before it.
        """
        if not self.believed:
            return True
        if now - self.since >= self.since - time:
            return False  # it is late for no longer than the plant has gone on
        if clock != self.clock:
            return True
        # By its own clock the second message in a row, if it goes on from the first (`back`) closer than to the leap.
        return self.back is not None and self.back < time < self.back + self.time - time


def find_contradicted_leap(
    leap: ClockLeap | None, now: float, time: float, most: float
) -> tuple[ClockLeap, float] | None:
    """Return the leap that `time` contradicts by lying before it, and the newest arrival after it; None if none.

    A time contradicts a leap if it is later than all before the leap, but more than `most` before its far side.

    In a leap time goes on by more than `most` at once, from the newest arrival before it (`leap.now`) to its far
    side (`leap.time`).

    Args:
        leap: the newest of the chain, None if there is none.
        now: the newest arrival.
        time: what a clock says.
        most: the longest gap that is no leap.
    """
    for candidate in leap.list_with_earlier() if leap else ():
        if candidate.now < time < candidate.time - most:
            return candidate, now
        now = candidate.now
    return None


def make_first_leap(time: float, clock: str) -> ClockLeap:
    """Return the leap with which a plant begins: from no time at all to its first, by this clock."""
    return ClockLeap(time, time, -inf, {}, clock)
