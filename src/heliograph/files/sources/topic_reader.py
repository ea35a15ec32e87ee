"""Messages of topics, read by the sources of a network: measurements of nodes, and inputs of the plant."""

from collections import Counter
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from heliograph.files.device_availability import DeviceStatuses
from heliograph.files.sources.derived_values import Computed, ZeroIfAbsent
from heliograph.files.sources.mapped_source import MappedSource, map_sources, suggest_name
from heliograph.files.sources.message_fields import (
    MissingFieldError,
    convert_count,
    convert_number,
    field_at,
    match_topic,
)
from heliograph.files.sources.message_reading import Reading, Unread, is_allowed
from heliograph.files.sources.mixed_sender_detection import SenderCounter
from heliograph.files.sources.source_description import Field, Source
from heliograph.files.sources.topic_clocks import TopicClocks
from heliograph.live.event import INPUTS
from heliograph.model.checks.refusal_reasons import RefusedError
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.simulation.network import Network

SECOND = 10**9  # nanoseconds
LISTED = 8  # topics in one line
COPY = 10 * SECOND  # a message that comes again so soon, with its count and values, is a copy


class _LastReading(NamedTuple):
    """The newest reading of a node, when it came (nanoseconds since 1970), and whether its count has ever changed."""

    reading: Reading
    moment: int
    has_count_changed: bool


