"""What is said of outputs: each by itself, what a filter used, what is stuck, what innovations cannot tell."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.report import examine
from heliograph.report.diagnosis.stuck_sensors import find_stuck_value

PLANT = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0, states=["x"])
SENSOR = hg.LinearSensor([[1.0]], 1.0, outputs=["y"])
STEPS = 1500


def health_of(network, measurements):
    rows = len(next(iter(measurements.values())))
    return examine(network, hg.run(network, measurements), np.zeros((rows, 0)))


def test_outliers_that_a_gate_refused_do_not_count_against_it():
    """5 % outliers of deviation 50 make the mean square of all innovations some 90, of those that were used 1."""
    rng = np.random.default_rng(0)
    x = np.cumsum(0.1 * rng.standard_normal(STEPS))
    y = x + rng.standard_normal(STEPS) + 50 * rng.standard_normal(STEPS) * (rng.random(STEPS) < 0.05)
    gate = hg.robust_filter(PLANT, SENSOR, hg.perfect(), hg.filters.Gate(16.0))
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"gate": gate})})
    health = health_of(network, {"a": y[:, None]})
    judged = health.outputs[0].judged
    assert judged.summary.squared > 50 and abs(judged.size - 1) < 4 * judged.size_error < 0.3
    assert not any("too sure" in line for line in health.warnings())


def test_a_gate_that_refuses_all_is_doubted():
    """It began a thousand deviations off, so that nothing counts, and no innovation that counts tells of it."""
    gate = hg.robust_filter(PLANT, SENSOR, hg.perfect(), hg.filters.Gate(9.0))
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"gate": gate})})
    z = 1000 + np.random.default_rng(1).standard_normal((STEPS, 1))
    with pytest.warns(UserWarning, match="a/gate left out") as said:
        health = health_of(network, {"a": z})
    (line,) = health.warnings()
    assert line.startswith(f"a/gate left out {STEPS} of {STEPS} values of y") and [str(w.message) for w in said] == [
        line
    ]


def test_a_gate_in_the_centre_that_refuses_one_node_is_doubted_of_that_output():
    joint = hg.model.joint_sensor({"a": SENSOR, "b": SENSOR})
    gate = hg.robust_filter(PLANT, joint, hg.perfect(2), hg.filters.Gate(16.0))
    network = hg.Network(PLANT, {name: hg.Node(SENSOR, hg.perfect(), {}) for name in "ab"}, {"gate": gate})
    z = np.random.default_rng(1).standard_normal((2, STEPS, 1))
    with pytest.warns(UserWarning) as said:
        record = hg.run(network, {"a": z[0], "b": z[1] + 100})
    (line,) = [str(w.message) for w in said]
    assert line.startswith(f"fused/gate left out {STEPS} of {STEPS} values of b: y")
    assert np.max(np.abs(record.estimates["fused"]["gate"].mean)) < 10


def test_each_output_is_judged_by_itself():
    """One output 2.6 times, another a third of what is claimed: their mean is near 1 and says nothing."""
    rng = np.random.default_rng(1)
    sensor = hg.LinearSensor([[1.0], [1.0]], np.eye(2), outputs=["wheel", "gnss"])
    x = np.cumsum(0.1 * rng.standard_normal(STEPS))
    y = x[:, None] + rng.standard_normal((STEPS, 2)) * np.sqrt([0.3, 1.75])
    network = hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(2), {"k": hg.kalman_filter(PLANT, sensor)})})
    health = health_of(network, {"a": y})
    assert abs(health.filters[0].test.power - 1) < 0.1
    sure, large = health.warnings()
    assert sure.startswith("a/k is too sure of gnss: ") and large.startswith("a/k expects more of wheel than comes: ")


def test_a_sensor_that_is_stuck_is_named_and_others_are_not():
    rng = np.random.default_rng(2)
    x = np.cumsum(0.1 * rng.standard_normal(STEPS))
    z = {name: x[:, None] + rng.standard_normal((STEPS, 1)) for name in ("good", "bad")}
    z["bad"][700:1100] = z["bad"][700]
    nodes = {name: hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)}) for name in z}
    (line,) = health_of(hg.Network(PLANT, nodes), z).warnings()
    assert line.startswith("bad: y is stuck, or has no noise: 400 equal values in a row") and "from row 701" in line


def test_a_stuck_sensor_of_a_filter_in_the_centre_is_named_and_the_filter_is_not():
    rng = np.random.default_rng(2)
    x = np.cumsum(0.1 * rng.standard_normal(STEPS))
    z = {name: x[:, None] + rng.standard_normal((STEPS, 1)) for name in "abc"}
    z["b"][700:820] = z["b"][700]
    centre = hg.kalman_filter(PLANT, hg.model.joint_sensor(dict.fromkeys(z, SENSOR)))
    network = hg.Network(PLANT, {name: hg.Node(SENSOR, hg.perfect(), {}) for name in z}, {"all": centre})
    (line,) = health_of(network, z).warnings()
    assert line.startswith("b: y is stuck, or has no noise: 120 equal values in a row")


def test_values_that_a_link_repeats_by_itself_are_not_stuck():
    """A link that is off gives 0: of 20 % such values four follow one another in half of all recordings."""
    link, plant = hg.dropout(hg.hop(1.0, 0.0), 0.8), hg.LinearPlant([[0.9]], 0.19, [0.0], 1.0)
    network = hg.Network(plant, {"a": hg.Node(SENSOR, link, {"lin": hg.linear_filter(plant, SENSOR, link)})})
    z = hg.monte_carlo(network, STEPS, 1, key=3).measurements["a"][0]
    assert np.sum(z == 0) > 200 and health_of(network, {"a": z}).warnings() == []


def test_coarse_readings_of_what_rests_are_not_stuck():
    """A reading of resolution 2 with noise of deviation .1 repeats by itself; one of resolution .1 with 1 does not."""
    rng = np.random.default_rng(3)
    coarse = np.round(0.1 * rng.standard_normal(500) / 2) * 2
    coarse[250:] += 2
    assert find_stuck_value(coarse, np.full(500, 0.01)) is None
    fine = np.round(rng.standard_normal(5000), 1)
    assert find_stuck_value(fine, np.full(5000, 1.0)) is None
    fine[40:52] = 0.3
    held = find_stuck_value(fine, np.full(5000, 1.0))
    assert held is not None and held.readings >= 12 and held.first_row <= 40


def test_what_rests_and_has_no_noise_has_a_page():
    """All innovations zero: there is nothing to test, and it is said why."""
    network = hg.Network(PLANT, {"odom": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(PLANT, SENSOR)})})
    health = health_of(network, {"odom": np.zeros((200, 1))})
    (line,) = health.warnings()
    assert "all 200 values are 0" in line and health.filters[0].test is None


@pytest.mark.parametrize("link", [hg.perfect(), hg.hop(1.5, 0.01), hg.erasure(hg.hop(1.5, 0.01), 0.9)])
def test_noise_of_one_side_is_no_bias(link):
    """The median of noise that is late by an exponential law lies below its mean; the world is the model's own."""
    law = hg.Contaminated.one_sided(0.01, 0.2, 2.0)
    sensor = hg.LinearSensor([[1.0]], law, outputs=["y"])
    filters = {"score": hg.robust_filter(PLANT, sensor, link.base if link.erases else link)}
    network = hg.Network(PLANT, {"a": hg.Node(sensor, link, filters)})
    z = hg.monte_carlo(network, STEPS, 1, key=0).measurements["a"][0]
    summary = health_of(network, {"a": z}).outputs[0].judged.summary
    assert summary.bias_low < 0 < summary.bias_high


