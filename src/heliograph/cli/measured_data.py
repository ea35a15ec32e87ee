"""Reading of measured data for every command alike: rows of a table, or messages, of which a timeline uses some."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

if TYPE_CHECKING:
    import numpy as np

    from heliograph.files.events.event_table import EventTable
    from heliograph.files.recordings.recording import Recording
    from heliograph.files.stores.store_address import StoreAddress
    from heliograph.files.stores.store_tables import StoreTable
    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network

REASONS = 3  # reasons in a line
WINDOW = 10.0  # how late a message may be, as of `heliograph serve`


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ReadingOptions:
    """Options of all commands that read measured data, as they are typed."""

    window: Annotated[float | None, Parameter(help="Of messages: how late one may be; 10 unless given.")] = None
    ahead: Annotated[
        float | None, Parameter(help="Of messages: how much later than its arrival a time may be; 0.1 unless given.")
    ] = None
    plant: Annotated[str | None, Parameter(help="Of messages: the plant to read; all, unless given.")] = None
    strict: Annotated[bool, Parameter(help="Stop at the first message or row that cannot be read.", negative="")] = (
        False
    )
    ignore_unknown: Annotated[
        bool, Parameter(help="Leave out columns that the network does not know.", negative="")
    ] = False

    @property
    def are_for_messages(self) -> bool:
        """Return whether an option is given that only messages (window, ahead, plant) have, and no table of rows."""
        return self.window is not None or self.ahead is not None or self.plant is not None

    @property
    def limits(self) -> tuple[float, float]:
        """Return how late an event may come (the window), and how far its time may be after its arrival.

        Both are in the unit of time. WINDOW and AHEAD stand for options that are not given.
        """
        from heliograph.live.event import AHEAD
        from heliograph.numerics.check import scalar

        window = WINDOW if self.window is None else float(scalar("--window", self.window, 0))
        return window, AHEAD if self.ahead is None else float(scalar("--ahead", self.ahead, 0))


@dataclass(frozen=True)
class MeasuredPlant:
    """Measured data of one plant.

    Attributes:
        plant: its name; "" for a single one.
        recording: rows in the order of measuring.
        rows: whether something was measured in each; None for all.
        events: the messages; None of rows.
        summary: lines on what was used and what was left out.
        warnings: lines on what could not be read.
    """

    plant: str
    recording: "Recording"
    rows: "np.ndarray | None" = None
    events: "EventTable | None" = None
    summary: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def read_measured_plants(
    location: "Path | StoreAddress",
    reference: str,
    network: "Network",
    module: Mapping[str, object],
    options: ReadingOptions,
    advance: "Advance",
    lag: float | None = None,
) -> list[MeasuredPlant]:
    """Return the measured data of each plant, from a table, messages or a store.

    Args:
        location: a file or folder, or the address of a store.
        reference: the user's name of the network, for errors.
        network: the network.
        module: names defined in the network's file, such as `sources`, by which messages are read.
        options: options of the command line: which plant, how late messages may be, and how they are read.
        advance: called with the progress.
        lag: how much later estimates are asked for, of messages; None for none.

    Raises:
        ValueError: what cannot be read; an option of messages where there are rows of time, which are not read then; a
            plant that is not there.
    """
    from heliograph.numerics.check import fail

    # Messages are events, put in rows of time for each plant; a table of rows (no events) has one plant only.
    path = open_path_or_store(location)
    events = read_events(path, reference, network, module, options, advance)
    if events is None:
        if options.are_for_messages or lag is not None:
            used = "--window, --ahead, --lag and --plant" if options.are_for_messages else "--lag"
            raise fail(used, "messages or events", f"rows of time in {path}")
        return [read_rows(path, network, options)]
    wanted = events.plants if options.plant is None else [options.plant]
    measured = [_make_rows_of_events(events.of(plant), plant, options) for plant in wanted]
    # What is said of the whole reading is said with one plant: warnings with the first, notes with the last.
    measured[0].warnings.extend(describe_unreadable_messages(path, events))
    measured[-1].summary.extend(events.notes)
    return measured


def open_path_or_store(location: "Path | StoreAddress") -> "Path | StoreTable":
    """Return a path as it is, or for the address of a store the table with its rows."""
    if isinstance(location, Path):
        return location
    from heliograph.files.stores.store_tables import query_store

    return query_store(location)


def take_only_plant(path: object, measured: list[MeasuredPlant]) -> MeasuredPlant:
    """Return the measured data of the only plant.

    Raises:
        ValueError: there are several plants. The error names the option that chooses one.
    """
    from heliograph.numerics.check import fail

    if len(measured) > 1:
        names = ", ".join(repr(data.plant) for data in measured[:8])
        raise fail(f"{path}", f"one plant here, which --plant names (--plant {measured[0].plant})", names)
    return measured[0]


def read_events(
    path: "Path | StoreTable",
    reference: str,
    network: "Network",
    module: Mapping[str, object],
    options: ReadingOptions,
    advance: "Advance",
) -> "EventTable | None":
    """Return the messages of a bag, a file or a store as events, values of outputs with their times.

    Measured data are a table with a row for each time, or messages that come whenever they come, each of some outputs.
    The latter need `sources` in the network's file, which say which topic and field is which output.

    Args:
        path: the file or folder, or the table of a store.
        reference: the network as the user named it, FILE or FILE:NAME, for errors.
        network: the network.
        module: names and values that the network's file defines; "sources" may be one.
        options: how the data are read.
        advance: called with the progress.

    Returns:
        The events; None if the data are a table of rows of time, which `read_rows` reads.

    Raises:
        ValueError: messages without sources, or what cannot be read.
    """
    from heliograph.files.bags.ros_bag import is_bag
    from heliograph.files.logs.vehicle_log import is_log
    from heliograph.files.messages.folder_of_message_files import is_message_folder
    from heliograph.files.messages.messages_to_events import is_of_messages
    from heliograph.files.messages.messages_to_events import read_events as read_mapped
    from heliograph.numerics.check import fail

    # Rows of time are read elsewhere.
    sources = module.get("sources")
    if not is_of_messages(path, sources):
        return None
    # A bag, log or folder of messages cannot be read without sources. The error says which command suggests them.
    if sources is None and isinstance(path, Path) and (is_bag(path) or is_log(path) or is_message_folder(path)):
        hint = f"heliograph inspect {path} --network {reference} suggests them"
        raise fail(f"network {reference}", f"sources, for the topics of {path} ({hint})", "none")

    def progress(done: int, total: int) -> None:
        """Show how much of the data is read."""
        advance(f"reading {path}", done, total)

    return read_mapped(path, network, sources, progress, options.strict, options.ignore_unknown)


def read_rows(path: "Path | StoreTable", network: "Network", options: ReadingOptions) -> MeasuredPlant:
    """Return a table's rows of times as the data of a plant without a name, with warnings on refused rows.

    A warning names at most REASONS reasons. `options`: whether an unreadable row is an error, and whether unknown
    columns are left out. Warnings of the reader are collected as lines.
    """
    from heliograph.files.recordings.recording import read_recording_rows

    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always", UserWarning)
        recording, refused, notes = read_recording_rows(path, network, options.strict, options.ignore_unknown)
    lines = [describe_refusals(path, "rows", len(refused), refused[:REASONS])] if refused else []
    return MeasuredPlant("", recording, warnings=[*lines, *notes, *(str(doubt.message) for doubt in doubts)])


def _make_rows_of_events(events: "EventTable", plant: str, options: ReadingOptions) -> MeasuredPlant:
    """Return the data of one plant as rows of time, made from its events, the messages with measured values.

    The options say how late an event may come to be used. The result has a line for each node on how many events were
    used, came too late, and so on, and on how many were lost by the numbers of their sequence.
    """
    import numpy as np

    window, ahead = options.limits
    (counts, lost), absent = events.judge(window, ahead), events.count_absent(window, ahead)
    lines = []
    for node, verdicts in counts.items():
        # Of the used ones, those without a value are said apart.
        numbers = verdicts | {"used": verdicts["used"] - absent[node], "without a value": absent[node]}
        parts = [f"{count} {verdict}" for verdict, count in numbers.items() if count]
        if lost.get(node):
            parts.append(f"{lost[node]} lost")
        lines.append(f"{plant + ', ' if plant else ''}{node}: {', '.join(parts)}")
    recording, rows = events.rows(window, ahead)
    if events.dated:
        lines.append(f"times in seconds since {np.datetime_as_string(events.date, timezone='UTC')}")
    return MeasuredPlant(plant, recording, rows, events, summary=lines)


def describe_unreadable_messages(path: object, events: "EventTable") -> list[str]:
    """Return lines on messages that were not used: where reading ended early, and how many could not be read.

    `events.refused` is the count of all messages that could not be read, `events.refusals` the counts of each reason by
    node, of those messages whose node is known, and `events.reasons` the first errors in words.
    """
    from heliograph.model.checks.refusal_reasons import describe_counts

    lines = [events.broken] if events.broken else []  # why reading ended early
    if events.refused:
        counts_by_node = [f"{node}: {describe_counts(counts)}" for node, counts in events.refusals.items()]
        known_reasons = "; ".join(counts_by_node)
        lines.append(describe_refusals(path, "messages", events.refused, events.reasons, known_reasons))
    return lines


def describe_refusals(path: object, what: str, count: int, reasons: Sequence[str], known: str = "") -> str:
    """Return a line on refused rows or messages: their count, the counts by `known` reasons, and the first reasons."""
    in_brackets = f" ({known})" if known else ""
    others = f"; and {count - len(reasons)} more" if count > len(reasons) else ""
    return f"{path}: {what} that could not be read: {count}{in_brackets}; {'; '.join(reasons)}{others}"