class TopicReader:
    """Reads messages of topics by the sources of a network, as readings of nodes; unknown topics are counted.

    Args:
        table: sources by topic, as in a network's file.
        network: the network.
        others: nodes that other processes are, whose messages are left out.

    Raises:
        ValueError: no such table, an unknown node or output, a time in steps where the network has continuous time or
            the other way round, a wildcard that merges sensors. One line that names the topic.
    """

    def __init__(self, table: object, network: Network, others: Collection[str] = ()):
        """Check the sources by topic (fields that are measurements) against a network; `others`: nodes left out."""
        self.network, self.others = network, others
        # What is counted and noted of the messages that come, for notes to the user: `senders`, to find several that
        # share one count; `clocks`, to compare the clocks of topics.
        self.senders, self.clocks = SenderCounter(), TopicClocks()
        self.unknown = Counter[str]()  # messages of topics that are not in the table, by topic
        self.stored = 0  # a broker's stored messages without a time: they arrive on subscribing, so have no date
        self.excluded = Counter[str]()  # messages that a condition leaves out, by topic
        self.offline = Counter[str]()  # messages of devices that had said that they are offline, by topic
        # {(pattern of topics, path of a field): error of the first message without it}, and the pairs that came.
        self.absent = dict[tuple[str, str], str]()
        self.found = set[tuple[str, str]]()
        self._last = dict[tuple[str, str], _LastReading]()  # by plant and node
        # What the network expects: time in steps or not, and for each node, and the inputs, the names of its numbers.
        self.time_counts_steps = TIME_STEP not in network.inputs
        self.names = {name: tuple(network.nodes[name].received_names) for name in network.names}
        self.names[INPUTS] = tuple(name for name in network.inputs if name != TIME_STEP)
        if not isinstance(table, Mapping):
            raise fail("sources", "a dictionary of topics, each with json_field or a list of them", show_value(table))
        self._table = {
            topic: map_sources(topic, items, self.names, self.time_counts_steps) for topic, items in table.items()
        }
        # By topic that came, kept when first asked for: its sources, and the fields that they use.
        self._sources_of_topic = dict[str, list[MappedSource]]()
        self._fields_of_topic = dict[str, set[str]]()
        sources = [mapped.source for mapped in self._mapped_sources]
        self.device_statuses = DeviceStatuses(condition for source in sources for condition in source.available)
        # The seconds of a step, if dates are counted in steps.
        step_lengths = {source.step for source in sources}
        if len(step_lengths) > 1:
            raise fail("sources, step", "the same of all", sorted(map(str, step_lengths)))
        self.step_seconds = next(iter(step_lengths), None)

    @property
    def _mapped_sources(self) -> list[MappedSource]:
        """Return the sources of all topics."""
        return [mapped for of_topic in self._table.values() for mapped in of_topic]

    @property
    def topics(self) -> list[str]:
        """Return the topics of the table, wildcards included."""
        return list(self._table)

    @property
    def subscribed_topics(self) -> list[str]:
        """Return the topics of the table, and those on which devices say whether they are online."""
        return list(dict.fromkeys([*self._table, *self.device_statuses.topics]))

    @property
    def notes(self) -> list[str]:
        """Return lines on messages that conditions left out, and on devices that never said whether they are online."""
        lines = []
        for counts, why in ((self.excluded, "left out by where="), (self.offline, "left out, of devices offline")):
            if counts:
                named = ", ".join(f"{topic} ({number})" for topic, number in counts.most_common(LISTED))
                lines.append(f"messages {why}: {named}{_describe_rest(len(counts))}")
        if silent := self.device_statuses.unheard_topics:
            named = ", ".join(silent[:LISTED])
            lines.append(f"no word of online or offline came: {named}{_describe_rest(len(silent))}")
        return lines

    @property
    def periods(self) -> dict[str, int]:
        """Return {node: after how many messages its running count begins again at 0}; other nodes are absent."""
        counts = [(node, mapped.source.sequence) for mapped in self._mapped_sources for node in mapped.indices_by_node]
        return {node: count.period for node, count in counts if count is not None and count.period}

    @property
    def nodes_without_count(self) -> set[str]:
        """Return the nodes whose messages carry no running count, so that lost messages are not known."""
        nodes, counted = set[str](), set[str]()
        for mapped in self._mapped_sources:
            nodes |= mapped.indices_by_node.keys()
            if mapped.source.sequence is not None:
                counted |= mapped.indices_by_node.keys()
        return nodes - counted

    @property
    def columns(self) -> set[str]:
        """Return the columns of a table that the sources read: paths of their fields, and the paths' first words."""
        paths = [path for mapped in self._mapped_sources for path in mapped.source.fields]
        return {name for path in paths for name in (path, path.split(".")[0])}

    def list_fields(self, topic: str) -> set[str]:
        """Return the top-level fields of a topic's messages that sources use: the first words of their paths.

        A source's plant and node may be fields of the message, and a value may be computed from several (`parts`).
        """
        if topic not in self._fields_of_topic:
            fields = self._fields_of_topic.setdefault(topic, set())
            for mapped in self.of(topic):
                source = mapped.source
                names = [name.path for name in (source.plant, source.node) if isinstance(name, Field)]
                values = [
                    field for path in source.paths for field in ((path,) if isinstance(path, str) else path.parts)
                ]
                fields |= {path.split(".")[0] for path in (*names, *values, *source.where)}
        return self._fields_of_topic[topic]

    def of(self, topic: str) -> list[MappedSource]:
        """Return the sources whose pattern a topic matches; a pattern is a topic, possibly with wildcards."""
        if topic not in self._sources_of_topic:
            matching = [items for pattern, items in self._table.items() if match_topic(topic, pattern)]
            self._sources_of_topic[topic] = [source for items in matching for source in items]
        return self._sources_of_topic[topic]

    def read(self, topic: str, message: object, where: str) -> list[Reading | Unread]:
        """Return a reading of a message for each source of its topic; an unknown topic has none and is counted.

        If a source cannot read the message, an Unread with the reason stands there. A condition may leave it out.
        `_read_without_values` reads node, count and time of such a message, so that it does not count as lost.

        Args:
            topic: the topic of the message.
            message: decoded JSON, a message of a bag, or a dictionary of a row.
            where: place of the message, for errors.
        """
        sources, results = self.of(topic), list[Reading | Unread]()
        if not sources:
            self.unknown[topic] += 1
        for mapped in sources:
            try:
                reading = self._read_by_source(mapped, topic, message, where)
            except InputError as error:
                results.append(Unread(error, self._read_without_values(mapped, topic, message, where, error)))
            else:
                if reading is not None:
                    results.append(reading)
        return results

    def date_copy_as_original(self, reading: Reading, arrival: int | None) -> Reading:
        """Return a reading; if it is a copy of the node's last message, it gets the time of that message.

        Gateways and senders repeat messages, and a copy's time may be that of its reception. A copy has the same count
        and values, and comes within ten seconds. A count that has never changed does not tell copies.

        Args:
            reading: what came.
            arrival: when it arrived, in nanoseconds since 1970; None if that is not known.
        """
        # `_last` has by plant and node the last reading, its moment, and whether its count has ever changed.
        moment = reading.time if arrival is None else arrival
        has_no_seconds = self.time_counts_steps and self.step_seconds is None
        if reading.sequence is None or reading.time is None or moment is None or has_no_seconds:
            return reading
        key = reading.plant, reading.node
        last = self._last.get(key)
        if last is None:
            self._last[key] = _LastReading(reading, moment, has_count_changed=False)
            return reading
        is_count_repeated = reading.sequence == last.reading.sequence and last.has_count_changed
        comes_soon_after = 0 <= moment - last.moment <= COPY  # ten seconds
        has_same_values = np.array_equal(reading.values, last.reading.values, equal_nan=True)
        if is_count_repeated and comes_soon_after and has_same_values:
            return reading._replace(time=last.reading.time)
        has_changed = last.has_count_changed or reading.sequence != last.reading.sequence
        self._last[key] = _LastReading(reading, moment, has_changed)
        return reading

    def describe_absent_field(self) -> str:
        """Return the error of the first field that no message of its topic had; "" if there is none."""
        return next((error for key, error in self.absent.items() if key not in self.found), "")

    def _read_by_source(self, mapped: MappedSource, topic: str, message: object, where: str) -> Reading | None:
        """Return a message's reading by one source; None if a condition leaves it out or another process reads it.

        Args:
            mapped: the source, with the index of each of its values among those of a node.
            topic: topic of the message.
            message: the message, decoded.
            where: place of the message, for errors.

        Raises:
            ValueError: a field that is not there, or is no number, time or count; one line that names it.
        """
        source, pattern = mapped.source, mapped.pattern
        if self._is_left_out(source, topic, message, where):
            return None
        plant, node = _read_names(mapped, topic, message, where)
        if node in self.others:
            return None
        if node not in mapped.indices_by_node:
            known = mapped.indices_by_node
            raise fail(f"{where}, node", f"one of {', '.join(known)}", suggest_name(node, known))
        source.check_valid(message, where)
        sequence, is_count_absent = self._read_message_count(source, pattern, message, where)
        # A message with a count may lack values: it measured nothing.
        has_count = sequence is not None and not is_count_absent
        values = np.full(len(self.names[node]), np.nan)
        # Each value in the output's unit: scale value + offset. `found` and `absent` note which fields came at all and
        # which did not: one that never comes is misspelt.
        parts = zip(mapped.indices_by_node[node], source.paths, source.scale, source.offset, strict=True)
        for index, path, scale, offset in parts:
            try:
                values[index] = scale * _read_value(message, path, where, source.quoted) + offset
                if sequence is not None:
                    self.found.add((pattern, str(path)))
            except MissingFieldError as error:
                if not has_count:
                    raise
                self.absent.setdefault((pattern, str(path)), str(error))
        period = 0 if source.sequence is None else source.sequence.period
        return Reading(plant, node, sequence, _read_time(source, message, where), values, period)

    def _is_left_out(self, source: Source, topic: str, message: object, where: str) -> bool:
        """Return whether a message is left out, by a field's value or since its device is offline; count it if so.

        `source.where` has by path of a field its allowed values, `source.available` the conditions on devices' own
        words. A field that is missing is an error.
        """
        for field, allowed in source.where.items():
            if not is_allowed(field_at(message, field, where), allowed):
                self.excluded[topic] += 1
                return True
        if any(self.device_statuses.is_offline(condition, topic) for condition in source.available):
            self.offline[topic] += 1
            return True
        return False

    def _read_without_values(
        self, mapped: MappedSource, topic: str, message: object, where: str, error: InputError
    ) -> Reading | None:
        """Return plant, node, count and time of a message that could not be read, as a reading whose values are NaN.

        A message that came must not count as lost, so its running count is needed. Return None if plant, node or count
        cannot be read; but a message that its flag or count refused (`error` is a RefusedError) is returned without a
        count too. `mapped`: the source with its pattern of topics. `where`: place of the message, for errors.
        """
        sequence, is_count_absent = None, False
        try:
            plant, node = _read_names(mapped, topic, message, where)
            sequence, is_count_absent = self._read_message_count(mapped.source, mapped.pattern, message, where)
        except RefusedError:  # raised by the count; plant and node have been read before it
            pass
        except InputError:
            return None
        if is_count_absent:
            sequence = None
        if node not in mapped.indices_by_node or (sequence is None and not isinstance(error, RefusedError)):
            return None
        try:
            time = _read_time(mapped.source, message, where)
        except InputError:
            time = None
        period = 0 if mapped.source.sequence is None else mapped.source.sequence.period
        return Reading(plant, node, sequence, time, np.full(len(self.names[node]), np.nan), period)

    def _read_message_count(self, source: Source, pattern: str, message: object, where: str) -> tuple[int | None, bool]:
        """Return a message's running count (None if the source has none), and whether its field is absent (count 0).

        `self.found` and `self.absent` note which count fields came and which did not, by pattern of topics and path;
        `check` refuses a count that the declared number of bits cannot hold.
        """
        if source.sequence is None:
            return None, False
        path = source.sequence.path
        try:
            value = field_at(message, path, where)
        except MissingFieldError as error:
            self.absent.setdefault((pattern, path), str(error))
            return 0, True
        self.found.add((pattern, path))
        name = f"{where}, field {path!r}"
        return source.sequence.check(convert_count(value, name, source.quoted), name), False


