"""Messages of a bag decoded many at once: fields whose positions are fixed by the lengths of texts and lists."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from heliograph.files.bags.no_value_marks import blank_columns, list_flags
from heliograph.files.events.event_table import NONE, EventTable
from heliograph.files.sources.derived_values import Computed
from heliograph.files.sources.source_description import Source
from heliograph.files.sources.topic_reader import SECOND, TopicReader
from heliograph.numerics.check import InputError

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

# {type of a number: its size in bytes}
NUMBERS = {f"{kind}{bits}": bits // 8 for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
NUMBERS |= {"float32": 4, "float64": 8, "bool": 1}
HEAD = 0x100  # of CDR, little end first: numbers are aligned to their size, counted from after these four bytes
MOST_LENGTHS = 64  # in a message; one with more is decoded alone
FEWEST = 5  # messages of a topic and size on average; where they are fewer each is decoded alone
STAMP = ("sec", "nanosec")


class RawMessage(NamedTuple):
    """Message of a bag as it is stored: its topic with its type, the time it was logged in nanoseconds, its bytes."""

    connection: "Connection"
    logged: int
    data: bytes


class LayoutNotFixedError(Exception):
    """A message whose fields cannot be read at fixed positions: it is decoded alone, which says why if it fails."""


class MessageLayout:
    """Places of the wanted fields in a message, and the lengths of texts and lists that put them there.

    Messages of the same size with the same lengths at the same positions have all fields at the same positions.

    Args:
        definitions: fields by type of message, as rosbags has them.
        kind: type of the message.
        data: a message.
        paths: dotted paths of the numbers to read.

    Raises:
        LayoutNotFixedError: another encoding, a wanted field that is no number, a message that ends elsewhere.
    """

    def __init__(self, definitions: Any, kind: str, data: bytes, paths: set[str]):
        """Find where the fields at `paths` stand in messages that are laid out like `data`, one message's bytes.

        `definitions` holds the fields of each message type, and `kind` is this message's type. `self.lengths` maps the
        byte where a text's or list's length stands to that length; byte 0 holds the encoding's head, HEAD.
        `self.fields` maps the path of a wanted number to its byte and type. LayoutNotFixedError is raised if a wanted
        field has no fixed position.
        """
        self._definitions, self._data, self._paths = definitions, data, paths
        self.lengths = dict[int, int]()
        self.fields = dict[str, tuple[int, str]]()
        self._note_length(0)
        end = self._locate_message_numbers(begin=4, kind=kind, prefix="")
        has_padding_alone_behind = 0 <= len(data) - end < 4  # a message is filled up to a multiple of four bytes
        if self.lengths[0] != HEAD or not has_padding_alone_behind or paths != self.fields.keys():
            raise LayoutNotFixedError

    def fits(self, table: np.ndarray) -> np.ndarray:
        """Return for each message of a table of bytes (messages, size) whether it has this layout, (messages,).

        A message has it if all its texts and lists have the same lengths as those of the message that `self` was made
        from. `self.lengths` maps the byte where a length stands to the length, a uint32. Byte 0 holds the four bytes of
        the encoding's head instead.
        """
        has_equal_lengths = np.ones(len(table), dtype=bool)
        for first_byte, length in self.lengths.items():
            has_equal_lengths &= _decode_column(table, first_byte, "uint32") == length
        return has_equal_lengths

    def read_columns(self, table: np.ndarray) -> dict[str, np.ndarray]:
        """Return {path of a wanted field: its values (messages,)}; `table`: messages of this layout as bytes."""
        return {path: _decode_column(table, begin, kind) for path, (begin, kind) in self.fields.items()}

    def _locate_message_numbers(self, begin: int, kind: str, prefix: str) -> int:
        """Note where the wanted numbers of a message stand, which begins at byte `begin`; return the byte of its end.

        `prefix` is the path of a message inside another one, with a dot; it is "" for the outermost message.
        LayoutNotFixedError means that fields have no fixed positions, so that messages must be decoded one by one.
        """
        if kind not in self._definitions:  # a type that the bag does not describe, as "wstring"
            raise LayoutNotFixedError
        _constants, fields = self._definitions[kind]
        for name, (node, item_type) in fields:
            begin = self._locate_field_numbers(begin, str(node.name), item_type, prefix + name)
        return begin

    def _locate_field_numbers(self, begin: int, node: str, of: Any, path: str) -> int:
        """Note where the wanted numbers of one field stand in a message's bytes; return where the next field begins.

        A bag has many messages of the same layout. Once the byte of each wanted number is known, all of them are read
        at once, without decoding one by one. The bytes are those of CDR, the encoding of ROS 2: each number is aligned
        to its size. `self._paths`: dotted paths of the wanted numbers. Lengths of texts and lists are noted too
        (`_note_length` returns the one that stands at a byte): only messages of the same lengths have this layout.

        Args:
            begin: the first byte behind the previous field.
            node: what the field is, as rosbags names it: "NAME" of a message, "BASE" of a number or text, "ARRAY" or
                "SEQUENCE" of a list of fixed or of any length.
            of: of "NAME" the message's type; of "BASE" the basic type, first in a tuple; of a list what each of its
                items is, as a pair like `node` and `of`, and how many there are ("SEQUENCE": at most).
            path: dotted path of the field in the whole message.
        """
        # A message within the message: locate its fields in turn.
        if node == "NAME":
            return self._locate_message_numbers(begin, of, f"{path}.")
        # A text: four bytes with its length, then its characters. The length is part of the layout.
        if node == "BASE" and of[0] == "string":
            begin = _align_to_size(begin, 4)
            return begin + 4 + self._note_length(begin)
        # A single number.
        if node == "BASE":
            return self._locate_numbers_in_row(begin, of[0], 1, [path])
        # A list. If it may have any length, its length stands in four bytes before its items.
        (item_node, item_of), count = of
        if node == "SEQUENCE":
            begin = _align_to_size(begin, 4)
            count, begin = self._note_length(begin), begin + 4
        # A list of numbers is located at once, since it may have millions; names are made only if some are wanted.
        if item_node.name == "BASE" and item_of[0] in NUMBERS:
            is_wanted = any(name.startswith(f"{path}.") for name in self._paths)
            names = [f"{path}.{i}" for i in range(count)] if is_wanted else []
            return self._locate_numbers_in_row(begin, item_of[0], count, names)
        # Other items one after the other.
        for i in range(count):
            begin = self._locate_field_numbers(begin, item_node.name, item_of, f"{path}.{i}")
        return begin

    def _locate_numbers_in_row(self, begin: int, kind: str, count: int, names: list[str]) -> int:
        """Note the bytes of the wanted numbers among `count` numbers in a row; return the byte after the last.

        `names` holds the paths of the numbers. `kind` is their type, such as "uint16", whose size in bytes is in
        NUMBERS. Every number begins at a multiple of its size. LayoutNotFixedError: the type has no fixed
        size. `self._paths`: the wanted paths. `self.fields`: {path: (first byte, type)}.
        """
        size = NUMBERS.get(kind)
        if size is None:
            raise LayoutNotFixedError
        begin = _align_to_size(begin, size) if count else begin
        for i, name in enumerate(names):
            if name in self._paths:
                self.fields[name] = begin + i * size, kind
        return begin + count * size

    def _note_length(self, begin: int) -> int:
        """Return the length of a text or list, which stands at byte `begin`, and note it as part of the layout.

        If a message has more than MOST_LENGTHS lengths, or a text reaches beyond its end, messages are decoded one by
        one (LayoutNotFixedError). Byte 0 holds the head of the encoding instead of a length.
        """
        length = int.from_bytes(self._data[begin : begin + 4], "little")
        self.lengths[begin] = length
        if len(self.lengths) > MOST_LENGTHS or (begin and begin + 4 + length > len(self._data)):
            raise LayoutNotFixedError
        return length


class BatchDecoder:
    """Decodes messages of mapped topics, many at once: values, stamps and counts as arrays.

    Args:
        reader: the bag.
        sources: sources of the network.
    """

    def __init__(self, reader: "AnyReader", sources: TopicReader):
        """Hold the bag's definitions of messages and the network's sources; no layout of a message is known yet."""
        self._definitions = reader.typestore.fielddefs
        self._sources = sources
        self._is_ros2 = reader.is2
        self._layouts = defaultdict[tuple[str, int], list[MessageLayout]](list)
        self.marked = Counter[str]()  # by topic: messages that say that something read of them has no value

    def append_events(self, batch: Sequence[RawMessage], table: EventTable) -> bool:
        """Append the measurements of many messages to a table; return whether that was possible.

        If it returns False, nothing was appended: the messages have no fixed layout and must be decoded one by one by
        `TopicReader.read`, which gives the same numbers in the same order.

        `self.marked` counts by topic the messages that mark a field as having no value. `NodeReadings` are arrays:
        index in the batch (`rows`), time, running count and values of each reading, and the `period` after which the
        count begins at 0 again.

        Args:
            batch: messages of a bag: topic and type, time of logging, and bytes.
            table: where the events go.
        """
        try:
            readings, marked = self._read_by_node(batch)
        except LayoutNotFixedError:
            return False
        self.marked += marked
        for node, blocks in readings.items():
            # Blocks are by layout: sort their readings into the order in which the messages came.
            rows = np.concatenate([block.rows for block in blocks])
            order = np.argsort(rows, kind="stable")
            logged = np.array([batch[row].logged for row in rows[order].tolist()], dtype=np.int64)
            table.add_many(
                node,
                arrival=logged,
                time=np.concatenate([block.time for block in blocks])[order],
                sequence=np.concatenate([block.sequence for block in blocks])[order],
                values=np.concatenate([block.values for block in blocks])[order],
                period=blocks[-1].period,
            )
        return True

    def _read_by_node(self, batch: Sequence[RawMessage]) -> "tuple[dict[str, list[NodeReadings]], Counter[str]]":
        """Return the readings of each node, and by topic how many messages mark some field as having no value.

        A node's readings are a list of blocks, one for the messages of one topic, size and layout: these have each
        field at the same byte, so that NumPy reads a field from all of them at once.

        Raises:
            LayoutNotFixedError: messages that have to be decoded one by one.
        """
        if not self._is_ros2:  # bags of ROS 1 are encoded otherwise
            raise LayoutNotFixedError
        # {(topic, size): indices of its messages in the batch}
        groups = defaultdict[tuple[str, int], list[int]](list)
        for i, message in enumerate(batch):
            groups[message.connection.topic, len(message.data)].append(i)
        if FEWEST * len(groups) > len(batch):  # fewer than 5 of a kind on average are not worth it
            raise LayoutNotFixedError
        results = defaultdict[str, list[NodeReadings]](list)
        counts = Counter[str]()
        for (topic, _), members in groups.items():
            # The messages of one topic and size as bytes, (messages, size).
            table = np.frombuffer(b"".join(batch[i].data for i in members), dtype=np.uint8).reshape(len(members), -1)
            connection = batch[members[0]].connection
            # Messages of one layout: their rows in the table, and their wanted fields.
            for rows, fields in self._yield_rows_by_layout(connection, table):
                # Fields by path (messages,), NaN where a flag says that there is no value.
                columns, marked = blank_columns(connection.msgtype, fields, self._list_judged_paths(topic))
                counts[topic] += int(np.count_nonzero(marked))
                for source, _, indices in self._sources.of(topic):
                    # The node, and the indices of its values: one, as `_list_paths_of_numbers` refuses others.
                    ((node, outputs),) = indices.items()
                    size = len(self._sources.names[node])
                    results[node].append(_make_node_readings(np.array(members)[rows], columns, source, outputs, size))
        return results, counts

    def _list_judged_paths(self, topic: str) -> set[str]:
        """Return the paths of a topic's fields that another field (a flag) may declare to have no value.

        A source whose `valid` is {} ignores such flags.
        """
        sources = [mapped.source for mapped in self._sources.of(topic)]
        return {path for source in sources if source.valid != {} for path in _list_paths_of_numbers(source)}

    def _yield_rows_by_layout(
        self, connection: "Connection", table: np.ndarray
    ) -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Yield (rows of `table` of one layout, {path: wanted field (rows,)}) until all messages are covered.

        Layouts are kept for later calls, since most messages of a topic have one of a few layouts. `self._layouts` has
        by topic and size the layouts so far; `fits` marks the messages (rows of the table) of one layout, and
        `read_columns` reads their fields.

        Args:
            connection: topic and type of the messages.
            table: the messages, all of one size, (messages, bytes).
        """
        known = self._layouts[connection.topic, table.shape[1]]
        left, index = np.arange(len(table)), 0  # rows whose layout is not found yet, and the next layout to try
        while len(left):
            # No known layout fits: make one from the first message that is left.
            if index == len(known):
                paths = set[str]()
                for mapped in self._sources.of(connection.topic):
                    paths.update(_list_paths_of_numbers(mapped.source))
                paths |= list_flags(connection.msgtype, self._list_judged_paths(connection.topic))
                known.append(MessageLayout(self._definitions, connection.msgtype, table[left[0]].tobytes(), paths))
            fits = known[index].fits(table[left])
            yield left[fits], known[index].read_columns(table[left[fits]])
            left, index = left[~fits], index + 1


