"""A recording replayed gives the estimates of `run`; a link does to it what it says."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph.files.recordings.recording import Recording, write_recording
from heliograph.live.event import Event
from heliograph.serving.brokers.replay import Link, delay_as_traced, encode_messages, recorded, simulate_link
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from tests.serving.worlds import fleet, moving, stepping

ROWS = 20


@pytest.mark.parametrize(("whole", "dated"), [(True, False), (False, False), (False, True)])
def test_a_replayed_recording_gives_the_estimates_of_run(tmp_path, whole, dated):
    """To 1e-9: dates keep microseconds, which the time between rows is a multiple of; else 1e-12, as two programs."""
    network, chance = stepping() if whole else moving(), np.random.default_rng(1)
    # Where each row is one step, steps are alike.
    time = np.arange(ROWS) / 2 if whole else np.cumsum(chance.integers(1, 9, ROWS) / 8)
    dt = np.diff(time, prepend=time[:1])
    u = chance.normal(size=(ROWS, 1)) if whole else np.stack([chance.normal(size=ROWS), dt], axis=1)
    z = {node: chance.normal(size=(ROWS, 1)) for node in "ab"}
    z["a"][3], z["b"][5:7] = np.nan, np.nan
    stamps = np.datetime64("2026-11-21T23:00", "ns") + (time * 1e9).astype("timedelta64[ns]") if dated else time
    recording = Recording(z, u, stamps)
    write_recording(recording, network, tmp_path / "data.csv")
    events, origin = recorded(tmp_path / "data.csv", network)
    assert (origin is not None) == dated
    service = Service(fleet(network), InMemoryStore())
    known = service.take([line.encode() for _, line in encode_messages(events, "", origin)]) + service.finish(
        ended=True
    )
    finals = [json.loads(item.body) for item in known if item.kind == "final"]
    last = {final["time"]: final["estimates"] for final in finals}  # after all events of a time
    record = hg.run(network, *recording)
    assert not any(item.kind == "refused" for item in known) and len(last) == ROWS
    for node, filters in record.estimates.items():
        for name, estimate in filters.items():
            got = [[*item[node][name]["mean"], *item[node][name]["covariance"][0]] for item in last.values()]
            projection = np.concatenate([estimate.mean, estimate.covariance[:, 0]], axis=1)
            np.testing.assert_allclose(got, projection, atol=1e-9 if dated else 1e-12, rtol=0)


def test_a_link_loses_delays_and_doubles_as_it_says():
    """Of 20,000 messages, shares to 5 standard deviations; runs of 4 have a standard deviation below 4."""
    count = 20_000
    events = [Event("a", i, float(i), np.zeros(1)) for i in range(count)]
    result = simulate_link(events, Link(loss=0.2, run=4.0, delay=1.5, duplicates=0.1), seed=0)
    arrivals = [event.arrival for event in result]
    assert arrivals == sorted(arrivals)
    received = np.zeros(count, dtype=int)
    for event in result:
        received[event.sequence] += 1
    lost = received == 0
    begun = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    assert abs(lost.mean() - 0.2) < 5 * np.sqrt(0.2 * 0.8 * 7 / count)  # (1 + c) / (1 - c), c = 3/4 of the chain
    assert abs(lost.sum() / begun - 4) < 5 * 4 / np.sqrt(begun)
    assert abs(np.mean(received[~lost] == 2) - 0.1) < 5 * np.sqrt(0.09 / count)
    assert abs(np.mean([e.arrival - e.time for e in result]) - 1.5) < 5 * 1.5 / np.sqrt(count)
    single = simulate_link(events, Link(loss=0.5), seed=1)
    again = np.diff([event.sequence for event in single]) - 1
    assert abs(again[again > 0].mean() - 2) < 0.2 and abs(len(single) / count - 0.5) < 0.02
    assert simulate_link(events[:50], Link(), 0) == [event._replace(arrival=event.time) for event in events[:50]]
    assert simulate_link(events[:50], Link(loss=1.0), 0) == []
    with pytest.raises(ValueError, match="run"):
        simulate_link(events, Link(loss=0.9, run=1.5), 0)


def test_a_recorded_trace_is_followed_and_inputs_are_not_on_the_way(tmp_path):
    (tmp_path / "trace.csv").write_text("delay\n0.5\nnan\n2\n")
    events = [Event("inputs", 0, 0.0, [1.0]), *(Event("a", i, float(i), [0.0]) for i in range(6))]
    result = delay_as_traced(events, tmp_path / "trace.csv")
    assert [(e.node, e.sequence, e.arrival) for e in result] == [
        ("inputs", 0, 0.0), ("a", 0, 0.5), ("a", 3, 3.5), ("a", 2, 4.0), ("a", 5, 7.0),
    ]  # fmt: skip
    for never in ("inf", "1e300"):  # a message cannot state such an arrival: JSON has no infinity
        (tmp_path / "trace.csv").write_text(f"delay\n0.5\n{never}\n")
        with pytest.raises(ValueError, match=r"column 'delay': expected at most 1e\+12; nan where"):
            delay_as_traced(events, tmp_path / "trace.csv")
    (tmp_path / "trace.csv").write_text("lag\n0.5\n")
    with pytest.raises(ValueError, match="delay"):
        delay_as_traced(events, tmp_path / "trace.csv")
