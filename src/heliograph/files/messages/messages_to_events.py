"""Messages of a recording (a bag, a log, a file or a store) to events, by the sources of a network.

A source says which fields of the messages of a topic are the measurements of which node.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path

from heliograph.files.bags.mcap_json_and_protobuf import holds_messages, read_mcap_messages
from heliograph.files.bags.ros_bag import Progress, is_bag, parts_of, read_bag
from heliograph.files.events.event_table import EventTable
from heliograph.files.logs.log_reading import read_log
from heliograph.files.logs.vehicle_log import is_log
from heliograph.files.messages.folder_of_message_files import (
    describe_unused_files,
    find_topic_of_file,
    is_message_folder,
    read_message_folder,
)
from heliograph.files.messages.message_files import (
    TOPIC,
    FileMessage,
    decode_message_content,
    is_message_file,
    make_default_topic,
    read_message_file,
    table_has_topics,
)
from heliograph.files.messages.own_format import (
    NODE,
    SEQUENCE,
    OwnMessageCollector,
    holds_events,
    is_own_message,
    is_table_file,
)
from heliograph.files.sources.message_fields import parse_arrival
from heliograph.files.sources.message_reading import Reading, Unread
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.files.stores.store_address import is_store, parse_store
from heliograph.files.stores.store_tables import StoreTable, query_store
from heliograph.files.text.text_file import CutOffError, find_extension
from heliograph.numerics.check import InputError, check_progress, fail, file_path, flag, instance
from heliograph.simulation.network import Network


def read_messages(
    path: str | Path,
    network: Network,
    sources: object = None,
    progress: Progress | None = None,
    strict: bool = False,
    ignore_unknown: bool = False,
) -> EventTable:
    """Read the events of a network from a bag, a vehicle's log, a file of messages or a folder of them, or a store.

    An event is one measurement of a node, with its time and the time of its arrival. A source says which fields of
    which messages it is read from; messages in our own form, with node, sequence, time and values, need no sources.

    A bag is a file of MCAP, SQLite (.db3) or ROS 1 (.bag), or a folder of ROS 2 or of such files. Each event has the
    time of its source and the time when it was logged. MCAP may have messages of ROS or in JSON.

    A file of messages is CSV or Parquet, where each row is a message and its columns are the fields; Influx's annotated
    CSV; or lines of JSON (.jsonl, .ndjson, .json, .log, .txt), also as MQTT clients print them. CSV and lines may be
    packed (.gz). A message has its topic in the field `topic`, with JSON in `payload` if there is such a field; else
    the topic is the file's name. It arrives at the time in `arrival` or `tst`, beside a payload also in `timestamp`,
    `time` or `ts` (a date with a zone, or seconds), else at its own time.

    A folder of files of messages is one recording, merged by time. The topic of each file is its name, and files whose
    names are no topic of the sources are left out. A clock that counts from its own start has that in its `Stamp`.

    Rows of a store, whose URL is as `read_store` takes it, are messages as rows of CSV are; the topic is the
    measurement's or the database's name. A vehicle's log is BLF (.blf) or ASC (.asc), whose frames a database
    describes, MDF4 (.mf4) or ULog (.ulg), read by `LogSources`; each message arrives when it was logged.

    A message that cannot be read is refused alone: `refused` of the result counts them, `reasons` has the first.
    Where a bag is damaged, everything before the damage is read, and `broken` says where it is.

    Args:
        path: the bag, the file or the folder, or the URL of a store.
        network: the network, which names the nodes and the numbers that each receives.
        sources: sources by topic, as `json_field` makes them: which field of a message is which number of which node;
            for a vehicle's log the `LogSources`. None for messages in our own form.
        progress: called with the numbers of messages read and to be read (default none).
        strict: whether the first message that cannot be read is an error (default False: it is refused alone).
        ignore_unknown: whether columns that the network does not know are left out, of messages in our own form
            (default False: they are refused, since they may be misspelt).

    Raises:
        ValueError: no such file, no bag, sources that do not fit the network or the file, nothing that can be read.
        ModuleNotFoundError: a bag without rosbags (extra "bags"), a log without what reads it ("can", "mdf", "ulog").
    """
    # A store's rows are asked for by its URL; all else is a file or a folder.
    source = query_store(parse_store(str(path))) if is_store(path) else file_path("recording", path)
    return read_events(source, network, sources, progress, strict, ignore_unknown)


def read_events(
    source: Path | StoreTable,
    network: Network,
    sources: object,
    progress: Progress | None,
    strict: bool,
    ignore_unknown: bool,
) -> EventTable:
    """Return the events of a bag, a log, a file or a folder, or of a store's table; an event is one node's values.

    `TopicReader` checks sources against the network. Each `_read_...` function makes an `EventTable`, which also counts
    what was refused; `finish` leaves out stamps that were never set.

    Args:
        source: path of the recording, or the table of a store.
        network: the network whose nodes the events are of.
        sources: which field of which topic is a node's measurement; None for messages in our own form, which have the
            columns node, sequence, time and values.
        progress: called with the numbers of messages read and to be read; None for no calls.
        strict: whether the first message that cannot be read is an error; otherwise it is counted and left out.
        ignore_unknown: whether columns in our own form that the network does not know are left out.
    """
    instance("network", network, Network, "a Network")
    check_progress(progress, "(read, total)")
    strict = flag("strict", strict)
    ignore_unknown = flag("ignore_unknown", ignore_unknown)
    checked = None if sources is None else TopicReader(sources, network)
    # By what the recording is: bags and logs, then messages in our own form, or of the sources' topics.
    if isinstance(source, Path) and is_bag(source):
        if checked is None:
            raise fail("sources", f"a source for the topics of {source}", "none")
        events = _read_bags(source, checked, progress, strict)
    elif isinstance(source, Path) and is_log(source):
        if checked is None:
            raise fail("sources", f"hg.files.LogSources for the messages of {source}", "none")
        events = _read_log(source, sources, checked, strict)
    elif isinstance(source, Path) and is_message_folder(source) and checked is None:
        raise fail("sources", f"a source for the files of {source}", "none")
    elif _holds_rows_of_own_format(source):
        events = _read_table_of_own_format(source, network, strict, ignore_unknown)
    else:
        events = _read_by_topic(source, network, checked, strict)
    # Note what the sources left out, and judge the events as a whole, such as time stamps that were never set.
    if checked is not None:
        _note_left_out(source, checked, events)
    events.finish(str(source), strict)
    return events


def _read_bags(path: Path, sources: TopicReader, progress: Progress | None, strict: bool) -> EventTable:
    """Return the events of a bag, or of the bags in a folder, with messages of ROS, in JSON or in Protocol Buffers.

    `holds_messages` says that a file is MCAP with JSON or Protocol Buffers, which is read by its own reader; all others
    are bags of ROS.
    """
    events = EventTable(sources.network, sources.step_seconds)
    for bag in parts_of(path) or [path]:
        if holds_messages(bag):
            topics = _append_messages_by_topic(bag, read_mcap_messages(bag, sources), sources, events, strict)
            missing = [topic for topic in sources.topics if not set("+#") & set(topic) and topic not in topics]
            if missing:
                events.notes.append(f"{bag}: not in the bag: {', '.join(missing)}")
        else:
            read_bag(bag, sources, events, progress, strict)
    return events


def is_of_messages(path: Path | StoreTable, sources: object) -> bool:
    """Return whether a recording consists of messages or events, as a bag or a log does, and not of rows of times.

    The rows of a table are messages if it has a column `topic`, or if the sources name the table as a topic.
    """
    if isinstance(path, StoreTable):
        named = isinstance(sources, Mapping) and (path.topic in sources or TOPIC in path.columns)
        return named or _holds_rows_of_own_format(path)
    if is_bag(path) or is_log(path) or is_message_folder(path) or holds_events(path) or is_message_file(path):
        return True
    if find_extension(path) not in (".csv", ".parquet") or not isinstance(sources, Mapping) or not path.is_file():
        return False
    return make_default_topic(path) in sources or path.name in sources or table_has_topics(path)


def _holds_rows_of_own_format(source: Path | StoreTable) -> bool:
    """Return whether a table has events in our own form: it has the columns `node` and `sequence`."""
    return holds_events(source) if isinstance(source, Path) else {NODE, SEQUENCE} <= source.columns.keys()


def _yield_messages(
    source: Path | StoreTable, sources: TopicReader | None = None
) -> Iterator[FileMessage | InputError]:
    """Return the messages of a file, of a folder's files that the sources read, or of a store's table."""
    if isinstance(source, Path) and is_message_folder(source) and sources is not None:
        return read_message_folder(source, sources)
    return read_message_file(source) if isinstance(source, Path) else source.messages()


def _read_table_of_own_format(
    path: Path | StoreTable, network: Network, strict: bool, ignore_unknown: bool
) -> EventTable:
    """Return the events of a table in our own form, with the columns node, sequence, time and values.

    `ignore_unknown`: whether unknown columns are left out. `strict`: whether a row that cannot be read is an error.
    """
    collector = OwnMessageCollector(network, path, table=True, ignore_unknown=ignore_unknown)
    for message in _yield_messages(path):
        collector.add(message, strict)
    return collector.events()


def _read_by_topic(path: Path | StoreTable, network: Network, sources: TopicReader | None, strict: bool) -> EventTable:
    """Return the events of messages, which are either all of topics of the sources, or all in our own form.

    Our own form is a message with the fields that this package defines (node, count, time, values), which needs no
    sources. An event is what one message says: a node's values with the time of measuring and of arrival.

    Args:
        path: the file, the folder or the store's table.
        network: the network, whose nodes and outputs the messages name.
        sources: reads messages by the sources of their topic; None if all messages are in our own form.
        strict: whether the first message that cannot be read is an error.

    Raises:
        ValueError: messages of both kinds, or of topics without sources.
    """
    events = None if sources is None else EventTable(network, sources.step_seconds)
    is_rows = isinstance(path, StoreTable) or is_table_file(path)
    # `own` collects messages in our own form, `events` those of topics; only one of them may get any.
    own = OwnMessageCollector(network, path, table=is_rows, ignore_unknown=False)
    broken = ""
    for message in _yield_messages(path, sources):
        if isinstance(message, CutOffError) and not strict:
            broken = str(message)
        # What cannot be read is counted with our own form first; at the end with whichever form was used.
        elif isinstance(message, InputError) or (message.topic is None and is_own_message(message.content)):
            own.add(message, strict)
        elif events is None or sources is None:  # both are None together
            raise fail(message.where, "a message in our own form, or sources for its topic", message.topic or "none")
        else:
            _append_message(path, message, sources, events, strict)
    if events is None:
        events = own.events()
    elif own.used:
        if len(events):
            raise fail(str(path), "messages in our own form, or of topics", "both")
        events = own.events()
    else:  # all that was read is of topics, and so is what could not be
        events.refused += own.refused
        events.reasons += own.reasons
    events.broken = broken
    return events


def _read_log(path: Path, table: object, sources: TopicReader, strict: bool) -> EventTable:
    """Return the events of a vehicle's log.

    `table`: the sources as the user gave them, with what decodes the log (`LogSources`). `sources`: the same, checked
    against the network. `strict`: whether a message that cannot be read is an error. `events.notes` gets lines on what
    was left out.
    """
    events = EventTable(sources.network, sources.step_seconds)
    _append_messages_by_topic(path, read_log(path, table, sources, events.notes), sources, events, strict)
    return events


def _append_messages_by_topic(
    path: Path, messages: Iterator[FileMessage | InputError], sources: TopicReader, events: EventTable, strict: bool
) -> set[str | None]:
    """Append the events of messages that name their topics, and return these topics.

    An unreadable message is counted (raised if `strict`). A `CutOffError` says where the file is damaged.
    `events.broken` holds it as a text.
    """
    topics = set[str | None]()
    for message in messages:
        if isinstance(message, CutOffError) and not strict:
            events.broken = str(message)
        elif isinstance(message, InputError):
            events.refuse(message, strict)
        else:
            topics.add(message.topic)
            _append_message(path, message, sources, events, strict)
    return topics


def _append_message(
    path: Path | StoreTable, message: FileMessage, sources: TopicReader, events: EventTable, strict: bool
) -> None:
    """Append the events of a message; what cannot be read is refused alone.

    A source says how the values of a node are read from messages of a topic. An event is what one message says: a
    node's values with the time of measuring and of arrival.

    Args:
        path: the file, the folder or the store's table.
        message: the message: topic, content, time of arrival and place in the file.
        sources: reads messages by the sources of their topic; it also notes whether devices are online.
        events: the table to which events are appended; it counts what was refused.
        strict: whether a message that cannot be read is an error.
    """
    # A message without a topic has the topic of its table or file.
    topic = message.topic
    if topic is None:
        topic = path.topic if isinstance(path, StoreTable) else find_topic_of_file(path, sources)
    try:
        # The status of a device, online or offline, is no event.
        if sources.device_statuses.take_status_message(topic, message.content, message.where):
            return
        # The payload of a topic that nobody asks for may be anything.
        content = decode_message_content(message) if sources.of(topic) else None
        arrival = None if message.arrival is None else parse_arrival(message.arrival, f"{message.where}, arrival")
        # A message may be of several nodes. What cannot be read of one is noted, so that it does not count as lost.
        for reading in sources.read(topic, content, message.where):
            if isinstance(reading, Unread):
                events.refuse(reading.error, strict)
                events.note_unread(reading, arrival)
            else:
                _append_reading(topic, message, content, reading, arrival, sources, events)
    except InputError as error:
        events.refuse(error, strict)


def _append_reading(
    topic: str,
    message: FileMessage,
    content: object,
    reading: Reading,
    arrival: int | None,
    sources: TopicReader,
    events: EventTable,
) -> None:
    """Append the event of one reading of a message, unless only the arrival of a stored message would date it.

    A reading has the values of one node in a message, and its time of measuring, if the message says it; else the time
    of arrival dates the event.

    Args:
        topic: topic of the message.
        message: the message.
        content: its payload, decoded.
        reading: what one source read in it.
        arrival: when the message arrived, in nanoseconds since 1970; None if the message does not say it: then the time
            of measuring stands for it.
        sources: the sources, which note clocks and senders of messages.
        events: the table to which the event is appended.

    Raises:
        ValueError: neither a time nor an arrival.
    """
    arrived = reading.time if arrival is None else arrival
    if arrived is None:
        what = "a time field (time=...), or a field or column 'arrival'"
        raise fail(f"{message.where}, {topic}", what, "neither")
    # A stored message is what a broker kept for new subscribers: it arrives when they subscribe, however old it is.
    if message.stored and reading.time is None:
        sources.stored += 1
        return
    # Clocks of topics whose messages say nothing of their arrival are compared with each other.
    if arrival is None and reading.time is not None and events.dated:
        sources.clocks.note_time(topic, content, reading.time, (single.source for single in sources.of(topic)))
    events.add(sources.date_copy_as_original(reading, arrival), arrived)
    sources.senders.note_fields(topic, reading.plant, reading.node, content, sources.list_fields(topic))


def _note_left_out(path: Path | StoreTable, sources: TopicReader, events: EventTable) -> None:
    """Add notes to the events on messages and files that were left out, and on clocks and senders of the sources.

    `sources.clocks` has compared the clocks of topics, `sources.senders` the fields that name senders.
    `sources.unknown` counts messages of topics without a source, `sources.stored` those that a broker had stored.

    Raises:
        ValueError: a field that no message of its topic had, clocks that cannot be joined.
    """
    if absent := sources.describe_absent_field():
        raise InputError(absent)
    # Topics whose times count from 0 and have no date.
    from_zero = sources.clocks.find_topics_without_dates(str(path))
    if isinstance(path, Path) and is_message_folder(path) and not is_log(path):
        events.notes += describe_unused_files(path, sources)
        if len(from_zero) > 1:
            remedy = "start= or offset= of hg.files.Stamp says if they are not"
            events.notes.append(f"{path}: times from 0 are taken as of one clock: {', '.join(from_zero)} ({remedy})")
    if sources.unknown.total():
        counts = ", ".join(f"{topic} ({count})" for topic, count in sources.unknown.items() if count)
        events.notes.append(f"{path}: not among the sources: {counts}")
    events.notes += [f"{path}: {note}" for note in (*sources.notes, *sources.senders.describe_several_senders())]
    if sources.stored:
        events.notes.append(f"{path}: {sources.stored} stored messages were left out: without time= they have no date")
    if not sources.time_counts_steps and not len(events) and not events.reasons and not events.broken:
        raise fail(str(path), f"a message of the sources, {', '.join(sources.topics[:8])}", "none")
