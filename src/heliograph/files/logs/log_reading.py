"""Messages of a vehicle's log for the sources of a network, checked against the signals that the log has."""

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path

from heliograph.files.logs.can_frames_to_messages import open_frame_log
from heliograph.files.logs.log_sources import STAMP, LogSources
from heliograph.files.logs.mdf import open_mdf
from heliograph.files.logs.ulog import open_ulog
from heliograph.files.logs.vehicle_log import MDF, ULOG, Log, Wanted, list_logs
from heliograph.files.messages.message_files import FileMessage
from heliograph.files.sources.topic_reader import TopicReader
from heliograph.numerics.check import InputError, fail

LISTED = 8  # names in one line
OR = " or "  # between units of a signal that differ from log to log


def open_logs(path: Path, sources: LogSources, wanted: Wanted) -> Log:
    """Return a vehicle's log, or those in a folder as one, file by file; only messages that are wanted are decoded.

    Args:
        path: the log, or the folder.
        sources: what decodes it: the database of a bus's signals, the channel of the bus, and when the log began.
        wanted: a function that says whether a message of a name is decoded.

    Raises:
        ValueError: what `open_log` refuses.
        ModuleNotFoundError: what reads one is not installed.
    """
    logs = [open_log(part, sources, wanted) for part in list_logs(path) or [path]]
    if len(logs) == 1:
        return logs[0]
    # One `Log` of all: units and bits of the signals and kinds of the messages, by message, then the messages
    # themselves. A log's notes (lines on what was left out) are complete once all its messages have been read.
    notes = list[str]()

    def read_one_after_another() -> Iterator[FileMessage | InputError]:
        """Yield the messages of all `logs` of the folder; after each log append its notes to `notes`."""
        for log in logs:
            yield from log.messages
            notes.extend(log.notes)

    bits = dict[str, dict[str, int]]()
    for log in logs:
        for topic, bits_of_signal in log.bits.items():
            bits[topic] = {**bits.get(topic, {}), **bits_of_signal}
    kinds = {topic: kind for log in logs for topic, kind in log.kinds.items()}
    return Log(_join_units(logs), kinds, read_one_after_another(), notes, bits)


def _join_units(logs: Sequence[Log]) -> dict[str, dict[str, str]]:
    """Return {topic: {signal: its unit}} of the signals that any of the logs has.

    Units of a signal that differ between logs stand side by side, as "m/s or km/h". OR is " or ".
    """
    units = dict[str, dict[str, str]]()
    for log in logs:
        for topic, signals in log.units.items():
            known = units.setdefault(topic, {})
            for name, unit in signals.items():
                distinct_units = dict.fromkeys([*known.get(name, "").split(OR), unit])
                known[name] = OR.join(one for one in distinct_units if one)
    return units


def open_log(path: Path, sources: LogSources, wanted: Wanted) -> Log:
    """Open a vehicle's log; its format follows from its extension.

    ULog files, and MDF files without a database, hold decoded signals. All others hold frames of a CAN bus, raw bytes
    from which a database of the bus's messages (DBC) decodes signals. ULOG and MDF are the extensions of these formats.

    Args:
        path: the log.
        sources: what decodes it: the database, the channel of the bus, and when the log began.
        wanted: function that returns whether messages of a name are to be decoded.

    Raises:
        ValueError: there is no such file, it cannot be opened, or it holds frames and there is no database.
        ModuleNotFoundError: the reader's package is not installed (extra "can", "mdf" or "ulog").
    """
    if not path.is_file():
        raise fail(str(path), "a file", "a folder" if path.is_dir() else "nothing of that name")
    kind = path.suffix.lower()
    if kind in ULOG:
        return open_ulog(path, sources, wanted)
    if kind in MDF and sources.dbc is None:
        return open_mdf(path, sources, wanted)
    return open_frame_log(path, sources, wanted)


