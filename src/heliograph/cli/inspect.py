"""`heliograph inspect`: the topics of a bag or a broker, and sources to paste."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    from heliograph.files.logs.log_sources import LogSources
    from heliograph.files.topic_statistics import TopicStatistics


def inspect(
    recording: str,
    /,
    *,
    network: Annotated[
        str, Parameter(help="Its nodes and inputs are listed: my_network.py, or my_network.py:name.")
    ] = "",
    dbc: Annotated[Path | None, Parameter(help="Database of the bus of a log of CAN: car.dbc.")] = None,
    channel: Annotated[int | str | None, Parameter(help="Bus of a log of several: 1, or can0.")] = None,
    seconds: Annotated[float, Parameter(help="How long to listen to a broker.")] = 10.0,
) -> None:
    """List the topics of a bag, a file or a broker: rates, gaps, lateness, and `sources` to paste into a network.

    Parameters
    ----------
    recording:
        A bag (.mcap, .db3, .bag, or a folder), a vehicle's log (.mf4, .blf, .asc, .ulg, .log of candump), a file of
        messages (lines of JSON, a log, a table) or a folder of these, of which each is a topic, or the URL of a broker:
        mqtt://, nats:// or opc.tcp://.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.files.logs.log_sources import LogSources
    from heliograph.files.source_suggestions import suggest_sources
    from heliograph.numerics.check import TINY, scalar

    scalar("--seconds", seconds, TINY, 86400)
    # Names of the numbers that each node receives, to be matched with the topics' fields.
    names: dict[str, tuple[str, ...]] = {}
    if network:
        from heliograph.files.network_file import load_network

        loaded = load_network(network)
        names = {name: node.received_names for name, node in loaded.nodes.items()} | {"inputs": loaded.inputs}
    # The table of topics, the sources that are suggested for them, and what could not be read.
    topics, broken = _collect_topics(recording, seconds, LogSources({}, dbc=dbc, channel=channel))
    _print_table(topics)
    if topics:
        print(suggest_sources(topics, names))
    if broken:
        print(f"heliograph: warning: {visible(broken)}", file=sys.stderr)


def _collect_topics(recording: str, seconds: float, of_log: "LogSources") -> "tuple[dict[str, TopicStatistics], str]":
    """Return the topics of files, or of a broker after listening to it for a while, and what is broken in the files.

    Args:
        recording: path of a file or folder, or the URL of a broker.
        seconds: how long to listen to a broker.
        of_log: the database of a CAN bus, and which bus, for a log of frames.

    Returns:
        Statistics by topic, and the first reason why something cannot be read, "" if all can be.
    """
    from heliograph.files.logs.vehicle_log import is_log
    from heliograph.files.messages.folder_of_message_files import is_message_folder
    from heliograph.files.messages.message_files import LINES
    from heliograph.files.text.text_file import find_extension
    from heliograph.files.topic_inspection import inspect_bag, inspect_file, inspect_folder, inspect_log
    from heliograph.report.progress import progress

    with progress(2) as advance:
        # The URL of a broker; else by what the path is: a vehicle's log, a file of messages, a folder, or a bag.
        if "://" in recording:
            from heliograph.serving.brokers.broker_address import parse_address
            from heliograph.serving.brokers.broker_inspection import listen

            advance(f"listening for {seconds:g} s")
            return listen(parse_address(recording), seconds), ""
        path = Path(recording)
        if is_log(path):
            advance(f"reading {recording}")
            return inspect_log(path, of_log)
        # LINES: the extensions of files with a message a line.
        if path.is_file() and find_extension(path) in (*LINES, ".csv", ".parquet"):
            advance(f"reading {recording}")
            return inspect_file(path)
        if is_message_folder(path):
            advance(f"reading {recording}")
            return inspect_folder(path)
        return inspect_bag(path, lambda done, total: advance(f"reading {recording}", done, total))


def _print_table(topics: "dict[str, TopicStatistics]") -> None:
    """Print a line for each topic: its messages, their rate and largest gap, and how late they come."""
    import rich.console
    import rich.markup
    import rich.table

    from heliograph.disk.quoted_text import visible

    table = rich.table.Table(
        "topic", "type", "messages", "rate", "largest gap", "late (s): median, 95 %, most", box=None
    )
    for name, topic in sorted(topics.items()):
        table.add_row(*map(rich.markup.escape, map(visible, (name, *topic.format_row()))))
    console = rich.console.Console(width=None if sys.stdout.isatty() else 160, highlight=False)
    console.print(table if topics else "no messages")
