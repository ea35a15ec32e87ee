"""Clocks of the topics of a recording without times of arrival: whether their times can be compared with each other."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from heliograph.files.sources.message_fields import field_at
from heliograph.files.sources.source_description import Source
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.times.dates import looks_like_date
from heliograph.numerics.times.timestamp_order import YEAR


@dataclass
class TopicClock:
    """The clock of a topic, as far as its times show it.

    Attributes:
        path: dotted path of its time.
        numbers: whether times are numbers, and not dates.
        first: the first of them, in nanoseconds since 1970.
        count: how many there were.
        far_from_1970: how many were a year or more away from 1970.
    """

    path: str
    numbers: bool
    first: int
    count: int = 0
    far_from_1970: int = 0

    @property
    def counts_from_own_start(self) -> bool:
        """Return whether it counts from its own start: its times are numbers, of which most are within a year of 0."""
        return self.numbers and 2 * self.far_from_1970 <= self.count


class TopicClocks:
    """Clocks by topic, of messages without a time of arrival.

    Times of different topics are put in one order. That fails if some are dates and others count from the start of a
    device, so each clock is classified.
    """

    def __init__(self) -> None:
        """Make clocks of no topics yet; a topic gets its clock with its first message."""
        self._by_topic: dict[str, TopicClock] = {}

    def note_time(self, topic: str, content: object, time: int, sources: Iterable[Source]) -> None:
        """Note the time of a message on its topic's clock.

        A time within a YEAR of 1970 is taken for that of a clock that counts from its own start, and not for a date.

        Args:
            topic: topic of the message.
            content: the message, decoded.
            time: its time in nanoseconds since 1970.
            sources: the sources of the topic, which say where the time stands.
        """
        clock = self._by_topic.get(topic)
        if clock is None:
            path, value = _find_time_field(topic, content, sources)
            is_date = isinstance(value, str) and looks_like_date(value)
            clock = TopicClock(path, not is_date, time)
            self._by_topic[topic] = clock
        clock.count += 1
        clock.far_from_1970 += abs(time) >= YEAR

    def find_topics_without_dates(self, where: str) -> list[str]:
        """Return the topics whose clocks count from their own starts; raise ValueError if others have dates.

        Times of both kinds cannot be put in one order; the error says how to give the date of a clock's start.

        Raises:
            ValueError: some topics count from their own start, and others have dates.
        """
        from_zero = [topic for topic, clock in self._by_topic.items() if clock.counts_from_own_start]
        dated = next((topic for topic in self._by_topic if topic not in from_zero), None)
        if from_zero and dated is not None:
            topic, clock = from_zero[0], self._by_topic[from_zero[0]]
            date = f"{np.datetime_as_string(np.datetime64(self._by_topic[dated].first, 'ns'), unit='s')}Z"
            remedy = f"such as time=hg.files.Stamp({clock.path!r}, start={date!r}), with the date of its 0"
            expected = f"dates as in {dated}, from {date} on ({remedy})"
            raise fail(f"{where}, {topic}, field {clock.path!r}", expected, f"numbers from {clock.first / 1e9:g} s")
        return from_zero


def _find_time_field(topic: str, content: object, sources: Iterable[Source]) -> tuple[str, object]:
    """Return the path and value of the sources' first time field that the message has, or ("", None).

    `content`: the message, decoded.
    """
    for source in sources:
        if source.time is not None:
            with suppress(InputError):
                return source.time.path, field_at(content, source.time.path, topic)
    return "", None