class NodeReadings(NamedTuple):
    """Readings of a node as arrays: rows, time and sequence (readings,), values (readings, outputs)."""

    rows: np.ndarray  # index of each reading's message in the batch
    time: np.ndarray  # stamp in nanoseconds; NONE where there is none
    sequence: np.ndarray  # running count of the sender's messages; -1 where there is none
    values: np.ndarray  # NaN where there is no value
    period: int  # after which the running count begins again at 0; 0 if it never does


def _list_paths_of_numbers(source: Source) -> list[str]:
    """Return the dotted paths of the numbers that a source reads: values, both parts of a stamp, and a running count.

    A path is a text, or a value computed from several fields, whose paths `_list_component_paths` lists. STAMP: the
    names of seconds and nanoseconds.

    Raises:
        LayoutNotFixedError: the source's messages must be decoded one by one. Its plant or node stands in the message,
            a condition (`where`) chooses messages, or its times are steps.
    """
    if source.plant is not None or not isinstance(source.node, str) or source.where or source.time_unit == "step":
        raise LayoutNotFixedError
    values = [component for path in source.paths for component in _list_component_paths(path)]
    stamp = [] if source.time is None else [f"{source.time.path}.{field}" for field in STAMP]
    count = [] if source.sequence is None else [source.sequence.path]
    return [*values, *stamp, *count]


