"""Sources of a vehicle's log: fields of its messages by name, and what the log itself does not say."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from heliograph.files.sources.message_fields import parse_start
from heliograph.files.sources.source_description import Source
from heliograph.numerics.check import check_count, fail, file_path, show_value
from heliograph.numerics.module import readable

SECOND = 1e9  # nanoseconds
STAMP = "timestamp"  # the field of each message that says when it was logged


@readable
class LogSources(Mapping[str, "Source | Sequence[Source]"]):
    """Sources by message, as a dictionary has them, with the database and the date of a vehicle's log.

        sources = hg.files.LogSources(
            {"WheelSpeeds": hg.files.json_field("FrontLeft", node="wheel", output="speed", scale=1 / 3.6)},
            dbc="car.dbc",
        )

    A signal is a field of its message, in the unit that the file names, which `scale` and `offset` of `json_field`
    convert. Each message has a field `timestamp`, the seconds at which it was logged; a sensor whose messages are
    logged 80 ms after it measured has `time=hg.files.Stamp("timestamp", offset=-0.08)`.

    Args:
        sources: sources by name of the message, as `json_field` makes them.
        dbc: database of the bus, a file of `cantools` (.dbc, .kcd, .sym, .arxml), for frames of CAN; None where the
            log has signals already.
        channel: number of the bus, or its name ("can0"), where a log has several; None for any.
        start: date of the log's begin, with a zone, in place of that in the file; None for that of the file, and of
            1970 where the file has none.

    Raises:
        ValueError: no dictionary, no path, a negative channel, no date with a zone.
    """

    def __init__(
        self,
        sources: "Mapping[str, Source | Sequence[Source]]",
        *,
        dbc: str | Path | None = None,
        channel: int | str | None = None,
        start: str | None = None,
    ):
        """Check the options of a log, and keep its sources by message, as in a network's file.

        Args:
            sources: by name of a message its source, or several.
            dbc: database that describes the frames of a bus; None for none.
            channel: number or name of the bus, of a log of several; None for any.
            start: date of the log's begin, with its zone; None for that in the log.
        """
        if not isinstance(sources, Mapping):
            expected = "a dictionary of messages, each with json_field or a list of them"
            raise fail("LogSources, sources", expected, show_value(sources))
        self._sources = dict(sources)
        self.dbc = None if dbc is None else file_path("LogSources, dbc", dbc)
        # A bus has a number, or a name in a log of candump.
        no_number = channel is None or isinstance(channel, str)
        self.channel: int | str | None = channel if no_number else check_count("LogSources, channel", channel, 0)
        self.start = None if start is None else parse_start("LogSources, start", start) / SECOND

    def __getitem__(self, name: str) -> "Source | Sequence[Source]":
        """Return the source, or sources, of the message with this name."""
        return self._sources[name]

    def __iter__(self) -> Iterator[str]:
        """Yield the names of the messages that have sources."""
        return iter(self._sources)

    def __len__(self) -> int:
        """Return how many messages have sources."""
        return len(self._sources)