def read_log(path: Path, table: object, sources: TopicReader, notes: list[str]) -> Iterator[FileMessage | InputError]:
    """Yield the messages of a log that sources ask for, in order of time; an error in place of one that is unreadable.

    A log is a vehicle's or bus's file of signals over time; sources say which signals are a node's values. The logs in
    a folder are read one after another. Each message that is asked for must be in one of them.

    Args:
        path: the log, or the folder of logs.
        table: the sources as the network's file has them, a `LogSources` or a dictionary.
        sources: the same sources, checked against the network.
        notes: a list to which lines on units and on what was left out are appended.

    Raises:
        ValueError: there is no such log or database, a message or a signal is missing, or its unit differs between
            logs. The error is one line with the remedy.
    """
    given = table if isinstance(table, LogSources) else LogSources({})
    log = open_logs(path, given, lambda name: bool(sources.of(name)))
    where = str(path) if given.dbc is None else f"{path} by {given.dbc}"
    # The units of the signals that are used, for the notes; this raises ValueError if a signal is missing.
    used = _find_signal_units(where, path, log, sources)
    yield from log.messages
    notes += log.notes
    if path.is_dir():
        used_files = (*list_logs(path), given.dbc)
        other_files = [file.name for file in sorted(path.iterdir()) if file not in used_files]
        if other_files:
            notes.append(f"{path}: not read beside logs: {', '.join(other_files[:LISTED])}")
    if used:
        notes.append(f"{where}: in the file's units, before scale= and offset=: {', '.join(used)}")


def _find_signal_units(where: str, path: Path, log: Log, sources: TopicReader) -> list[str]:
    """Return the units of the log's signals that are read, as lines "topic.signal in unit", to be shown to the user.

    A log holds messages, each with signals. A source says which signal of which message is a measurement; a topic is
    the name of a message. A topic of the sources with a wildcard (+ or #) need not be in the log.

    STAMP is the field "timestamp", OR the text " or " between units that differ from log to log.

    Args:
        where: what is read, to begin the text of errors.
        path: the log, or a folder of several.
        log: the units of its signals, by message.
        sources: the sources, by topic.

    Raises:
        ValueError: a message or a signal that is not in the log, a signal of another unit in another log.
    """
    remedy = f"heliograph inspect {path} lists what there is"
    for topic in sources.topics:
        # Each topic that is named without a wildcard has to be a message of the log.
        if topic not in log.units and not set("+#") & set(topic):
            hint = "; dbc= of LogSources names their database" if not log.units else f"; {remedy}"
            raise fail(where, f"a message {topic!r} of the sources", f"{_suggest_names(topic, log.units)}{hint}")
    used = dict[str, None]()  # the lines, as keys: each once, in order
    # Each field that a source reads has to be a signal of its message, or the time stamp that every message has.
    for topic, signals in log.units.items():
        for mapped in sources.of(topic):
            for path_in_message in mapped.source.fields:
                # A path "a.b" is the signal of that name, or part b of the signal "a".
                name = path_in_message if path_in_message in signals else path_in_message.split(".")[0]
                if name not in signals and name != STAMP:
                    got = f"{_suggest_names(path_in_message, signals)}; {remedy}"
                    raise fail(f"{where}, {topic}", f"a signal {path_in_message!r} of the sources", got)
                if OR in signals.get(name, "") and len(list_logs(path)) > 1:
                    raise fail(f"{where}, {topic}", f"one unit of {name!r} in all logs", signals[name])
                if signals.get(name):
                    used[f"{topic}.{name} in {signals[name]}"] = None
    return list(used)


def _suggest_names(name: str, known: dict[str, object] | dict[str, str] | dict[str, dict[str, str]]) -> str:
    """Return words that say which known name is closest to `name`, or else list the first LISTED known names."""
    close = get_close_matches(name, known, 1)
    if close:
        return f"none of that name (closest: {close[0]!r})"
    more = f" and {len(known) - LISTED} more" if len(known) > LISTED else ""
    return f"only {', '.join(list(known)[:LISTED])}{more}" if known else "no message with signals"