def test_outliers_to_one_side_are_no_memory():
    """Innovations that count keep a mean, which squared is no correlation; the filter is within 1 % of the best one's
    error, by a grid.
    """
    sensor = hg.LinearSensor([[1.0]], hg.Contaminated.one_sided(0.25, 0.2, 4.0), outputs=["y"])
    filters = {"score": hg.robust_filter(PLANT, sensor, hg.perfect())}
    network = hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(), filters)})
    z = hg.monte_carlo(network, STEPS, 1, key=0).measurements["a"][0]
    health = health_of(network, {"a": z})
    assert health.warnings() == [] and abs(health.filters[0].test.correlation[0]) < 0.1  # 4 of its deviations


@pytest.mark.parametrize("size", [0.12, 1.0])
def test_small_innovations_do_not_make_a_filter_cautious(size):
    """A slow error of the sensor leaves small innovations: the page says that they cannot tell."""
    rng = np.random.default_rng(4)
    y = 0.3 * rng.standard_normal(STEPS) if size < 1 else rng.standard_normal(STEPS)
    plant = hg.LinearPlant([[1.0]], 1e-4, [0.0], 1e-2, states=["x"])
    network = hg.Network(plant, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(plant, SENSOR)})})
    lines = health_of(network, {"a": y[:, None]}).warnings()
    assert (len(lines) == 1 and "Innovations cannot tell the two apart" in lines[0]) if size < 1 else lines == []


