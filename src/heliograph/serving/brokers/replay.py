"""A recording as the messages that its nodes would have sent, and what a link does to them on their way."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heliograph.files.columns import columns_of
from heliograph.files.events import holds_events, read_events
from heliograph.files.recording import TIME_STEP, read_recording
from heliograph.live.event import INPUTS, Event
from heliograph.numerics.check import check_seed, fail, file_path, instance, items, scalar
from heliograph.simulation.network import Network

FAR = 1e12  # a mean delay of more is no time
DELAY = "delay"  # the column of a trace: seconds or steps on the way, nan where a message was lost


class Link(NamedTuple):
    """What may happen to a message on its way.

    It is lost with probability `loss`, in runs of `run` on average; on its way for a time with the exponential law of
    mean `delay`; heard twice with probability `duplicates`.
    """

    loss: float = 0.0
    run: float = 1.0
    delay: float = 0.0
    duplicates: float = 0.0


def recorded(path: Path, network: Network) -> tuple[list[Event], np.datetime64 | None]:
    """Events of a file, of rows or of events already, by the time at which they were heard; the moment of time 0.

    Of a row its measurements are events; the inputs that lead to it are known a row before where time is continuous,
    since there an input holds from its event on.

    Raises:
        ValueError: what reading the file refuses.
    """
    path = file_path("recording", path)
    instance("network", network, Network, "a Network")
    if holds_events(path):
        return read_events(path, network)
    table = read_recording(path, network)
    dated = table.time.dtype.kind == "M"
    origin = table.time[0] if dated else None
    steps = TIME_STEP not in network.inputs
    time = (table.time - origin).astype(np.int64) / 1e9 if dated else np.asarray(table.time, dtype=float)
    time = np.arange(float(len(time))) if steps else time
    local = [i for i, name in enumerate(network.inputs) if name != TIME_STEP]
    events = []
    for k, at in enumerate(time.tolist()):
        if local and (steps or k):
            events.append(Event(INPUTS, k, at if steps else float(time[k - 1]), table.inputs[k, local]))
        received = {node: z[k] for node, z in table.measurements.items() if not np.isnan(z[k]).all()}
        events += [Event(node, k, at, z) for node, z in received.items()]
    return events, None if steps else origin


def through(events: Sequence[Event], link: Link, seed: int) -> list[Event]:
    """What arrives of events, in the order of arrival; inputs arrive as they are sent.

    Raises:
        ValueError: a probability that is none, a negative delay, a run shorter than 1 or than losses of this
            probability can be.
    """
    instance("link", link, Link, "a Link")
    events = items("events", events, "events")
    chance = np.random.default_rng(check_seed("seed", seed))
    loss, twice = scalar("loss", link.loss, 0, 1), scalar("duplicates", link.duplicates, 0, 1)
    scalar("delay", link.delay, 0, FAR)
    stays = 1 - 1 / scalar("run", link.run, 1)  # lost again after a loss
    falls = 1.0 if loss == 1 else loss * (1 - stays) / (1 - loss) if link.run > 1 else loss
    if falls > 1:
        raise fail("run", f"at least {loss / (1 - loss):g}, for so many losses", link.run)
    result, lost = list[Event](), dict[str, bool]()
    for event in events:
        if event.node == INPUTS:
            result.append(_arriving(event, 0.0))
            continue
        before = lost.get(event.node, chance.random() < loss)
        now = chance.random() < (stays if before and link.run > 1 else falls)
        lost[event.node] = now
        copies = 0 if now else 1 + (chance.random() < twice)
        result += [_arriving(event, chance.exponential(link.delay)) for _ in range(copies)]
    return _in_order(result)


def along(events: Sequence[Event], trace: Path) -> list[Event]:
    """What arrives of events if their delays are those of a recorded trace, one row a message, again from the first.

    Raises:
        ValueError: no column `delay`, or a negative one.
    """
    trace = file_path("trace", trace)
    columns = columns_of(str(trace), str(trace))
    if DELAY not in columns:
        raise fail(f"trace {trace}", f"a column {DELAY!r}, nan where a message was lost", list(columns))
    delays = np.asarray(columns[DELAY], dtype=float)
    if np.any(delays < 0):
        raise fail(f"trace {trace}, column {DELAY!r}", "no negative number", float(np.nanmin(delays)))
    received = [event for event in events if event.node != INPUTS]
    known = zip(received, np.resize(delays, len(received)).tolist(), strict=True)
    results = [_arriving(event, delay) for event, delay in known if not np.isnan(delay)]
    return _in_order(results + [_arriving(event, 0.0) for event in events if event.node == INPUTS])


def lines(events: Sequence[Event], plant: str, origin: np.datetime64 | None) -> Iterator[tuple[float, str]]:
    """Each event as a message, with the time at which it is heard."""
    for event in events:
        arrival = event.time if event.arrival is None else event.arrival
        values = [None if np.isnan(value) else float(value) for value in np.atleast_1d(event.values)]
        parts = {"plant": plant} if plant else {}
        moments = {"time": _moment(event.time, origin), "arrival": _moment(arrival, origin)}
        yield (
            arrival,
            json.dumps(parts | {"node": event.node, "sequence": int(event.sequence)} | moments | {"values": values}),
        )


def _arriving(event: Event, delay: float) -> Event:
    began = event.time if event.arrival is None else event.arrival
    return event._replace(arrival=began + float(delay))


def _in_order(events: list[Event]) -> list[Event]:
    return sorted(events, key=lambda event: event.time if event.arrival is None else event.arrival)


def _moment(time: float, origin: np.datetime64 | None) -> float | str:
    if origin is None:
        return float(time)
    microseconds = np.timedelta64(round(time * 1e6), "us")  # what a message keeps of a date
    return f"{np.datetime_as_string(origin.astype('datetime64[us]') + microseconds)}Z"
