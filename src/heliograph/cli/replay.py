"""`heliograph replay`: a recording as the stream of messages that it was."""

import os
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from heliograph.cli.app import number, path_option

LONGEST = 1e6  # seconds that the system sleeps at once


def replay(
    recording: Annotated[Path, path_option("CSV or Parquet: rows of time, inputs and measurements; or events.")],
    /,
    *,
    network: Annotated[str, Parameter(help="Whose recording it is: my_network.py, or my_network.py:name.")],
    speed: Annotated[float | None, Parameter(help="How many times faster than it was; at once, unless given.")] = None,
    plant: Annotated[str, Parameter(help="Name of the plant in each message.")] = "",
    loss: Annotated[float, Parameter(help="Probability that a message is lost.")] = 0.0,
    run: Annotated[float, Parameter(help="How many are lost in a row, on average; 1: each by itself.")] = 1.0,
    delay: Annotated[float, Parameter(help="Mean time on the way, of an exponential law: messages overtake.")] = 0.0,
    duplicates: Annotated[float, Parameter(help="Probability that a message arrives twice.")] = 0.0,
    trace: Annotated[Path | None, path_option("CSV of a recorded link, one delay a message, nan if lost.")] = None,
    seed: Annotated[int, number("Seed of what happens on the way.")] = 0,
) -> None:
    """Send a recording as messages, JSON lines on stdout for `heliograph serve`, at the pace of the recording."""
    from time import monotonic, sleep

    from heliograph.files.network_file import load_network
    from heliograph.numerics.check import TINY, check_seed, fail, scalar
    from heliograph.serving.brokers.replay import Link, along, lines, recorded, through

    # Check the options; a trace replaces the model of a link.
    if speed is not None:
        scalar("--speed", speed, TINY)
    link = Link(loss, run, delay, duplicates)
    if trace is not None and link != Link():
        raise fail("--trace", "no --loss, --run, --delay and --duplicates beside it", "both")
    # Events of the recording, and those that arrive through the link.
    events, origin = recorded(recording, load_network(network))
    received = through(events, link, check_seed("--seed", seed)) if trace is None else along(events, trace)
    # Wait for each arrival on the clock, speeded up.
    begun, first = monotonic(), None
    try:
        for arrival, line in lines(received, plant, origin):
            first = arrival if first is None else first
            while speed is not None and (ahead := begun + (arrival - first) / speed - monotonic()) > 0:
                sleep(min(ahead, LONGEST))
            print(line, flush=speed is not None)
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
