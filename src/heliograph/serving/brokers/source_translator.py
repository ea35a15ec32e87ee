"""Messages of topics that others make, to messages of a network by its sources."""

from collections import Counter, OrderedDict
from collections.abc import Collection, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from heliograph.files.messages.message_files import FileMessage, make_default_topic
from heliograph.files.sources.message_fields import decode_json, parse_arrival
from heliograph.files.sources.message_reading import Reading, Unread
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.model.checks.refusal_reasons import RefusedError
from heliograph.numerics.check import InputError, fail, instance, show_value
from heliograph.numerics.times.timestamp_order import YEAR
from heliograph.serving.brokers.transport import LOG
from heliograph.serving.message import LONGEST, Message, UnreadMessage
from heliograph.simulation.network import Network

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
MICROSECOND = timedelta(microseconds=1)
LISTED = 8  # unknown topics in one line
REMEMBERED = 10_000  # times of messages without a count
NAME = 200  # characters of a plant's name


class Translator:
    """Sources of a network, applied to messages as they come.

    A measurement without a time is of the moment of its arrival, and counted here. Where a time names it but no count,
    those of a node with one time are told apart by their order; of a broker, which may send a message again, one with
    the same values is the same message. A message that a broker had stored for new subscribers is left out where only
    its arrival would date it. A stamp that is more than a year before a known arrival is refused. Unknown topics are
    counted, never guessed.

    Args:
        table: sources by topic, as in a network's file.
        network: the network.
        others: nodes that other processes are, whose messages are left out.

    Raises:
        ValueError: sources that do not fit the network.
    """

    def __init__(self, table: object, network: Network, others: Collection[str] = ()):
        """Check a table of sources by topic against the network; messages of the nodes `others` are left out.

        The object holds what messages lack: counts of readings, and the newest values of senders without a count, by
        which a repeated message is found.
        """
        instance("network", network, Network, "a Network")
        if isinstance(others, str) or not isinstance(others, Collection):
            raise fail("nodes of other processes", "a list of names", show_value(others))
        self.sources = TopicReader(table, network, others)
        topics = self.sources.topics
        # `_alone` is the only topic, if there is just one and it is no pattern (with the wildcards + or #).
        is_alone = len(topics) == 1 and not {"+", "#"} & set(topics[0].split("/"))
        self._alone = topics[0] if is_alone else None
        self._counts = Counter[tuple[str, str]]()  # by (plant, node), how many readings came
        self._stored = 0  # how many messages that a broker had stored were left out, as they have no date of their own
        # {(plant, node, time): the values of the readings there}, of nodes without a running count.
        self._uncounted = OrderedDict[tuple[str, str, int], list[bytes]]()

    def read(
        self, topic: str, payload: bytes, arrival: datetime, stored: bool = False
    ) -> list[Message | UnreadMessage | str]:
        """Return the messages in a payload of a topic, or the reason why it cannot be read; [] of unknown topics.

        Args:
            topic: the topic.
            payload: JSON.
            arrival: when it arrived.
            stored: whether the broker had stored it for new subscribers. It may then be old, and have come before.
        """
        # The broker may deliver a copy again (`repeatable`), which then gets the same number.
        return self._read_payload(topic, payload, arrival, stored, repeatable=True, where=topic)

    def topic_of(self, path: Path | None) -> str | None:
        """Return the topic of messages that name no topic: that of their file's name, or else the sources' only topic.

        It is None if there is neither.

        Args:
            path: the file; None of a pipe.
        """
        names = () if path is None else (path.name, make_default_topic(path))
        return next((name for name in names if name in self.sources.topics), self._alone)

    def topic_of_rows(self, path: Path | None, header: Sequence[str]) -> str | None:
        """Return the topic of the rows of a table, or None if the sources do not know the table.

        Args:
            path: the file; None of a pipe.
            header: the names of the columns.
        """
        # A file of another name may have the sources' only topic, if it has the columns that this topic needs.
        topic = self.topic_of(path)
        if topic is None or (path is not None and topic in (path.name, make_default_topic(path))):
            return topic
        fields = [field for mapped in self.sources.of(topic) for field in mapped.source.fields]
        return topic if all(field in header or field.split(".")[0] in header for field in fields) else None

    def decode(self, message: FileMessage, topic: str | None) -> list[Message | UnreadMessage | str]:
        """Return the messages in a line or a row, or why it cannot be read; [] of unknown topics.

        A message's arrival is the time that it states; else the time of the measurement, or now if that is dated later.

        Args:
            message: the line or the row.
            topic: topic of a message that names none.
        """
        name = topic if message.topic is None else message.topic
        if name is None:
            return [str(fail(message.where, "a message in our own form, or a topic of the sources", "neither"))]
        try:
            arrival = None
            if message.arrival is not None:
                arrival = convert_nanoseconds_to_date(parse_arrival(message.arrival, f"{message.where}, arrival"))
        except InputError as error:
            return [str(error)]
        return self._read_payload(name, message.content, arrival, message.stored, repeatable=False, where=message.where)

    def left_out(self) -> list[str]:
        """Return lines on messages that were not used, and on oddities in others, for the end of a run.

        Messages are not used if their topic is not among the sources; or if a broker had stored them, and only their
        arrival would date them. Oddities are what the sources noted on the way, several senders under one name, and a
        field of the sources that no message had.
        """
        lines = list[str]()
        unknown = +self.sources.unknown  # {topic: how many messages}; the sign + of a Counter leaves out zeros
        if unknown:
            named = ", ".join(f"{topic} ({count})" for topic, count in unknown.most_common(LISTED))
            more = "" if len(unknown) <= LISTED else f" and {len(unknown) - LISTED} more"
            lines.append(f"topics that are not among the sources: {named}{more}")
        lines += [*self.sources.notes, *self.sources.senders.describe_several_senders()]
        absent_field = self.sources.describe_absent_field()
        if absent_field:
            lines.append(f"a field that no message had: {absent_field}")
        if self._stored:
            lines.append(f"{self._stored} stored messages were left out: without time= they have no date")
        return lines

    def _read_payload(
        self, topic: str, payload: object, arrival: datetime | None, stored: bool, repeatable: bool, where: str
    ) -> list[Message | UnreadMessage | str]:
        """Return the messages in a payload, and for each reading that cannot be used the reason.

        The reason is an UnreadMessage where node and count of the reading are known, else a text.

        Args:
            topic: topic from which it came.
            payload: JSON as the broker gave it, bytes or a text; or its content, if that was read already.
            arrival: when it came, None for now.
            stored: whether the broker had kept it from earlier. Then its arrival does not date it, and a reading
                without a time of its own is left out, and counted.
            repeatable: whether a copy of it may come again, so that its number is made from its contents.
            where: place that an error names.
        """
        results: list[Message | UnreadMessage | str] = []
        try:
            # A message that only says that a sender is online or offline has no readings: the sources note it.
            if self.sources.device_statuses.take_status_message(topic, payload, where):
                return []
            # Messages of unknown topics are counted, whatever they carry.
            if not self.sources.of(topic):
                self.sources.unknown[topic] += 1
                return []
            content = _decode_json(payload, where)
            for reading in self.sources.read(topic, content, where):
                if isinstance(reading, Unread):
                    results.append(self._explain_unread(where, reading, arrival, repeatable))
                elif stored and reading.time is None:  # only its arrival would date it
                    self._stored += 1
                else:
                    results.append(self._make_message(where, reading, arrival, repeatable))
                    self._watch_for_several_senders(topic, reading, content)
        except InputError as error:
            results.append(str(error))
        return results

    def _watch_for_several_senders(self, topic: str, reading: Reading, content: object) -> None:
        """Note the fields of a message that may tell apart several senders of one node, and warn of several senders.

        Warnings come when the number of messages is a power of two.
        """
        senders = self.sources.senders
        senders.note_fields(topic, reading.plant, reading.node, content, self.sources.list_fields(topic))
        for line in senders.describe_at_powers_of_two_messages():
            LOG.warning("%s", line)

    def _explain_unread(
        self, topic: str, unread: Unread, known: datetime | None, repeatable: bool
    ) -> UnreadMessage | str:
        """Return why a message could not be read, together with its node, count and time if these could be read.

        Args:
            topic: topic from which it came, for errors.
            unread: the error, and `counted`, what was read in spite of it; None if nothing was.
            known: when it arrived, None if that is not known.
            repeatable: whether a copy of it may come again.
        """
        why = str(unread.error)
        if unread.counted is None:
            return why
        try:
            message = self._make_message(topic, unread.counted, known, repeatable)
            reason = unread.error.reason if isinstance(unread.error, RefusedError) else None
            return UnreadMessage(message, why, reason, counted=unread.counted.sequence is not None)
        except InputError:
            return why

    def _make_message(self, topic: str, reading: Reading, known: datetime | None, repeatable: bool) -> Message:
        """Return a reading's message to the service; without a running count it gets a number as its `sequence`.

        A message has a plant, a node, a number, a time and values. Numbers tell copies and losses.

        Args:
            topic: topic of the broker from which the reading came, for errors.
            reading: plant, node, values, and if the sender gave them count and time.
            known: when it arrived; None if that is not known: then it is taken to have arrived now.
            repeatable: whether a copy of it may come again.
        """
        # Names that the service can hold.
        if len(reading.plant) > NAME or "\0" in reading.plant:
            expected = f"a name of at most {NAME} characters, without NUL"
            raise fail(f"{topic}, plant", expected, show_value(reading.plant))
        arrival = datetime.now(UTC) if known is None else known
        # A copy of the node's last message, repeated by a gateway, gets the time of the original.
        nanoseconds = None if known is None else (known - EPOCH) // MICROSECOND * 1000  # since 1970
        reading = self.sources.date_copy_as_original(reading, nanoseconds)
        time = self._date_reading(topic, reading, arrival, is_known=known is not None)
        # A message from a log says when it arrived. One that comes now says so only if its time is later than now: it
        # cannot have been measured after it came.
        stated_arrival: datetime | None = None
        if reading.time is not None and isinstance(time, datetime):
            is_from_log = known is not None and not repeatable
            stated_arrival = arrival if time > arrival or is_from_log else None
        # Made without a check: the parts are checked already, and dates are no texts here. NaN becomes None.
        return Message.model_construct(
            plant=reading.plant,
            node=reading.node,
            sequence=self._count_reading(reading, repeatable),
            time=time,
            values=[None if value != value else value for value in reading.values.tolist()],
            inputs=None,
            arrival=stated_arrival,
        )

    def _date_reading(self, topic: str, reading: Reading, arrival: datetime, is_known: bool) -> datetime | float:
        """Return when a reading was measured, as a date or a number of steps; without a time, return its arrival.

        A reading's time is in nanoseconds since 1970, or counts steps.

        Args:
            topic: topic from which it came, for errors.
            reading: the reading.
            arrival: when it arrived.
            is_known: whether that is known, and not the present in its place.

        Raises:
            ValueError: a date more than a year before a known arrival: the sender's clock was never set.
        """
        if reading.time is None:
            return arrival
        if self.sources.time_counts_steps and self.sources.step_seconds is None:
            return float(reading.time)
        time = convert_nanoseconds_to_date(reading.time)
        is_unset = is_known and (arrival - time) // MICROSECOND * 1000 > YEAR  # then the clock was never set
        if is_unset:
            expected = f"a time that was set, near that of arrival, {arrival.isoformat()}"
            raise fail(f"{topic}, time", expected, time.isoformat())
        return time

    def _count_reading(self, reading: Reading, repeatable: bool) -> int:
        """Return the reading's running count, or a number from 0 in its place.

        A reading without a count is numbered among the readings of its node and time. If it has no time either, it is
        numbered among all readings of its node. `repeatable`: a copy of it may come again, and gets the same number.
        """
        if reading.sequence is not None:
            return reading.sequence
        name = reading.plant, reading.node
        number = self._counts[name]  # how many readings of this node came before
        self._counts[name] += 1  # even if this number is not used
        if reading.time is not None:
            number = self._number_among_simultaneous(reading, repeatable)
        return number

    def _number_among_simultaneous(self, reading: Reading, repeatable: bool) -> int:
        """Return how many messages of the same node and time came before; this numbers a message without a count.

        If `repeatable`, a message with the values of an earlier one is its copy, and gets the same number.
        """
        assert reading.time is not None
        values_so_far = self._uncounted.setdefault((reading.plant, reading.node, reading.time), [])
        values = reading.values.tobytes()
        if repeatable and values in values_so_far:  # a copy
            return values_so_far.index(values)
        values_so_far.append(values)
        if len(self._uncounted) > REMEMBERED:  # forget the oldest time
            self._uncounted.popitem(last=False)
        return len(values_so_far) - 1


def convert_nanoseconds_to_date(nanoseconds: int) -> datetime:
    """Return a date in UTC, cut to the microsecond, from nanoseconds since 1970.

    Raises:
        ValueError: the year is beyond Python's dates.
    """
    try:
        return EPOCH + timedelta(microseconds=nanoseconds // 1000)
    except OverflowError:
        raise fail("time", "a date of these thousand years", nanoseconds) from None


def _decode_json(payload: object, where: str) -> object:
    """Return the content of a JSON payload of at most LONGEST bytes; a payload that is read already stays as it is.

    `where` is the payload's place, for errors.
    """
    if not isinstance(payload, bytes | str):
        return payload
    if len(payload) > LONGEST:
        raise fail(where, f"at most {LONGEST} bytes", len(payload))
    return decode_json(payload, where)
