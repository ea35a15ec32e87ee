"""Frames of a CAN bus, of BLF, ASC, candump and MDF4, to messages with the signals that a database describes."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from heliograph.files.logs.log_sources import STAMP, LogSources
from heliograph.files.logs.vehicle_log import DIGITS, Log, Wanted
from heliograph.files.messages.message_files import FileMessage
from heliograph.files.text.text_file import CANDUMP, CutOffError, find_extension
from heliograph.numerics.check import InputError, error_text, fail

if TYPE_CHECKING:
    from can import Message
    from can.io.generic import MessageReader
    from cantools.database.can import Message as Description
    from cantools.database.can import Signal

LISTED = 8  # identifiers in one line
CODES = 0xFB / 0xFF  # share of the range of a signal's bits from which on a named value is a code, as in J1939
Database = dict[tuple[int, bool], "Description"]  # {(identifier, whether it has 29 bits): message with its signals}


def open_frame_log(path: Path, sources: LogSources, wanted: Wanted) -> Log:
    """Open a log of CAN frames; a database of messages (DBC) says what signals they carry.

    Without a database, messages are named by their identifiers and have no signals.

    A `Log` has units, kinds and bits of the signals by message, the messages, and notes on what was left out, which are
    complete once the messages are read. `wanted`: says of a message's name whether it is decoded.

    Raises:
        ValueError: the database cannot be read.
        ModuleNotFoundError: python-can or cantools is not installed (extra "can"), or asammdf (extra "mdf").
    """
    database = {} if sources.dbc is None else read_can_database(sources.dbc)
    notes = list[str]()
    units = dict[str, dict[str, str]]()
    kinds = dict[str, str]()
    bits = dict[str, dict[str, int]]()
    for message in database.values():
        signals = message.signals
        units[message.name] = {signal.name: signal.unit or "" for signal in signals}
        kinds[message.name] = f"CAN 0x{message.frame_id:x}"
        # How many bits each signal has that is a plain integer, such as a counter.
        bits[message.name] = {signal.name: signal.length for signal in signals if signal.scale == 1 and not signal.unit}
    return Log(units, kinds, FrameReader(path, sources, database, wanted, notes).read_messages(), notes, bits)


def read_can_database(path: Path) -> Database:
    """Return the messages that a database of a bus (such as a DBC file) describes, by their identifiers.

    Messages that are containers of others are left out.

    Raises:
        ValueError: no such file, or no database of a CAN bus; one line.
    """
    from cantools import database
    from cantools.database.can import Database as CanDatabase

    if not path.is_file():
        raise fail(str(path), "a database of a CAN bus", "a folder" if path.is_dir() else "nothing of that name")
    try:
        # Not strict, since signals of real databases overlap.
        loaded: Any = database.load_file(path, strict=False)
    except Exception as error:  # whatever a damaged file makes a parser do
        raise fail(str(path), "a database of a CAN bus", error_text(error)) from None
    if not isinstance(loaded, CanDatabase):
        raise fail(str(path), "a database of a CAN bus", "one of diagnostics")
    return {(m.frame_id, m.is_extended_frame): m for m in loaded.messages if not m.is_container}


def find_words(signal: "Signal") -> dict[float, str]:
    """Return {value: word} for values of a physical quantity that are no measurement, such as "SNA" (not available).

    A value stands for a word if the database names it and it is out of the signal's range, or is at the end of what its
    bits hold: from 0xFB.. of 0xFF.. on, or for a signed signal the least and the greatest. A named value within the
    range, such as 0 "standstill", is a measurement. So are all values of a signal without unit, scale and offset, which
    counts or enumerates. CODES is 0xFB / 0xFF.
    """
    is_quantity = signal.unit or signal.scale != 1 or signal.offset != 0
    if not is_quantity or not signal.choices or signal.is_float:
        return {}
    greatest = 2 ** (signal.length - signal.is_signed) - 1  # raw number that the signal's bits hold
    least = -greatest - 1  # if it is signed
    words = dict[float, str]()
    for raw, word in signal.choices.items():
        value: Any = signal.conversion.raw_to_scaled(raw, decode_choices=False)
        is_beyond = signal.minimum is not None and value < signal.minimum
        is_beyond |= signal.maximum is not None and value > signal.maximum
        is_code = raw in (least, greatest) if signal.is_signed else raw >= math.ceil(CODES * greatest)
        if is_beyond or is_code:
            words[value] = str(word)
    return words


class FrameReader:
    """Reads frames as messages, and counts what is left out.

    Args:
        path: the log.
        sources: the bus's channel, the date of the begin, and the name of the database.
        database: messages by identifier.
        wanted: whether a message of a name is decoded.
        notes: lines on what was left out, appended at the end.
    """

    def __init__(self, path: Path, sources: LogSources, database: Database, wanted: Wanted, notes: list[str]):
        """Prepare to read a log of frames by a database of its messages.

        `wanted` says by a message's name whether it is read. `notes` gets lines on what was left out.
        """
        self._path, self._sources, self._database = path, sources, database
        self._wanted, self._notes = wanted, notes
        # By a message's name: frames decoded, frames longer than described, sizes of too short frames, and channels.
        self._decoded, self._longer = Counter[str](), Counter[str]()
        self._short: dict[str, Counter[int]] = defaultdict(Counter)
        self._channels: dict[str, set[object]] = defaultdict(set)
        # By a message's name: its signals' words, and by signal and word how often it came instead of a number.
        self._words = {m.name: {s.name: find_words(s) for s in m.signals} for m in database.values()}
        self._came_as_words = Counter[str]()
        # How many frames came of each identifier, and how many of each kind were left out.
        self._identifiers, self._left_out = Counter[str](), Counter[str]()

    def read_messages(self) -> Iterator[FileMessage | InputError]:
        """Yield the messages in the order of the file, or why one cannot be read; then note what was left out.

        `item` is a frame with its time, or the error that ends a damaged log. Error frames, remote frames and those of
        another bus (`channel`) are left out and counted.

        Raises:
            ValueError: no frame of a wanted message, frames all of which are too short for it, or of two buses.
        """
        for number, item in enumerate(_read_frames(self._path, self._sources), 1):
            if isinstance(item, InputError):
                yield item
                continue
            frame, moment = item
            if frame.is_error_frame or frame.is_remote_frame:
                self._left_out["error" if frame.is_error_frame else "remote"] += 1
            elif self._sources.channel in (None, frame.channel):
                message = self._decode_frame(frame, moment, f"{self._path}, frame {number}")
                if message is not None:
                    yield message
            else:
                self._left_out[f"of channel {frame.channel}"] += 1
        self._check_frames_fit_database()
        self._note_left_out()

    def _note_left_out(self) -> None:
        """Append lines to the notes: on frames left out, frames longer than described, and words instead of numbers.

        The three counters are by kind of frame, by message, and by signal and word.
        """
        if self._left_out:
            counts = ", ".join(f"{kind} ({count})" for kind, count in self._left_out.items())
            self._notes.append(f"{self._path}: frames left out: {counts}")
        if self._longer:
            counts = ", ".join(f"{name} ({count})" for name, count in self._longer.items())
            self._notes.append(f"{self._path}: frames longer than {self._sources.dbc} has them: {counts}")
        if self._came_as_words:
            counts = _join_names([f"{signal} ({count})" for signal, count in self._came_as_words.items()])
            self._notes.append(f"{self._path}: words of {self._sources.dbc} in place of numbers, not used: {counts}")

    def _decode_frame(self, frame: "Message", moment: float, where: str) -> FileMessage | InputError | None:
        """Return the message in a frame, or the error that says why it cannot be read; None if it is not wanted.

        `self._wanted` says whether a message of a name is decoded; without a database messages are named by their
        identifiers. `_check_channel` refuses frames of one message from two buses.

        Args:
            frame: the frame.
            moment: its time in seconds since 1970.
            where: place of the frame, for errors.
        """
        description = self._database.get((frame.arbitration_id, frame.is_extended_id))
        name = f"0x{frame.arbitration_id:x}" if description is None else description.name
        self._identifiers[f"0x{frame.arbitration_id:x}"] += 1
        if not self._wanted(name):
            return None
        signals: dict[str, Any] | InputError = {}
        if description is not None:
            self._check_channel(name, frame.channel)
            where = f"{where}, {name}"
            signals = self._decode_signals(frame, description, where)
        if isinstance(signals, InputError):
            return signals
        self._decoded[name] += 1
        return FileMessage(where, name, {STAMP: moment, **signals}, moment)

    def _decode_signals(self, frame: "Message", description: "Description", where: str) -> dict[str, Any] | InputError:
        """Return {name of a signal: its value, or None if the frame has none}, or the error why it cannot be read.

        The error is returned, not raised, since only this frame is refused and reading goes on. A value that stands for
        a word, such as "not available", becomes None, too. Frames of other lengths than described, and such words, are
        counted for notes to the user.

        Args:
            frame: the frame, as python-can reads it.
            description: the frame's message as the database has it; `length` is its number of bytes.
            where: place of the frame, for errors.
        """
        size, length = len(frame.data), description.length
        if size < length:
            self._short[description.name][size] += 1
            return fail(where, f"{length} bytes, as {self._sources.dbc} has it", f"{size}")
        try:
            decoded: Any = description.decode(bytes(frame.data), decode_choices=False)
        except Exception as error:  # a multiplexer that the database does not know
            return fail(where, f"what {self._sources.dbc} describes", error_text(error))
        if size > length:
            self._longer[description.name] += 1
        # A multiplexed message has only some of its signals in each frame; the others are None.
        signals: dict[str, Any] = dict.fromkeys(signal.name for signal in description.signals) | decoded
        # `self._words`: for each signal of a message {number: the word that it stands for}.
        for name, words in self._words[description.name].items():
            if words and (word := words.get(signals[name])) is not None:
                self._came_as_words[f"{description.name}.{name} {word!r}"] += 1
                signals[name] = None
        return signals

    def _check_channel(self, name: str, channel: object) -> None:
        """Raise ValueError if the message `name` comes from a second bus; `channel` is the bus of this frame."""
        seen = self._channels[name]
        seen.add(channel)
        if len(seen) > 1:
            expected = "one bus, which channel= of LogSources (--channel of heliograph inspect) names"
            raise fail(f"{self._path}, {name}", expected, sorted(map(str, seen)))

    def _check_frames_fit_database(self) -> None:
        """Raise ValueError if all frames of a wanted message are too short, or if no frame is of a wanted message.

        By a message's name, `self._short` counts the sizes of frames too short to decode, and `self._decoded` counts
        decoded frames. `self._identifiers` counts the frames by identifier, for the error.
        """
        remedy = "another database, or another bus (channel=)?"
        for name, sizes in self._short.items():
            if not self._decoded[name]:
                length = next(m.length for m in self._database.values() if m.name == name)
                got = f"{sizes.total()} of {', '.join(map(str, sorted(sizes)))}; {remedy}"
                raise fail(f"{self._path}, {name}", f"frames of {length} bytes, as {self._sources.dbc} has it", got)
        wanted = [f"{m.name} (0x{m.frame_id:x})" for m in self._database.values() if self._wanted(m.name)]
        if wanted and not self._decoded:
            among = f"only {_join_names(list(self._identifiers))}; {remedy}" if self._identifiers else "no frame at all"
            if self._sources.channel is not None and not self._identifiers:
                among = ", ".join(f"frames {kind}" for kind in self._left_out) or among
            raise fail(str(self._path), f"a frame of {_join_names(wanted)}", among)


def _read_frames(path: Path, sources: LogSources) -> "Iterator[tuple[Message, float] | InputError]":
    """Yield (frame, its time in seconds since 1970); if the file is damaged, the last item is a `CutOffError`.

    `opened` has the reader, `begin` (the log's begin as the reader counts times) and `shift` (added to the reader's
    times gives seconds since 1970). DIGITS: decimals of a time in seconds.
    """
    count = 0
    with ExitStack() as stack:
        try:
            opened = _open_frame_reader(path, stack)
        except (InputError, ModuleNotFoundError):
            raise
        except Exception as error:  # whatever a damaged file makes a reader do
            raise fail(str(path), "a log of a CAN bus", error_text(error)) from None
        # What is added to the file's times to get seconds since 1970; `sources.start` is a date that the user gives.
        shift = opened.shift if sources.start is None else sources.start - opened.begin
        frames = iter(opened.reader)
        while True:
            try:
                frame = next(frames, None)
            except Exception as error:  # whatever a damaged file makes a reader do
                yield CutOffError(str(fail(f"{path}, after frame {count}", "a log without damage", error_text(error))))
                return
            if frame is None:  # the end
                return
            count += 1
            yield frame, round(frame.timestamp + shift, DIGITS)


class _OpenedFrames(NamedTuple):
    """A log of frames that is open for reading."""

    reader: "MessageReader"
    begin: float  # time of the log's begin, as the reader counts times
    shift: float  # added to the reader's times gives seconds since 1970


def _open_frame_reader(path: Path, stack: ExitStack) -> _OpenedFrames:
    """Open a log of frames by its kind: BLF, ASC, candump, or else MDF4; the stack closes it.

    Raises:
        ValueError: an ASC log whose times are from each event to the next.
    """
    kind = find_extension(path)
    if kind == ".blf":
        from can import BLFReader

        blf = BLFReader(path)
        stack.callback(blf.stop)
        return _OpenedFrames(blf, begin=blf.start_timestamp, shift=0.0)
    if kind == ".asc":
        return _open_asc(path, stack)
    if kind == CANDUMP:
        from can import CanutilsLogReader

        # A first reader for the time of the first frame, when the log began.
        with CanutilsLogReader(path) as frames:
            begin = next(iter(frames)).timestamp
        return _OpenedFrames(stack.enter_context(CanutilsLogReader(path)), begin=begin, shift=0.0)
    import asammdf
    from can.io.mf4 import MF4Reader

    with asammdf.MDF(path) as file:
        begin = file.start_time.timestamp()
    return _OpenedFrames(stack.enter_context(MF4Reader(path)), begin=begin, shift=0.0)


def _open_asc(path: Path, stack: ExitStack) -> _OpenedFrames:
    """Open an ASC log, whose frames have seconds since the log's begin; `stack` closes it.

    The date of the begin has no time zone, and is read as UTC on every machine. `_OpenedFrames` has the reader, the
    log's begin in the reader's times, and what is to be added to these for seconds since 1970.

    Raises:
        ValueError: the times are differences between neighbouring events.
    """
    from can import ASCReader

    # This first reader reads only the header.
    header = ASCReader(path, relative_timestamp=False)
    stack.callback(header.stop)
    next(iter(header), None)
    if header.timestamps_format == "relative":
        expected = "times from the log's begin ('timestamps absolute' in its header)"
        raise fail(str(path), expected, "times from each event to the next")
    begin = datetime.fromtimestamp(header.start_time).replace(tzinfo=UTC).timestamp() if header.start_time else 0.0
    return _OpenedFrames(stack.enter_context(ASCReader(path)), begin=0.0, shift=begin)


def _join_names(names: list[str]) -> str:
    """Return names joined by commas: the first LISTED of them, and how many more there are."""
    return ", ".join(names[:LISTED]) + (f" and {len(names) - LISTED} more" if len(names) > LISTED else "")
