"""Behind random gains a recording is judged by its own moments: a right filter is not doubted, a wrong one is."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report.diagnosis.recording_diagnosis import examine

ROWS = 1000
SENSOR = hg.LinearSensor([[1.0]], [[0.1]], outputs=["y"])


def walk(noise):
    """A walk without bounds."""
    return hg.LinearPlant([[1.0]], [[noise]], [0.0], [[1.0]], states=["x"])


def losing(variance):
    """A link that delivers its own noise alone at one step of five, unnoticed."""
    return hg.dropout(hg.hop(1.0, variance), arrival=0.8)


def network_of(plant, link):
    return hg.Network(plant, {"n": hg.Node(SENSOR, link, {"linear": hg.linear_filter(plant, SENSOR, link)})})


def warnings_of(world, believed, runs):
    """Doubts about each run of one network, recorded in another."""
    record = hg.monte_carlo(world, ROWS, runs, key=0)
    recordings = (np.array(record.measurements["n"][i]) for i in range(runs))
    return [examine(believed, hg.run(believed, {"n": z}), np.zeros((ROWS, 0))).warnings() for z in recordings]


@pytest.mark.slow
def test_a_right_filter_of_a_wandering_plant_is_not_doubted():
    """By its mean over all runs, 32 of 40 such recordings were called too sure or too cautious."""
    right = network_of(walk(0.01), losing(0.05))
    assert warnings_of(right, right, 8) == [[]] * 8


def test_a_link_noisier_than_stated_is_still_told():
    """Noise of .3 for .05: 21 of 30 recordings tell; four of six or more with a probability above .8."""
    doubts = warnings_of(network_of(walk(0.01), losing(0.3)), network_of(walk(0.01), losing(0.05)), 6)
    assert sum("too sure" in " ".join(lines) for lines in doubts) >= 3


def test_a_process_noise_of_a_tenth_is_told_by_all_lags():
    """One lag alone told 7 of 30 (0.08 with the last, each of ten as much)."""
    small = hg.Network(
        plant := walk(0.0001), {"n": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(plant, SENSOR)})}
    )
    doubts = warnings_of(network_of(walk(0.001), hg.perfect()), small, 10)
    assert sum(any("could know more" in line or "too sure" in line for line in lines) for lines in doubts) == 10


def test_what_is_expected_of_a_run_is_on_average_that_of_all_runs():
    """E[m m' + P] is the second moment before any data: the mean of 100 runs' ratios is 1 within their error."""
    plant, link = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]], states=["x"]), losing(0.05)
    network = network_of(plant, link)
    record = hg.monte_carlo(network, 200, 100, key=0)
    filter = network.nodes["n"].filters["linear"]
    means = [
        (np.asarray(filter.given_record().run(z).innovation_covariances) / filter.run(z).innovation_covariances).mean()
        for z in np.array(record.measurements["n"])
    ]
    assert abs(np.mean(means) - 1) < 4 * np.std(means) / 10 < 0.1


def test_a_filter_behind_a_known_gain_is_its_own_judge():
    kalman = hg.kalman_filter(walk(0.01), SENSOR)
    assert kalman.given_record() is kalman
