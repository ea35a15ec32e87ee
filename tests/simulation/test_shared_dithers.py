"""Recordings of words whose dithers are taken off."""

import numpy as np
import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[0.5]]), hg.LinearSensor([[1.0]], [[0.05]])
ENCODER, LINK = hg.Words(bits=5, low=-4.0, high=4.0, dither="subtracted"), hg.decode_and_forward([0.0])


def test_a_recording_without_dithers_and_one_of_shared_ones_are_refused():
    filter = hg.linear_filter(PLANT, SENSOR, LINK, encoder=ENCODER)
    nodes = {name: hg.Node(SENSOR, LINK, {"f": filter}, encoder=ENCODER) for name in ("a", "b")}
    network = hg.Network(PLANT, nodes)
    z = hg.simulate(network, 30, 1).measurements
    assert hg.run(network, z).measurements["a"].shape == (30, 2)
    with pytest.raises(ValueError, match=r"dithers of b.y0: expected others than those of a.y0"):
        hg.run(network, {"a": z["a"], "b": z["a"]})
    with pytest.raises(ValueError, match=r"shape \(30, 2\)"):
        hg.run(network, {"a": z["a"][:, :1], "b": z["b"]})


def test_dithers_of_sequence_numbers_complete_a_recording():
    """A sender that draws its dithers by the numbers of its messages; a lost message is a row of NaN."""
    rng, numbers = np.random.default_rng(0), np.arange(400)
    x = np.zeros(401)
    for k in numbers:
        x[k + 1] = 0.9 * x[k] + np.sqrt(0.1) * rng.normal()
    y = x[1:] + np.sqrt(0.05) * rng.normal(size=400)
    d = ENCODER.dithers("a", numbers)[:, 0]
    index = np.clip(np.round((y + d - ENCODER.low) / ENCODER.step), 0, 31)
    z = np.stack([ENCODER.low + index * ENCODER.step, ENCODER.dithers("a", numbers)[:, 0]], axis=1)
    z[rng.random(400) < 0.1, 0] = np.nan
    filter = hg.linear_filter(PLANT, SENSOR, LINK, encoder=ENCODER)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, LINK, {"f": filter}, encoder=ENCODER)})
    record = hg.run(network, {"a": z}, truth=x[1:, None])
    nees = np.mean((record.truth[:, 0] - record.estimates["a"]["f"].mean[:, 0]) ** 2
                   / record.estimates["a"]["f"].covariance[:, 0, 0])  # fmt: skip
    assert nees == pytest.approx(1.0, abs=0.25)  # 400 errors of a correlation of some two steps: deviation .09
