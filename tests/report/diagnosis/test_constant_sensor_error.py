"""A constant error of one sensor of several is named, and those that it pulls along are not."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report.diagnosis.recording_diagnosis import examine

PLANT = hg.LinearPlant([[1.0, 0.1], [0.0, 1.0]], np.diag([1e-4, 1e-2]), [0.0, 0.0], np.eye(2), states=["x", "v"])
ROWS = 400


def warnings_of(noises, biased, error, seed):
    """Doubts about a centre of five sensors of a place, one of which is off by a constant."""
    sensors = {name: hg.LinearSensor([[1.0, 0.0]], r, outputs=["y"]) for name, r in zip("abcde", noises, strict=True)}
    centre = hg.kalman_filter(PLANT, hg.model.joint_sensor(sensors))
    nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name, sensor in sensors.items()}
    network = hg.Network(PLANT, nodes, {"all": centre})
    record = hg.monte_carlo(network, ROWS, 1, key=seed)
    z = {name: np.array(record.measurements[name][0]) for name in sensors}
    z[biased] += error
    return examine(network, hg.run(network, z), np.zeros((ROWS, 0))).warnings()


@pytest.mark.parametrize(
    ("noises", "biased", "error"),
    [
        ([0.1] * 5, "c", 1.0),
        (
            [0.01, 0.1, 0.1, 0.1, 0.1],
            "a",
            0.5,
        ),  # the precise one, which pulls so that the innovations of others are larger
        ([0.1, 0.1, 0.1, 0.1, 1.0], "e", -3.0),
    ],
)
def test_the_sensor_that_is_off_is_named_alone_with_its_error(noises, biased, error):
    (line,) = warnings_of(noises, biased, error, 0)
    said = line.removeprefix(f"fused/all is off by a constant error of {biased}: y, of ")
    assert said != line
    value, half = (float(number) for number in said.split(":")[0].split(" ± "))
    # Its interval of 95 %, twice: three tests together then fail once in 4,000.
    assert abs(value - error) < 2 * half < 0.5 * abs(error)


def test_a_world_without_error_names_none():
    assert warnings_of([0.1] * 5, "a", 0.0, 1) == []


def test_of_two_equal_sensors_both_are_named():
    """What one has too much the other has too little: nothing tells which."""
    sensors = {name: hg.LinearSensor([[1.0, 0.0]], 0.1, outputs=["y"]) for name in "ab"}
    nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name, sensor in sensors.items()}
    network = hg.Network(PLANT, nodes, {"all": hg.kalman_filter(PLANT, hg.model.joint_sensor(sensors))})
    record = hg.monte_carlo(network, ROWS, 1, key=2)
    z = {name: np.array(record.measurements[name][0]) for name in sensors}
    z["a"] += 1.0
    (line,) = examine(network, hg.run(network, z), np.zeros((ROWS, 0))).warnings()
    assert "constant error of a: y or b: y" in line or "constant error of b: y or a: y" in line


def doubts_of_local_nodes(error, seed, noise=0.1, link=None):
    """Doubts about five nodes that only filter by themselves, of which c is off by a constant."""
    link = hg.perfect() if link is None else link
    sensor = hg.LinearSensor([[1.0, 0.0]], noise, outputs=["y"])
    make = hg.kalman_filter if link == hg.perfect() else hg.linear_filter
    arguments = (PLANT, sensor) if link == hg.perfect() else (PLANT, sensor, link)
    network = hg.Network(PLANT, {name: hg.Node(sensor, link, {"k": make(*arguments)}) for name in "abcde"})
    record = hg.monte_carlo(network, ROWS, 1, key=seed)
    z = {name: np.array(record.measurements[name][0]) for name in "abcde"}
    z["c"] += error
    return examine(network, hg.run(network, z), np.zeros((ROWS, 0))).warnings()


@pytest.mark.parametrize("error", [0.16, -1.0])
def test_of_nodes_that_filter_by_themselves_the_one_that_is_off_is_named(error):
    """An error of half a deviation, which no node can see in its own innovations."""
    (line,) = doubts_of_local_nodes(error, 3)
    assert line.startswith("nodes disagree: a constant error of c: y, of ")
    value, half = (float(number) for number in line.split("of c: y, of ")[1].split(",")[0].split(" ± "))
    assert abs(value - error) < 2 * half < 0.5 * abs(error)


@pytest.mark.slow
def test_equal_nodes_that_filter_by_themselves_are_not_doubted():
    assert [line for seed in range(4, 8) for line in doubts_of_local_nodes(0.0, seed)] == []