def _read_names(mapped: MappedSource, topic: str, message: object, where: str) -> tuple[str, str]:
    """Return the names of a message's plant and node; the plant is "" if there is only one.

    A source gives the node's name itself, or an object whose `of` reads it in the topic or the message, as it does the
    plant's.
    """
    source = mapped.source
    node = source.node if isinstance(source.node, str) else source.node.of(topic, message, where)
    plant = "" if source.plant is None else source.plant.of(topic, message, where)
    return plant, node


def _read_time(source: Source, message: object, where: str) -> int | None:
    """Return the time of measuring in a message, in nanoseconds since 1970 or steps; None if the source has none."""
    return None if source.time is None else source.time.of(message, source.time_unit, where, source.quoted)


def _describe_rest(count: int) -> str:
    """Return " and N more" for a list of `count` names of which only the first LISTED are shown; "" if all are."""
    return "" if count <= LISTED else f" and {count - LISTED} more"


def _read_value(message: object, path: str | Computed, where: str, quoted: bool) -> float:
    """Return the number at a path, or one computed from several; NaN for null or a number that is not finite.

    `where`: place of the message, for errors. `quoted`: whether a text such as "1.5" counts as a number. If there is no
    such field, MissingFieldError is raised.
    """
    if isinstance(path, ZeroIfAbsent):  # a field that senders leave out where it is 0
        path_of_parent, _, name = path.path.rpartition(".")
        parent = field_at(message, path_of_parent, where)
        if isinstance(parent, Mapping) and name not in parent:
            return 0.0
        return _read_value(parent, name, where, quoted)
    if not isinstance(path, str):  # several fields and what is computed from them
        return float(path.of(*(_read_value(message, field, where, quoted) for field in path.parts)))
    value = field_at(message, path, where)
    if type(value) is float:  # the common case, without making the place's name for errors
        return value if np.isfinite(value) else np.nan
    return convert_number(value, f"{where}, field {path!r}", quoted)
