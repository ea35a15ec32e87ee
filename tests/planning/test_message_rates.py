"""Rates and errors of senders that decide, before any data, against published numbers and simulation."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.planning.message_rates import (
    delta_for_rate,
    least_error,
    prediction_error_rate,
    send_on_delta_rate,
    simulate_rate,
)

HALVED, PRECISE = hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.002)  # sqrt(4 / 3 / .002) = 25.8
PLANT, SENSOR = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
NOISY = hg.LinearSensor([[1.0]], 1.0)  # of which a grid is small


@pytest.mark.parametrize(
    ("delta", "rate", "error"), [(0.3, 0.21435, 0.16556), (0.6, 0.07081, 0.28757), (1.0, 0.02584, 0.44493)]
)
def test_a_sender_that_transmits_its_estimate(delta, rate, error):
    result = prediction_error_rate(PLANT, SENSOR, delta)
    assert result.rate == pytest.approx(rate, abs=5e-6) and np.sqrt(result.error[0]) == pytest.approx(error, abs=5e-6)


def test_the_same_by_simulation_with_losses_that_are_acknowledged():
    """A million steps of the chain e+ = a e + N(0, s^2) itself: 1 % is five standard errors."""
    random, known = np.random.default_rng(0), prediction_error_rate(PLANT, SENSOR, 0.6, 0.2)
    p = 1.0
    for _ in range(200):
        before = 0.98**2 * p + 0.04
        p = before * 0.01 / (before + 0.01)
    s = before / np.sqrt(before + 0.01)
    e, sent, squares, steps = np.zeros(2000), 0, 0.0, 800
    for k in range(steps):
        e = 0.98 * e + s * random.normal(size=e.shape)
        event = np.abs(e) > 0.6
        e = np.where(event & (random.random(e.shape) > 0.2), 0.0, e)
        if k >= 100:
            sent, squares = sent + event.mean(), squares + (e**2).mean()
    assert known.rate == pytest.approx(sent / (steps - 100), rel=0.01)
    assert known.error[0] == pytest.approx(p + squares / (steps - 100), rel=0.01)


def test_the_least_error_at_a_rate_and_what_send_on_delta_has_above_it():
    assert np.sqrt(least_error(PLANT, SENSOR, 0.1)) == pytest.approx(0.2438, abs=5e-5)
    assert np.sqrt(least_error(PLANT, SENSOR, 0.1, 0.2)) == pytest.approx(0.2800, abs=5e-5)
    result = simulate_rate(PLANT, SENSOR, hg.perfect(), hg.SendOnDelta(0.6))
    bound = least_error(PLANT, SENSOR, result.rate)
    assert np.sqrt(result.error[0] / bound) == pytest.approx(1.018, abs=0.02)  # 1.8 % in the table of 10,000 steps


@pytest.mark.parametrize(("delta", "rate"), [(0.6, 0.08692), (1.0, 0.03262)])
def test_the_rate_of_send_on_delta(delta, rate):
    assert send_on_delta_rate(PLANT, SENSOR, delta) == pytest.approx(rate, rel=5e-4)


def test_the_unit_of_a_measurement_changes_no_rate():
    scaled = send_on_delta_rate(PLANT, hg.LinearSensor([[10.0]], 1.0), 6.0)
    assert scaled == pytest.approx(0.08692, rel=5e-4)


def test_a_rare_message_has_the_rate_of_a_simulation():
    """Where messages are rare the law of the reference converges slowly; power iteration stopped 7 % too low."""
    rng = np.random.default_rng(0)
    x = reference = rng.normal(0.0, 1.0, 4000)
    sent = 0
    for k in range(1200):
        x = 0.95 * x + np.sqrt(0.1) * rng.standard_normal(4000)
        y = x + np.sqrt(0.1) * rng.standard_normal(4000)
        there = np.abs(y - reference) > 2.0
        sent, reference = sent + there.sum() * (k >= 400), np.where(there, y, reference)
    rate = send_on_delta_rate(hg.LinearPlant([[0.95]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1), 2.0)
    assert rate == pytest.approx(sent / 800 / 4000, rel=0.015)  # 74,000 messages: 3 standard errors are 1.3 %


@pytest.mark.slow
def test_the_delta_for_a_budget():
    delta = delta_for_rate(PLANT, SENSOR, 0.1)
    result = simulate_rate(PLANT, SENSOR, hg.erasure(hg.perfect(), 0.8), hg.SendOnDelta(delta), runs=256)
    assert result.rate == pytest.approx(0.1, abs=0.003)
    assert np.sqrt(result.error[0]) == pytest.approx(0.384, abs=0.02)  # +- .007 in the reference table


def test_what_has_no_rate_before_data_is_refused_in_one_line():
    two = hg.LinearPlant(np.eye(2) * 0.9, np.eye(2), [0.0, 0.0], np.eye(2))
    for build, words in (
        (lambda: send_on_delta_rate(two, hg.LinearSensor([[1.0, 0.0]], 1.0), 1.0), "rate before any data: expected a"),
        (lambda: send_on_delta_rate(hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0), SENSOR, 1.0), "plant: expected a stable"),
        (lambda: send_on_delta_rate(HALVED, PRECISE, 0.5), r"at most 36.4 cells of the grid .*, got 52 cells"),
        (lambda: send_on_delta_rate(HALVED, NOISY, 12.0), "delta: expected one at which more than 1e-06 messages"),
        (lambda: send_on_delta_rate(PLANT, SENSOR, 2.0**40), "delta: expected one at which more than 1e-06 messages"),
        (lambda: prediction_error_rate(PLANT, SENSOR, 1.0, 1.0), "loss: expected a number below 1"),
        (lambda: least_error(PLANT, SENSOR, 1.5), "rate: expected a number between 0 and 1"),
    ):
        with pytest.raises(ValueError, match=words):
            build()


def test_what_an_unstable_plant_drives_away_while_losses_last_is_in_the_error():
    """With delta near 0 each step sends: j losses in a row of probability (1 - l) l^j leave s^2 (a^2j - 1) / (a^2 - 1).

    Their sum is s^2 l / (1 - l a^2). The line used to end 12 deviations of a step away: 3.53 was said where it is 5.0.
    """
    a, loss = 1.3, 0.5
    p = 1.0
    for _ in range(200):
        before = a * a * p + 1
        p = before * 0.5 / (before + 0.5)
    s2, j = before**2 / (before + 0.5), np.arange(2000)
    sum_of_losses = np.sum((1 - loss) * (loss * a * a) ** j - (1 - loss) * loss**j) * s2 / (a * a - 1)
    unstable, sensor = hg.LinearPlant([[a]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.5)
    result = prediction_error_rate(unstable, sensor, 1e-6, loss)
    assert result.rate == pytest.approx(1, abs=1e-5) and result.error[0] == pytest.approx(p + sum_of_losses, rel=1e-5)
    assert prediction_error_rate(unstable, sensor, 1.0, 0.7).error[0] == np.inf  # .7 * 1.3^2 > 1


@pytest.mark.parametrize("law", [hg.Contaminated(0.1, 0.05, 10.0), hg.StudentT(0.3, 3.0)])
def test_other_than_gaussian_noise_is_refused(law):
    """By its variance alone send-on-delta behind this contaminated noise had a rate of .511, which is .433."""
    plant = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0)
    for compute in (send_on_delta_rate, delta_for_rate, prediction_error_rate, least_error):
        with pytest.raises(hg.InputError, match=r"Gaussian noises \(simulate_rate takes any\), got Gaussian and"):
            compute(plant, hg.LinearSensor([[1.0]], law), 0.3)
        with pytest.raises(hg.InputError, match="expected Gaussian noises"):
            compute(hg.LinearPlant([[0.9]], law, [0.0], 1.0), NOISY, 0.3)


def test_a_plant_that_inputs_move_has_no_rate_of_send_on_delta():
    driven = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0, [[1.0]])
    for compute in (send_on_delta_rate, delta_for_rate):
        with pytest.raises(hg.InputError, match="expected a plant without inputs"):
            compute(driven, NOISY, 0.3)
    still = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0)  # both ends know what inputs do to a prediction
    assert prediction_error_rate(driven, NOISY, 1.0).rate == prediction_error_rate(still, NOISY, 1.0).rate


def test_angles_and_what_never_changes_have_no_rate():
    """Of an angle the rate was that of a number on a line; without noise, or with a sensor of 0, a division by 0."""
    turning = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, circular=["x0"])
    bearing = hg.LinearSensor([[1.0]], 0.5, circular=["y0"])
    plant, still = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0), hg.LinearPlant([[0.9]], 0.0, [0.0], 1.0)
    for compute in (send_on_delta_rate, delta_for_rate, prediction_error_rate, least_error):
        for pair in ((turning, bearing), (plant, bearing)):
            with pytest.raises(hg.InputError, match="rate before any data: expected no angles"):
                compute(*pair, 0.3)
        for pair in ((plant, hg.LinearSensor([[0.0]], 0.5)), (still, hg.LinearSensor([[1.0]], 0.0)), (still, NOISY)):
            with pytest.raises(hg.InputError, match="rate before any data: expected a plant with noise, and a sensor"):
                compute(*pair, 0.3)
