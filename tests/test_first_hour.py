"""What users try in their first hour, in their words, with public names alone: it works, and its claims are true."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg


def test_three_rooms_with_quantized_links(tmp_path):
    """Three rooms warm each other and lose heat; the thermometer of each is received by a small computer that sends its
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
        rooms[name] = hg.Node(thermometer, link, {"local": hg.linear_filter(house, thermometer, link)})
    eight_bits = hg.fusion.UniformQuantizer(levels=255, amplitude=40.0)
    fused = {"house": hg.Fusion("local", hg.CovarianceIntersection(), eight_bits)}
    network = hg.Network(house, rooms, fused)

    result = hg.monte_carlo(network, 40, runs=96, key=1, keep=hg.Statistics()).with_units(
        dict.fromkeys(house.states, "K")
    )
    table = result.to_pandas()
    whole = table.loc["fused", "house"]
    alone = [table.loc[room, "local"] for room in house.states]
    assert whole["rmse"] < min(room["rmse"] for room in alone)
    assert whole["claim"] == "nominal" and whole["nees high"] < 1.0  # it promises no more than it keeps
    assert all(room["nees low"] < 1.0 < room["nees high"] for room in alone)  # exact
    for room, item in zip(house.states, alone, strict=True):  # each knows its own room best, and the fused all of them
        assert item[f"rmse of {room}"] < min(o[f"rmse of {room}"] for o in alone if o is not item)
        assert whole[f"rmse of {room}"] < whole[f"claimed of {room}"]
    symbols = result["fused"]["house"].uplink.symbols_per_value()
    assert 1.0 <= symbols < 1.5 and not result.failures()
    result.save(tmp_path / "house.nc")
    assert hg.simulation.StatisticsByName.open(tmp_path / "house.nc") == result


def test_a_skewed_sensor_with_a_bias():
    """A level gauge whose errors are mostly small and sometimes large, always to one side, recorded on the bench; and a
    leak that nobody measures. I want level and leak, with honest bands, and better than the textbook filter."""
    rng = np.random.default_rng(0)
    bench = rng.normal(0.0, 0.05, 1500) + np.where(rng.random(1500) < 0.1, 1.8, -0.2)  # a splash in every tenth
    errors = hg.random_affine.recorded_noise(bench, order=4)
    tank = hg.LinearPlant([[0.9]], [[0.002]], [5.0], [[0.2]], states=["level"])
    leak = hg.LinearPlant([[0.98]], [[0.0001]], [0.0], [[0.001]], states=["leak"])
    gauge = hg.LinearSensor([[1.0]], errors, outputs=["level"])
    both, gauge = hg.model.with_bias(tank, gauge, leak, coupling=[[1.0]])
    filters = {
        "textbook": hg.linear_filter(both, gauge, hg.perfect()),
        "quadratic": hg.polynomial_filter(both, gauge, hg.perfect(), horizon=15),
    }
    network = hg.Network(both, {"tank": hg.Node(gauge, hg.perfect(), filters)})
    statistics = hg.monte_carlo(network, 15, runs=512, key=2, keep=hg.Statistics())
    table = statistics.to_pandas().loc["tank"]
    assert (table["claim"] == "exact").all()
    assert ((table["nees low"] < 1.02) & (table["nees high"] > 0.98)).all()
    better, linear = table.loc["quadratic"], table.loc["textbook"]
    assert better["rmse"] < linear["rmse"] - 4 * (better["rmse error"] + linear["rmse error"]) / 2
    assert better["rmse of level"] < 0.97 * linear["rmse of level"] and np.isfinite(better["rmse of leak"])
    for item in (better, linear):
        assert item["rmse"] == pytest.approx(np.hypot(item["claimed of level"], item["claimed of leak"]), rel=0.05)


def test_a_drone_with_range_bearing_stations_over_a_lossy_relay():
    """A drone circles two ground stations that measure its distance and bearing; a relay forwards their packets, adds a
    little noise and loses one in five. Where is the drone, also when the bearing jumps from pi to -pi?"""
    dt, turn = 0.5, 0.15  # s, rad/s

    def fly(x, u):
        away = x[2:] + dt * turn * jnp.stack([-x[3], x[2]])  # turns left all the time
        return jnp.concatenate([x[:2] + dt * x[2:], away])

    def look(x):
        return jnp.concatenate(
            [jnp.stack([jnp.hypot(*d), jnp.arctan2(d[1], d[0])]) for d in (x[:2] - s for s in STATIONS)]
        )

    drone = hg.Plant(
        fly,
        np.diag([0.01, 0.01, 0.02, 0.02]),
        [60.0, 0.0, 0.0, 9.0],
        np.diag([25.0, 25.0, 1.0, 1.0]),
        states=["east", "north", "speed east", "speed north"],
    )
    names = [f"{what} from {station}" for station in ("south", "north") for what in ("distance", "bearing")]
    noise = np.diag([1.0, 0.02**2] * 2)  # m^2, rad^2
    stations = hg.Sensor(look, noise, outputs=names, circular=[names[1], names[3]])
    relay = hg.amplify_and_forward(
        [hg.hop(1.0, noise=noise / 4, dimension=4), hg.hop(1.0, noise=noise / 4, dimension=4)]
    )
    filters = {"aware": hg.cubature_filter(drone, stations, relay)}
    network = hg.Network(drone, {"tablet": hg.Node(stations, hg.erasure(relay, arrival=0.8), filters)})

    record = hg.monte_carlo(network, 100, runs=96, key=5).with_units({"east": "m", "north": "m"})
    away = record.truth[..., :2] - STATIONS[0]
    jumps = np.abs(np.diff(np.arctan2(away[..., 1], away[..., 0]), axis=1)) > np.pi
    assert np.mean(jumps.any(axis=1)) > 0.9  # nearly every flight goes behind the station
    assert abs(np.mean(np.isnan(record.measurements["tablet"][..., 1])) - 0.2) < 0.03  # 7 standard errors
    result = hg.simulation.error_statistics(record, "tablet", "aware")
    nees, low, high = result.nees_per_dimension()
    assert low - 0.05 < 1 < high + 0.05, (nees, low, high)  # the measurement is curved: claims are nominal
    error = record.rmse("tablet", "aware")
    assert error["east"] < 2.0 and error["north"] < 2.0  # m, at 60 m and more
    assert not record.failures()
    with pytest.raises(ValueError, match="sine and cosine"):
        hg.cubature_filter(drone, stations, hg.hop(hg.Rayleigh(0.8), noise=noise, dimension=4))


STATIONS = np.array([[0.0, -20.0], [10.0, 30.0]])  # m