def test_right_recordings_are_seldom_named_stuck():
    """216 recordings of Gaussian and contaminated noise, six resolutions, readings with the error of rounding known or
    not, walks that rest and run: none, where one in 10,000 may be."""
    rng, named = np.random.default_rng(4), 0
    for share in (0.0, 0.05):
        for q in (0.01, 0.1, 0.3, 1.0, 2.0, 4.0):
            for rounding in (0.0, q**2 / 12):
                shares, variances = np.array([1 - share, share]), np.array([1.0, 100.0]) + rounding
                law = SimpleNamespace(share=shares, variance=variances, total=shares @ variances)
                for walk in (0.0, 0.01, 0.3):
                    for n in (300, 3000, 20_000):
                        x = np.cumsum(walk * rng.standard_normal(n)) + rng.uniform(-5, 5)
                        v = np.where(rng.random(n) < share, 10.0, 1.0) * rng.standard_normal(n)
                        claimed = np.full(n, law.total + walk**2)
                        named += find_stuck_value(np.round((x + v) / q) * q, claimed, law) is not None
    assert named == 0


def test_how_long_a_sensor_stands_until_it_is_named():
    """Of 100 readings with noise of deviation 1 and resolution .1 six equal ones in a row are found, five are not:
    100 p^5 < 1e-4 < 100 p^4 with p = erf(.1 / sqrt 8) = .040."""
    fine = np.round(np.random.default_rng(5).standard_normal(100), 1)
    for standing, found in ((5, False), (6, True)):
        z = fine.copy()
        z[50 : 50 + standing] = 9.9
        held = find_stuck_value(z, np.ones(100))
        assert (held is not None) == found
    assert held.readings == 6 and held.stuck == 8


def test_times_in_another_unit_are_doubted():
    """A place of a car each 20 ms: times in milliseconds make all noise of the motion a thousand times too large."""
    rng, n, dt = np.random.default_rng(0), 600, 0.02
    noise = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) / 2
    plant = hg.LinearPlant(
        lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]),
        lambda u: jnp.array([[u[0] ** 3 / 3, u[0] ** 2 / 2], [u[0] ** 2 / 2, u[0]]]) / 2,
        [0.0, 1.0], np.eye(2), states=["place", "speed"], inputs=["dt"],
    )  # fmt: skip
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.04)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
    speed, place = np.cumsum(rng.multivariate_normal(np.zeros(2), noise, n) * [0, 1], axis=0)[:, 1] + 1, 0.0
    z = (np.cumsum(speed) * dt + place + 0.2 * rng.standard_normal(n))[:, None]
    said = {}
    for factor in (1.0, 1000.0):
        u = np.full((n, 1), dt * factor)
        said[factor] = examine(network, hg.run(network, {"a": z}, u, time=np.cumsum(u)), u).warnings()
    assert said[1.0] == []
    first = said[1000.0][0]
    assert first.startswith(
        "dt is 20 between rows, and seems to be in another unit than the plant: with a thousandth of"
    )


def test_what_a_node_refuses_as_stuck_is_said_to_be_refused_and_not_to_be_lost():
    rng = np.random.default_rng(2)
    sensor = hg.LinearSensor([[1.0]], 1.0, outputs=["y"], resolution=0.01)
    z = np.round(np.cumsum(0.1 * rng.standard_normal(STEPS)) + rng.standard_normal(STEPS), 2)[:, None]
    z[700:1100] = z[700]
    node = hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(PLANT, sensor)}, stuck=True)
    with pytest.warns(UserWarning, match="396 of 1500 values count as not arrived, by stuck; row 705: y"):
        (line,) = health_of(hg.Network(PLANT, {"a": node}), {"a": z}).warnings()
    assert line.startswith("a: y is stuck") and line.endswith("what repeated for longer was refused")


@pytest.mark.parametrize("deviations, doubts", [(4000.0, 1), (30.0, 0)])
def test_one_innovation_that_no_law_gives_is_doubted_in_few_rows(deviations, doubts):
    """Of 4 rows, too few for tests: Chebyshev leaves one beyond sqrt(4 / 0.001) = 63 deviations to one in 1,000."""
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"kalman": hg.kalman_filter(PLANT, SENSOR)})})
    # The state begins with variance 1 and is predicted with 1.01: the first innovation has the variance 2.01.
    measured = np.zeros((4, 1))
    measured[0] = deviations * np.sqrt(2.01)
    lines = health_of(network, {"a": measured}).warnings()
    assert len(lines) == doubts
    if doubts:
        assert lines[0].startswith(
            "a/kalman is too sure, or the measurement is wrong: its innovation in row 1 is 4e+03 "
        )
