"""Topics of a bag or a broker: their rates, gaps and lateness, and sources to paste."""

import json
import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from heliograph.files.bag import OFTEN, Progress, fields_of, opened
from heliograph.files.fields import nanoseconds
from heliograph.files.mcap_chunks import messages_of
from heliograph.numerics.check import InputError, fail, shown_error
from heliograph.numerics.dates import looks_like_date

SECOND = 1e9  # nanoseconds
STAMP = "header.stamp"
FEW = 6  # fields that a suggestion lists
NO_NUMBERS = ("string", "wstring", "list", "char", "wchar")


@dataclass
class Topic:
    """Messages of one topic: times of logging or arrival, and lateness in seconds where messages have a time.

    Attributes:
        kind: type of the messages.
        fields: dotted paths of their numbers.
        time: dotted path of their time; None if they have none.
    """

    kind: str
    fields: list[str] = field(default_factory=list)
    time: str | None = None
    logged: "array[int]" = field(default_factory=lambda: array("q"))
    late: "array[float]" = field(default_factory=lambda: array("d"))

    def row(self) -> list[str]:
        """Return type, count, rate, largest gap and lateness (median, 95 %, largest), as text."""
        times = np.sort(np.array(self.logged, dtype=np.int64))
        apart = np.diff(times) / SECOND
        span = float(apart.sum())
        rate = f"{len(apart) / span:.3g} Hz" if span > 0 else "-"
        late = (
            " ".join(f"{value:.3g}" for value in np.quantile(np.array(self.late), [0.5, 0.95, 1.0]))
            if self.late
            else "-"
        )
        return [self.kind, f"{len(times)}", rate, f"{apart.max():.3g} s" if len(apart) else "-", late]


def inspect_bag(path: Path, progress: Progress | None = None) -> tuple[dict[str, Topic], str]:
    """Return the topics of a bag, and where and why reading it ended early, "" if it did not.

    Raises:
        ValueError: no bag, or one that cannot be opened.
    """
    topics: dict[str, Topic] = {}
    # Types first, then each message's times, of which a header is read without decoding the rest.
    with opened(path) as (reader, cut):
        for connection in reader.connections:
            fields = list(fields_of(reader, connection.msgtype))
            numbers = [name for name, kind in fields if kind not in NO_NUMBERS and not name.startswith("header.")]
            stamped = any(name == f"{STAMP}.sec" for name, _ in fields) and reader.is2
            topics.setdefault(connection.topic, Topic(connection.msgtype, numbers, STAMP if stamped else None))
        # When each message was logged, and how late by its stamp.
        total, done = reader.message_count, 0
        try:
            for done, (connection, logged, data) in enumerate(messages_of(reader, reader.connections), 1):
                topic = topics[connection.topic]
                topic.logged.append(logged)
                if topic.time is not None and len(data) >= 12:
                    topic.late.append((logged - _stamp(data)) / SECOND)
                if progress is not None and done % OFTEN == 0:
                    progress(done, total)
        except Exception as error:  # whatever damage makes a reader do
            return topics, str(fail(f"{path}, after message {done}", "a bag without damage", shown_error(error)))
        return topics, cut


def note(topics: dict[str, Topic], name: str, payload: bytes, arrival: int) -> None:
    """Add a message of a broker to its topic; `arrival` is in nanoseconds since 1970."""
    try:
        content = json.loads(payload)
        kind = "JSON"
    except (ValueError, RecursionError):
        content, kind = None, "no JSON"
    topic = topics.setdefault(name, Topic(kind))
    topic.logged.append(arrival)
    for path, value in _leaves(content):
        if isinstance(value, int | float) and path not in topic.fields:
            topic.fields.append(path)
        # A date in a message may be the time of its measurement.
        if isinstance(value, str) and looks_like_date(value) and topic.time in (None, path):
            try:
                topic.late.append((arrival - nanoseconds(value, "s", path)) / SECOND)
                topic.time = path
            except InputError:
                continue


def suggestion(topics: Mapping[str, Topic], names: Mapping[str, Sequence[str]]) -> str:
    """Return sources to paste into a network's file: a line for each topic that has numbers.

    Args:
        topics: the topics.
        names: outputs by node, and the inputs; empty if no network is known.
    """
    lines = [f"# {node}: {', '.join(outputs)}" for node, outputs in names.items()]
    lines.append("sources = {")
    for name, topic in sorted(topics.items()):
        if not topic.fields:
            continue
        more = ", ".join(topic.fields[1:FEW]) + (", ..." if len(topic.fields) > FEW else "")
        when = "" if topic.time is None else f", time={topic.time!r}"
        lines.append(f"    {name!r}: hg.files.json_field({topic.fields[0]!r}, node='NODE', output='OUTPUT'{when}),")
        lines += [f"    #   or {more}"] if more else []
    return "\n".join([*lines, "}"])


def _stamp(data: bytes) -> int:
    """Read the stamp of a header that a message begins with: the bytes after those that say in which order they are."""
    seconds, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds) * 10**9 + int(rest)


def _leaves(content: object, prefix: str = "", depth: int = 6) -> Iterator[tuple[str, object]]:
    """Yield dotted path and value of what is no dictionary or list in decoded JSON."""
    if isinstance(content, dict) and depth:
        for key, value in content.items():
            yield from _leaves(value, f"{prefix}{key}.", depth - 1)
    elif not isinstance(content, dict | list):
        yield prefix.rstrip("."), content