def _list_component_paths(path: str | Computed) -> tuple[str, ...]:
    """Return the paths of the numbers of which a value is computed; that of the value itself if it is not."""
    return (path,) if isinstance(path, str) else path.parts


def _make_node_readings(
    rows: np.ndarray, columns: dict[str, np.ndarray], source: Source, indices: np.ndarray, size: int
) -> NodeReadings:
    """Return the readings of one source from the fields of many messages.

    A source says which fields of a topic's messages are which values of a node, with scale and offset; here all
    messages are read at once, column by column.

    Args:
        rows: indices of the messages in the batch (messages,).
        columns: {path of a field: its values (messages,)}.
        source: paths, scales and offsets of the values, the time stamp, and the running count, if there is one.
        indices: for each of its values the index among the values that its node receives.
        size: how many values the node receives.

    Raises:
        LayoutNotFixedError: a stamp, a count or part of a value that is none; reading message by message then names it.
    """
    # Values (messages, size), NaN where a field is not finite or not in the message.
    values = np.full((len(rows), size), np.nan)
    for index, path, scale, offset in zip(indices, source.paths, source.scale, source.offset, strict=True):
        value = _compute_value_column(columns, path)
        values[:, index] = np.where(np.isfinite(value), scale * value + offset, np.nan)
    # A time stamp of seconds and nanoseconds (the fields of STAMP); NONE stands for no time. 0 means that it was not
    # set. Its seconds must have at most 32 bits, so that the nanoseconds since 1970 fit into 64.
    time = np.full(len(rows), NONE)
    if source.time is not None:
        seconds, nanoseconds = (columns[f"{source.time.path}.{field}"] for field in STAMP)
        time = seconds.astype(np.int64) * SECOND + nanoseconds
        if seconds.dtype.itemsize > 4 or np.any(time == 0):
            raise LayoutNotFixedError
        time += source.time.shift
    # A running count of the sender's messages; -1 stands for none.
    if source.sequence is None:
        return NodeReadings(rows, time, sequence=np.full(len(rows), -1, dtype=np.int64), values=values, period=0)
    # A count has to be a whole number from 0 on.
    sequence = columns[source.sequence.path]
    if sequence.dtype.kind not in "iu" or np.any(sequence.astype(np.int64) < 0):
        raise LayoutNotFixedError
    return NodeReadings(rows, time, sequence.astype(np.int64), values, source.sequence.period)


