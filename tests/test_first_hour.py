"""What users try in their first hour, in their words, with public names alone: it works, and its claims are true."""

import numpy as np
import pytest

import heliograph as hg


def test_three_rooms_with_quantized_links(tmp_path):
    """Three rooms warm each other and lose heat; the thermometer of each is heard by a small computer that sends its
    estimate of all three temperatures with few symbols. How warm is the house, and how wrong may that be?"""
    house = hg.LinearPlant(
        0.9 * np.eye(3) + 0.03 * (np.ones((3, 3)) - np.eye(3)),  # of what is above the outside, each minute
        0.05 * np.eye(3),
        [15.0, 15.0, 12.0],
        4.0 * np.eye(3),
        states=["kitchen", "bath", "attic"],
    )
    link = hg.amplify_and_forward([hg.hop(hg.Discrete([0.9, 1.1], [0.5, 0.5]), noise=0.02)])
    rooms = {}
    for name, row in zip(house.states, np.eye(3), strict=True):
        thermometer = hg.LinearSensor(row[None], 0.1, outputs=["temperature"])
        rooms[name] = hg.Node(thermometer, link, {"own": hg.linear_filter(house, thermometer, link)})
    eight_bits = hg.fusion.UniformQuantizer(levels=255, amplitude=40.0)
    fused = {"house": hg.Fusion("own", hg.CovarianceIntersection(), eight_bits)}
    network = hg.Network(house, rooms, fused)

    found = hg.monte_carlo(network, 40, runs=96, key=1, keep=hg.Statistics()).with_units(
        dict.fromkeys(house.states, "K")
    )
    table = found.to_pandas()
    whole = table.loc["fused", "house"]
    alone = [table.loc[room, "own"] for room in house.states]
    assert whole["rmse"] < min(room["rmse"] for room in alone)
    assert whole["claim"] == "upper" and whole["nees high"] < 1.0  # it promises no more than it keeps
    assert all(room["nees low"] < 1.0 < room["nees high"] for room in alone)  # exact
    for room, own in zip(house.states, alone, strict=True):  # each knows its own room best, and the fused all of them
        assert own[f"rmse of {room}"] < min(o[f"rmse of {room}"] for o in alone if o is not own)
        assert whole[f"rmse of {room}"] < whole[f"claimed of {room}"]
    symbols = found["fused"]["house"].uplink.symbols_per_value()
    assert 1.0 <= symbols < 1.5 and not found.failures()
    found.save(tmp_path / "house.nc")
    assert hg.simulation.StatisticsByName.open(tmp_path / "house.nc") == found


def test_a_skewed_sensor_with_a_bias():
    """A level gauge whose errors are mostly small and sometimes large, always to one side, recorded on the bench; and a
    leak that nobody measures. I want level and leak, with honest bands, and better than the textbook filter."""
    rng = np.random.default_rng(0)
    bench = rng.normal(0.0, 0.05, 1500) + np.where(rng.random(1500) < 0.1, 1.8, -0.2)  # a splash in every tenth
    errors = hg.random_affine.recorded_noise(bench, order=4)
    tank = hg.LinearPlant([[0.9]], [[0.002]], [5.0], [[0.2]], states=["level"])
    leak = hg.LinearPlant([[0.98]], [[0.0001]], [0.0], [[0.001]], states=["leak"])
    both = hg.model.with_bias(tank, [[1.0]], leak)
    gauge = hg.LinearSensor([[1.0, 0.0]], errors, outputs=["level"])
    filters = {
        "textbook": hg.linear_filter(both, gauge, hg.perfect()),
        "quadratic": hg.polynomial_filter(both, gauge, hg.perfect(), horizon=15),
    }
    network = hg.Network(both, {"tank": hg.Node(gauge, hg.perfect(), filters)})
    found = hg.monte_carlo(network, 15, runs=512, key=2, keep=hg.Statistics())
    table = found.to_pandas().loc["tank"]
    assert (table["claim"] == "exact").all()
    assert ((table["nees low"] < 1.02) & (table["nees high"] > 0.98)).all()
    better, linear = table.loc["quadratic"], table.loc["textbook"]
    assert better["rmse"] < linear["rmse"] - 4 * (better["rmse error"] + linear["rmse error"]) / 2
    assert better["rmse of level"] < 0.97 * linear["rmse of level"] and np.isfinite(better["rmse of leak"])
    for one in (better, linear):
        assert one["rmse"] == pytest.approx(np.hypot(one["claimed of level"], one["claimed of leak"]), rel=0.05)
