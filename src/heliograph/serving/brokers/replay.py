"""Replay of a recording: the messages that its nodes would have sent, and the effects of a link on them."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from heliograph.files.recordings.recording import Recording, read_recording_rows
from heliograph.files.tables.table import convert_to_columns
from heliograph.live.event import INPUTS, Event
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import check_seed, fail, file_path, instance, items, scalar
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network

SAME = 1e-3  # share by which a time step may differ from the difference of two times, which are rounded
FAR = 1e12  # a delay of more is no time
DELAY = "delay"  # the column of a trace: seconds or steps on the way, nan where a message was lost


class Link(NamedTuple):
    """Statistical model of what happens to a message between a node and the service.

    Args:
        loss: probability that a message is lost (default 0).
        run: mean number of consecutive losses (default 1: losses are independent).
        delay: mean delay, exponentially distributed, in the unit of time of the events (default 0).
        duplicates: probability that a message arrives twice (default 0).
    """

    loss: float = 0.0
    run: float = 1.0
    delay: float = 0.0
    duplicates: float = 0.0


def recorded(path: Path, network: Network) -> tuple[list[Event], np.datetime64 | None]:
    """Read the events of a table of rows, in order, and the date of time 0.

    Each row's measurements become events. In continuous time an input holds from its event on, so the inputs of a row
    get the time of the previous row.

    Args:
        path: the file.
        network: the network that the columns belong to.

    Returns:
        The events, and the date from which their times are counted (None if times are numbers or steps).

    Raises:
        ValueError: the file cannot be read as a recording.
    """
    path = file_path("recording", path)
    instance("network", network, Network, "a Network")
    table, *_ = read_recording_rows(path, network, strict=True, ignore_unknown=False)
    return events_of_recording(table, network)


def events_of_recording(table: Recording, network: Network) -> tuple[list[Event], np.datetime64 | None]:
    """Return the events of rows of time, in order, and the date of time 0, as `recorded` does.

    An event is what one node measured, or the inputs, at a time. None for the date where times are numbers or steps.
    """
    # Time of each row: its index if the network counts steps, else seconds.
    dated = table.time.dtype.kind == "M"
    origin = table.time[0] if dated else None
    steps = TIME_STEP not in network.inputs
    time = (table.time - origin).astype(np.int64) / 1e9 if dated else np.asarray(table.time, dtype=float)
    time = np.arange(float(len(time))) if steps else time
    # The time step is no input of messages: they say times, which must agree with it. `given`: the other inputs.
    given = [i for i, name in enumerate(network.inputs) if name != TIME_STEP]
    if not steps:
        check_time_steps(
            table.inputs[:, network.inputs.index(TIME_STEP)], time, np.arange(1, len(time) + 1), "recording"
        )
    events = row_events(np.arange(len(time)), time, table.inputs[:, given], table.measurements, None, steps)
    return list(events), None if steps else origin


def check_time_steps(dt: np.ndarray, time: np.ndarray, numbers: np.ndarray, source: str) -> None:
    """Raise ValueError if a time step is not the time since the previous row, which is all that messages can say.

    The step of the first row is not checked.

    Args:
        dt: the time steps of the rows.
        time: their times, in the same unit.
        numbers: their numbers, for errors.
        source: name of the table, for errors.
    """
    since_row_before = np.diff(time)
    # SAME: the relative difference that rounded times explain.
    wrong = np.flatnonzero(~np.isclose(dt[1:], since_row_before, rtol=SAME, atol=1e-3 * SAME))
    if wrong.size:
        row = int(wrong[0])
        expected = f"the time since the row before, {since_row_before[row]:.10g}, which is all that messages say"
        raise fail(f"{source}, row {numbers[row + 1]}, column {TIME_STEP!r}", expected, f"{dt[row + 1]:.10g}")


def row_events(
    numbers: np.ndarray,
    time: np.ndarray,
    inputs: Float[np.ndarray, "rows given"],
    measurements: Mapping[str, Float[np.ndarray, "rows received"]],
    before: float | None,
    steps: bool,
) -> Iterator[Event]:
    """Yield an event for the inputs of each row, and for each node that measured something in it.

    A recording in rows is replayed as the messages that a live service would have received: one event for the inputs,
    one for each node's measurement.

    Args:
        numbers: running numbers of the rows, from 0; they become the running counts of the events.
        time: the times of the rows: steps, or seconds.
        inputs: the plant's inputs without the time step dt (rows, inputs).
        measurements: {node: values (rows, received)}, NaN where a value did not arrive.
        before: time of the row before the first; None if there is none.
        steps: whether times are steps.
    """
    for i, (k, at) in enumerate(zip(numbers.tolist(), time.tolist(), strict=True)):
        # Inputs hold from their event's time on. Those of a row led to it: they are dated at the row before, or, where
        # times are steps, at the row's own step.
        since = at if steps else before
        if inputs.shape[1] and since is not None:
            yield Event(INPUTS, k, since, inputs[i])
        for node, z in measurements.items():
            if not np.isnan(z[i]).all():
                yield Event(node, k, at, z[i])
        before = at


def simulate_link(events: Sequence[Event], link: Link, seed: int) -> list[Event]:
    """Simulate a link: return the events that arrive, in order of arrival. Inputs arrive at once and are never lost.

    Losses form a two-state Markov chain per node: P(loss | loss) = 1 - 1/run, and P(loss | no loss) such that the
    stationary probability is `loss`. Messages that arrive have exponential delays, and may arrive twice.

    Args:
        events: the events as they are sent.
        link: probability of a loss (`loss`), mean number of losses in a row (`run`), mean delay, and probability that
            a message is duplicated.
        seed: seed of the random numbers, not negative.

    Raises:
        ValueError: no probability, a negative delay, a run shorter than 1 or than losses of this probability can be.
    """
    instance("link", link, Link, "a Link")
    events = items("events", events, "events")
    random = np.random.default_rng(check_seed("seed", seed))
    loss, duplicates = scalar("loss", link.loss, 0, 1), scalar("duplicates", link.duplicates, 0, 1)  # probabilities
    scalar("delay", link.delay, 0, FAR)
    after_loss, after_success = _find_loss_probabilities(loss, scalar("run", link.run, 1))
    arriving, lost = list[Event](), dict[str, bool]()  # of each node whether its newest message was lost
    for event in events:
        if event.node == INPUTS:
            arriving.append(_delay_event(event, 0.0))
            continue
        # The first state of the chain is drawn from the stationary law.
        lost_before = lost.get(event.node, random.random() < loss)
        is_lost = random.random() < (after_loss if lost_before else after_success)
        lost[event.node] = is_lost
        copies = 0 if is_lost else 1 + (random.random() < duplicates)
        arriving += [_delay_event(event, random.exponential(link.delay)) for _ in range(copies)]
    return _sort_events(arriving)


def _find_loss_probabilities(loss: float, run: float) -> tuple[float, float]:
    """Return P(loss | loss) and P(loss | no loss) of a Markov chain of messages that are lost or not.

    Args:
        loss: the stationary probability pi of a loss.
        run: mean number of consecutive losses, so that P(loss | loss) = 1 - 1/run. At 1, losses are independent.

    Raises:
        ValueError: losses are so frequent that their runs must be longer.
    """
    if run == 1:
        return loss, loss
    after_loss = 1 - 1 / run
    if loss == 1:
        return after_loss, 1.0
    # Balance of the stationary law: (1 - pi) P(loss | no loss) = pi P(no loss | loss).
    after_success = loss * (1 - after_loss) / (1 - loss)
    if after_success > 1:
        raise fail("run", f"at least {loss / (1 - loss):g}, for so many losses", run)
    return after_loss, after_success


def delay_as_traced(events: Sequence[Event], trace: Path) -> list[Event]:
    """Delay events as in a recorded trace, and return those that arrive, in order of arrival.

    The trace has one row for each message but inputs, which arrive at once, and is repeated from its start if there are
    more messages.

    Args:
        events: the events in order of sending.
        trace: a file with a column `delay`, in the unit of time of the events; NaN where a message was lost.

    Raises:
        ValueError: no column `delay`, a negative one, or one of more than 1e12, such as an infinite one.
    """
    events, trace = items("events", events, "events"), file_path("trace", trace)
    # Read the delays, and check them.
    columns = convert_to_columns(str(trace), str(trace))
    if DELAY not in columns:
        raise fail(f"trace {trace}", f"a column {DELAY!r}, nan where a message was lost", list(columns))
    delays = np.asarray(columns[DELAY], dtype=float)
    if np.any(delays < 0):
        raise fail(f"trace {trace}, column {DELAY!r}", "no negative number", float(np.nanmin(delays)))
    if np.any(delays > FAR):  # infinite too: no message could state such an arrival
        raise fail(f"trace {trace}, column {DELAY!r}", f"at most {FAR:g}; nan where a message was lost",
                   float(np.nanmax(delays)))  # fmt: skip
    # Messages are delayed or lost, inputs arrive at once.
    sent = [event for event in events if event.node != INPUTS]
    inputs = [event for event in events if event.node == INPUTS]
    delay_of_sent = np.resize(delays, len(sent)).tolist()
    received = [
        _delay_event(event, delay) for event, delay in zip(sent, delay_of_sent, strict=True) if not np.isnan(delay)
    ]
    return _sort_events(received + [_delay_event(event, delay=0.0) for event in inputs])


def encode_messages(events: Sequence[Event], plant: str, origin: np.datetime64 | None) -> Iterator[tuple[float, str]]:
    """Yield for each event the time of its arrival and its message, a line of JSON.

    Args:
        events: the events, in order of arrival.
        plant: name of the plant; may be empty.
        origin: date of time 0; None if times are numbers.

    Returns:
        Pairs of the arrival time and the line of JSON.
    """
    for event in events:
        arrival = event.time if event.arrival is None else event.arrival  # an event without an arrival arrives at once
        fields = encode_event(event, plant, origin) | {"arrival": _format_time(arrival, origin)}
        yield arrival, json.dumps(fields)


def encode_event(event: Event, plant: str, origin: np.datetime64 | None) -> dict[str, object]:
    """Return an event as the fields of a message without its arrival; NaN becomes null.

    Args:
        event: the event.
        plant: name of the plant; "" leaves the field out.
        origin: date of time 0; None if times are numbers.
    """
    name = {"plant": plant} if plant else {}
    return name | {
        "node": event.node,
        "sequence": int(event.sequence),
        "time": _format_time(event.time, origin),
        "values": [None if np.isnan(value) else float(value) for value in np.atleast_1d(event.values)],
    }


def _delay_event(event: Event, delay: float) -> Event:
    """Return an event that arrives so much later; without an arrival it arrived when it was measured."""
    arrival = event.time if event.arrival is None else event.arrival
    return event._replace(arrival=arrival + float(delay))


def _sort_events(events: list[Event]) -> list[Event]:
    """Return events in order of arrival."""
    return sorted(events, key=lambda event: event.time if event.arrival is None else event.arrival)


def _format_time(time: float, origin: np.datetime64 | None) -> float | str:
    """Return a time as in messages: an ISO 8601 date in UTC if time 0 has a date (`origin`), else the number."""
    if origin is None:
        return float(time)
    nanoseconds = int(origin.astype("datetime64[ns]").astype(np.int64)) + round(time * 1e9)
    microseconds = np.datetime64((nanoseconds + 500) // 1000, "us")  # what a message keeps of a date
    return f"{np.datetime_as_string(microseconds)}Z"