def _compute_value_column(columns: dict[str, np.ndarray], path: str | Computed) -> np.ndarray:
    """Return one value of many messages, (messages,): the field at `path`, or a number computed from its `parts`.

    `columns` maps the path of a field to its numbers (messages,). A number that is not finite becomes NaN.

    Raises:
        LayoutNotFixedError: a field has an impossible number, such as a latitude beyond 90 degrees.
    """
    components = [columns[name].astype(np.float64) for name in _list_component_paths(path)]
    finite_or_nan = [np.where(np.isfinite(numbers), numbers, np.nan) for numbers in components]
    try:
        return finite_or_nan[0] if isinstance(path, str) else np.asarray(path.of(*finite_or_nan))
    except InputError:
        raise LayoutNotFixedError from None


def _decode_column(table: np.ndarray, begin: int, kind: str) -> np.ndarray:
    """Return the number of type `kind`, such as "uint16", at byte `begin` of each message, (messages,).

    `table` holds the bytes of messages, (messages, size); numbers are little end first. NUMBERS: bytes of each type.
    """
    column = np.ascontiguousarray(table[:, begin : begin + NUMBERS[kind]])
    return column.view(np.dtype(kind).newbyteorder("<"))[:, 0]


def _align_to_size(begin: int, size: int) -> int:
    """Return the first byte from `begin` on at which a number of `size` bytes may stand.

    CDR aligns a number to a multiple of its size, counted from behind the head of four bytes.

    So begin - 4 is rounded up to a multiple of `size`, and 4 added again. `begin` is 4 or more.
    """
    return 4 + -(-(begin - 4) // size) * size
