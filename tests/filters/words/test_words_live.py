"""Filters of words on live data, smoothed, and as C."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import serving
from tests.export.device import Device, needs_compiler
from tests.follow import apart

A, Q, R = 0.95, 0.1, 0.05
X = Q / (1 - A**2)
PLANT, SENSOR = hg.LinearPlant([[A]], [[Q]], [0.0], [[X]]), hg.LinearSensor([[1.0]], [[R]])
LINK, REACH = hg.decode_and_forward([0.01]), 5 * np.sqrt(X + R)
ENCODER = hg.Words(bits=4, low=-REACH, high=REACH, dither="subtracted")
FILTERS = {
    "words": hg.word_filter(PLANT, SENSOR, LINK, ENCODER),
    "linear": hg.linear_filter(PLANT, SENSOR, LINK, encoder=ENCODER),
}
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, FILTERS, encoder=ENCODER)})


def test_streams_and_timelines_return_what_a_recording_does():
    z = hg.simulate(NETWORK, 30, 1).measurements["a"].copy()
    z[7, 0] = np.nan
    record, timeline = hg.run(NETWORK, {"a": z}), hg.Timeline(NETWORK, window=20)
    for name, filter in FILTERS.items():
        stream = hg.Stream(filter)
        for row in z:
            last = stream.push(row)
        assert last.claim == filter.claim
        assert np.allclose(last.mean, record.estimates["a"][name].mean[-1], rtol=1e-12)
    for k in (*range(10), 11, 10, *range(12, 30)):  # one comes late
        timeline.push("a", k, float(k), z[k], float(max(k, 11 if k == 10 else k)))
    for name, estimate in timeline.estimates()["a"].items():
        assert np.allclose(estimate.mean, record.estimates["a"][name].mean[-1], rtol=1e-9)


def test_a_service_that_starts_anew_publishes_what_a_recording_gives(tmp_path):
    """Words and their dithers come as messages, one of them does not; a restart in the middle."""
    z = hg.simulate(NETWORK, 10, 1).measurements["a"]
    for part in (range(5), (5, 6, 8, 9)):
        fleet = serving.Fleet(serving.NetworkProgram(NETWORK), serving.Options(window=2.0, step=1.0))
        service = serving.Service(fleet, serving.Store(str(tmp_path / "store.db"), serving.identity(fleet)))
        sent = [{"node": "a", "sequence": k, "time": float(k), "values": z[k].tolist()} for k in part]
        outputs = service.take([json.dumps(message).encode() for message in sent])
    z[7] = np.nan
    (last,) = [m for m in map(json.loads, (output.body for output in outputs)) if m.get("time") == 9.0]
    for name, estimate in hg.run(NETWORK, {"a": z}).estimates["a"].items():
        assert last["estimates"]["a"][name]["mean"] == pytest.approx(estimate.mean[-1].tolist(), rel=1e-9)
        assert last["estimates"]["a"][name]["claim"] == NETWORK.claims()["a"][name]


@pytest.mark.slow
def test_smoothed_linear_estimates_keep_their_claim():
    statistics = hg.monte_carlo(NETWORK, 40, 3000, 3, keep=hg.Statistics(), smooth=hg.smoothing.FixedInterval())
    filtered, smoothed = statistics["a"], statistics.smoothed["a"]
    assert smoothed["linear"].claim == "exact"
    nees, low, high = smoothed["linear"].nees_per_dimension(0.999)
    assert low < 1 < high, nees
    assert smoothed["words"].claim == "nominal"
    assert smoothed["words"].nees_per_dimension()[0] == pytest.approx(1.0, abs=0.1)
    for name in FILTERS:
        assert smoothed[name].rmse()[0] < 0.95 * filtered[name].rmse()[0]


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", FILTERS)
def test_exported_c_returns_what_a_run_does(name, tmp_path):
    filter = FILTERS[name]
    z = hg.simulate(NETWORK, 100, 1).measurements["a"].copy()
    z[::9, 0] = np.nan
    filtered, device = filter.run(z), Device(filter, tmp_path)
    assert max(apart(device.follow(z, np.zeros((100, 0))), (filtered.means, filtered.covariances))) < 1e-10


def test_exported_c_goes_through_the_words_in_loops(tmp_path):
    """Its length does not grow with the number of words: 256 and 4096 of them in 0.15 and 0.17 MB."""
    for bits in (8, 12):
        encoder = hg.Words(bits=bits, low=-REACH, high=REACH)
        exported = hg.export_c(hg.word_filter(PLANT, SENSOR, LINK, encoder), tmp_path / f"of_{bits}_bits.c")
        assert exported.source.stat().st_size < 200_000
