"""`heliograph replay`: a recording as the stream of messages that it was."""

import os
import sys
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from heliograph.cli.app_and_option_types import integer_option, measured_option, path_option
from heliograph.cli.measured_data import ReadingOptions, open_path_or_store, read_events, read_rows
from heliograph.files.stores.store_address import StoreAddress

if TYPE_CHECKING:
    import numpy as np

    from heliograph.files.stores.store_tables import StoreTable
    from heliograph.live.event import Event

LONGEST = 1e6  # seconds that the system sleeps at once


def replay(
    recording: Annotated[
        Path | StoreAddress, measured_option("What `run` takes: rows of time, events, messages, a bag, or a store.")
    ],
    /,
    *,
    network: Annotated[str, Parameter(help="Whose recording it is: my_network.py, or my_network.py:name.")],
    speed: Annotated[float | None, Parameter(help="How many times faster than it was; at once, unless given.")] = None,
    plant: Annotated[
        str | None, Parameter(help="Name of the plant in each message; as recorded, unless given.")
    ] = None,
    loss: Annotated[float, Parameter(help="Probability that a message is lost.")] = 0.0,
    run: Annotated[float, Parameter(help="How many are lost in a row, on average; 1: each by itself.")] = 1.0,
    delay: Annotated[float, Parameter(help="Mean time on the way, of an exponential law: messages overtake.")] = 0.0,
    duplicates: Annotated[float, Parameter(help="Probability that a message arrives twice.")] = 0.0,
    trace: Annotated[Path | None, path_option("CSV of a recorded link, one delay a message, nan if lost.")] = None,
    seed: Annotated[int, integer_option("Seed of what happens on the way.")] = 0,
    strict: Annotated[
        bool, Parameter(help="Stop at the first message or row that cannot be read.", negative="")
    ] = False,
    ignore_unknown: Annotated[
        bool, Parameter(help="Leave out columns that the network does not know.", negative="")
    ] = False,
) -> None:
    """Send a recording as messages, JSON lines on stdout for `heliograph serve`, at the pace of the recording."""
    from time import monotonic, sleep

    from heliograph.numerics.check import TINY, check_seed, fail, scalar
    from heliograph.serving.brokers.replay import Link, delay_as_traced, encode_messages, simulate_link

    # Check the options; a trace replaces the model of a link.
    if speed is not None:
        scalar("--speed", speed, TINY)
    link = Link(loss, run, delay, duplicates)
    if trace is not None and link != Link():
        raise fail("--trace", "no --loss, --run, --delay and --duplicates beside it", "both")
    check_seed("--seed", seed)
    options = ReadingOptions(strict=strict, ignore_unknown=ignore_unknown)
    # Of each plant of the recording the messages that arrive through the link: (arrival, line), by arrival.
    messages_of_plants = []
    for i, (name, events, origin) in enumerate(_yield_events_of_plants(recording, network, options)):
        received = simulate_link(events, link, seed + i) if trace is None else delay_as_traced(events, trace)
        messages_of_plants.append(encode_messages(received, name if plant is None else plant, origin))
    # Print each line when it is due: as long after the first as it arrived, by `speed` sooner.
    begun, first_arrival = monotonic(), None
    try:
        for arrival, line in merge(*messages_of_plants, key=lambda message: message[0]):
            first_arrival = arrival if first_arrival is None else first_arrival
            while speed is not None and (left := begun + (arrival - first_arrival) / speed - monotonic()) > 0:
                sleep(min(left, LONGEST))
            print(line, flush=speed is not None)
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more; Python would report it again when it closes its output
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _yield_events_of_plants(
    location: Path | StoreAddress, reference: str, options: ReadingOptions
) -> "Iterator[tuple[str, list[Event], np.datetime64 | None]]":
    """Yield name, events and date of time 0 of each plant; the date is None where times are no dates.

    The command replays a recording as messages on the standard output. A recording has events (messages), or rows of
    time, which are those of one plant, named "". Warnings and notes go to the standard error. `reference`: the network
    as the user named it. `options`: how the recording is read. `events_of_recording` makes events of rows, and finds
    the date.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.files.network_file import load_module
    from heliograph.serving.brokers.replay import events_of_recording

    network, module = load_module(reference)
    path = open_path_or_store(location)

    def no_progress(what: str, done: int = 0, total: int = 0) -> None:
        """Show nothing: the standard output is a pipe."""

    # None is returned for rows of time, which become events one row after the other.
    table = read_events(path, reference, network, module, options, no_progress)
    if table is None:
        rows = read_rows(path, network, options)
        for line in [*rows.warnings, *_describe_too_fine_dates(path, rows.recording.time)]:
            print(f"heliograph: {visible(line)}", file=sys.stderr)
        yield ("", *events_of_recording(rows.recording, network))
        return
    import numpy as np

    from heliograph.cli.measured_data import describe_unreadable_messages

    # Events of several plants: warn of dates that are finer than a replay can hold, then yield plant by plant.
    lines_on_digits: list[str] = []
    if table.dated:
        times = [columns.time for name in table.plants for columns in table.of(name).columns.values()]
        lines_on_digits = _describe_too_fine_dates(path, np.concatenate(times).astype("datetime64[ns]"))
    for line in [*describe_unreadable_messages(path, table), *table.notes, *lines_on_digits]:
        print(f"heliograph: {visible(line)}", file=sys.stderr)
    for name in table.plants:
        events = table.of(name)
        has_dates = not events.steps and not events.numbers
        yield name, list(events.sort_events()), events.date if has_dates else None


def _describe_too_fine_dates(path: "Path | StoreTable", time: "np.ndarray") -> list[str]:
    """Return a line on how many dates have digits below a microsecond, which messages lose; [] if none has.

    `path` is what was read, for the line; `time` are its times, which may be numbers rather than dates.
    """
    if time.dtype.kind != "M":
        return []
    finer = int((time != time.astype("datetime64[us]")).sum())
    return [f"{path}: times that messages have to the microsecond only: {finer}"] if finer else []
