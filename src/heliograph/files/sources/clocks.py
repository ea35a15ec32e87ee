"""Clocks of the topics of a recording without arrivals: whether their times are of one clock."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from heliograph.files.sources.fields import at
from heliograph.files.sources.json_field import Source
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.dates import looks_like_date
from heliograph.numerics.times.row_order import YEAR


@dataclass
class Clock:
    """Times of a topic.

    Attributes:
        path: dotted path of its time.
        numbers: whether times are numbers, and not dates.
        first: the first of them, in nanoseconds since 1970.
        count: how many there were.
        since_1970: how many were a year or more away from 1970.
    """

    path: str
    numbers: bool
    first: int
    count: int = 0
    since_1970: int = 0

    @property
    def from_zero(self) -> bool:
        """Return whether it counts from its own start: most times are numbers that were of the year around 1970."""
        return self.numbers and 2 * self.since_1970 <= self.count


class Clocks:
    """Clocks by topic, of messages that nothing dates but their own times."""

    def __init__(self) -> None:
        self._by_topic: dict[str, Clock] = {}

    def note(self, topic: str, content: object, time: int, sources: Iterable[Source]) -> None:
        """Note the time of a message, in nanoseconds since 1970."""
        clock = self._by_topic.get(topic)
        if clock is None:
            path, value = _find_time(topic, content, sources)
            clock = Clock(path, not (isinstance(value, str) and looks_like_date(value)), time)
            self._by_topic[topic] = clock
        clock.count += 1
        clock.since_1970 += abs(time) >= YEAR

    def check(self, place: str) -> list[str]:
        """Return the topics whose clocks count from their own starts; refuse them beside those of dates.

        Raises:
            ValueError: some count from their own start and others are dates; one line with the remedy.
        """
        own = [topic for topic, clock in self._by_topic.items() if clock.from_zero]
        dated = next((topic for topic in self._by_topic if topic not in own), None)
        if own and dated is not None:
            path, first = self._by_topic[own[0]].path, np.datetime64(self._by_topic[dated].first, "ns")
            date = f"{np.datetime_as_string(first, unit='s')}Z"
            remedy = f"such as time=hg.files.Stamp({path!r}, start={date!r}), with the date of its 0"
            got = f"numbers from {self._by_topic[own[0]].first / 1e9:g} s"
            raise fail(f"{place}, {own[0]}, field {path!r}", f"dates as in {dated}, from {date} on ({remedy})", got)
        return own


def _find_time(topic: str, content: object, sources: Iterable[Source]) -> tuple[str, object]:
    """Return path and value of the first time of a message that is there, of those that sources name."""
    for source in sources:
        if source.time is not None:
            with suppress(InputError):
                return source.time.path, at(content, source.time.path, topic)
    return "", None
