"""Judgement of declared variances: a receiver whose fixes declare 4.84 m, with a slow error or without one."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.report.diagnosis.recording_diagnosis import examine

Q, WHITE, DECLARED, MEMORY = 1e-4, 0.0302, 4.84, 300.0
START = np.array([5.0, 5.0, 0.5, 0.5])
MOVE = np.block([[np.eye(2), np.eye(2)], [np.zeros((2, 2)), np.eye(2)]])
NOISE = Q * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
PLANT = hg.LinearPlant(MOVE, NOISE, np.zeros(4), np.diag(START**2), states=["e", "n", "ve", "vn"])
SENSOR = hg.LinearSensor(np.eye(2, 4), np.zeros((2, 2)), outputs=["east", "north"])
LINK = hg.model.told(lambda a: hg.hop(1.0, jnp.diag(a)), ["var_east", "var_north"], typical=[1.0, 1.0])
FILTER = hg.linear_filter(PLANT, SENSOR, LINK)
BOTH = ("white part of the error", "has a memory of about")


def fixes(seed, rows, bias, deviation=WHITE, declared=DECLARED):
    """Rows of fixes (rows, 4) with what they declare: the path, white noise, and a Gauss-Markov bias or none."""
    rng = np.random.default_rng(seed)
    x, root = START * rng.normal(size=4), np.linalg.cholesky(NOISE)
    a, b = np.exp(-1 / MEMORY), DECLARED * rng.normal(size=2)
    values = np.empty((rows, 2))
    for k in range(rows):
        x = MOVE @ x + root @ rng.normal(size=4)
        b = a * b + DECLARED * np.sqrt(1 - a**2) * rng.normal(size=2)
        values[k] = x[:2] + bias * b
    white = np.broadcast_to(deviation, rows)[:, None] * rng.normal(size=(rows, 2))
    return np.column_stack([values + white, np.repeat(np.broadcast_to(declared, rows)[:, None] ** 2, 2, axis=1)])


def said(sentences):
    return [any(part in sentence for sentence in sentences) for part in BOTH]


def test_true_variances_are_not_doubted():
    judgement = hg.simulation.judge_declared(FILTER, fixes(3, 200, False, 0.5, 0.5))
    (one,) = judgement.classes
    assert not judgement.contradicted and judgement.sentences() == []
    assert one.numbers == 400 and one.nis_low < one.nis < one.nis_high
    # quantiles of chi-squared with 400 degrees of freedom, from tables
    assert (one.nis_low, one.nis_high) == pytest.approx((330.903 / 400, 476.606 / 400), rel=1e-5)


@pytest.mark.slow
def test_variances_too_large_are_scaled_and_pass():
    judgement = hg.simulation.judge_declared(FILTER, fixes(0, 200, False))
    assert judgement.contradicted and judgement.correlation > 0.8 and judgement.bias is None
    (line,) = judgement.sentences()
    assert "times too large" in line and not any(said([line]))
    (one,) = judgement.classes
    # 400 numbers tell the logarithm of a variance to sqrt(2 / 400) = .07; some less, since the filter follows
    assert abs(np.log(one.scale / (WHITE / DECLARED) ** 2)) < 0.3
    assert np.log(one.scale_high / one.scale_low) == pytest.approx(2 * 1.96 * 0.08, rel=0.2)


@pytest.mark.slow
def test_each_class_has_a_scale():
    """Half of the fixes declare a fourth of their variance."""
    good = np.arange(400) % 2 == 0
    rows = fixes(1, 400, False, np.where(good, 0.2, 1.0), np.where(good, 0.2, 0.5))
    judgement = hg.simulation.judge_declared(FILTER, rows)
    first, second = judgement.classes
    # each of 400 numbers, which tell its logarithm to .07
    assert abs(np.log(first.scale)) < 0.28 and abs(np.log(second.scale / 4)) < 0.28
    assert second.scale_low < second.scale < second.scale_high and first.scale_high > 1
    (line,) = judgement.sentences()
    assert line.startswith("declared variances from 0.25 to 0.25 are") and "times too small" in line


def test_rows_that_declare_nothing_are_left_out():
    rows = fixes(3, 200, False, 0.5, 0.5)
    rows[::5, 2], rows[1::5, 3] = np.nan, -1.0
    assert hg.simulation.judge_declared(FILTER, rows).classes[0].numbers == 240


def test_what_cannot_be_judged_is_refused():
    plain = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
    gain = hg.linear_filter(PLANT, SENSOR, hg.hop(hg.Rayleigh(1.0), np.eye(2), known=True))
    for filter in (plain, gain, 1):
        with pytest.raises(ValueError, match="whose link tells the variance"):
            hg.simulation.judge_declared(filter, np.zeros((50, 4)))
    with pytest.raises(ValueError, match="at least 20 rows with values"):
        hg.simulation.judge_declared(FILTER, fixes(0, 10, False))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [60, 120, 500])
def test_a_slow_error_is_told_from_variances_that_are_too_large(rows):
    """Of the 200 recordings of each kind and length that `benchmarks/declared.py` draws, the first ten.

    Intervals of the memory hold it in 95 of 100, and the likelihood of 60 rows is far from a parabola: most of ten.
    """
    held = 0
    for seed in range(10):
        bias = hg.simulation.judge_declared(FILTER, fixes([seed, rows], rows, True))
        assert all(said(bias.sentences())), seed
        assert bias.bias is not None
        held += bias.bias.time_low < MEMORY < bias.bias.time_high
        assert bias.bias.times_white_low < DECLARED / WHITE
        none = hg.simulation.judge_declared(FILTER, fixes([seed, rows, 1], rows, False))
        assert not any(said(none.sentences())), seed
    assert held >= 8


@pytest.mark.slow
def test_report_says_it():
    network = hg.Network(PLANT, {"gps": hg.Node(SENSOR, LINK, {"f": FILTER})})
    rows = fixes([0, 120], 120, True)
    health = examine(network, hg.run(network, {"gps": rows}), np.zeros((120, 0)))
    assert [line for line in health.warnings() if line.startswith("gps/f: ")] == [
        f"gps/f: {line}" for line in health.filters[0].declared[0].sentences()
    ]
    assert all(said(health.warnings())) and "steps" in health.warnings()[-1]


def test_check_says_whose_noise_is_taken_as_told():
    network = hg.Network(PLANT, {"gps": hg.Node(SENSOR, LINK, {"f": FILTER})})
    (line,) = [doubt for doubt in hg.simulation.doubts_before_data(network) if doubt.words.startswith("declared")]
    assert not line.serious and "'gps'" in line.words


ROAD = hg.LinearPlant(
    [[1.0, 1.0], [0.0, 1.0]], Q * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), [0.0, 0.0], np.diag([25.0, 0.25])
)
ALONG = hg.LinearSensor([[1.0, 0.0]], 0.0, outputs=["along"])
ONE = hg.model.told(lambda a: hg.hop(1.0, a[0]), ["variance"], typical=[1.0])
SENDERS = ("car", "phone")


def two_senders(seed, rows, bias, declared):
    """Fixes of two senders of one path, each with its bias, white noise of WHITE and what it declares: (rows, 4)."""
    path = fixes([seed, rows, 7], rows, 0.0, 0.0)[:, 0]
    rng, a = np.random.default_rng([seed, 3]), np.exp(-1 / MEMORY)
    columns = []
    for size, given in zip(bias, declared, strict=True):
        b = size * rng.normal()
        slow = [b := a * b + size * np.sqrt(1 - a**2) * rng.normal() for _ in range(rows)]
        columns += [path + slow + WHITE * rng.normal(size=rows), np.full(rows, given**2)]
    return np.column_stack(columns)


def centre():
    joint = hg.model.joint_sensor(dict.fromkeys(SENDERS, ALONG))
    return hg.linear_filter(ROAD, joint, hg.parallel([ONE, ONE]))


@pytest.mark.slow
def test_of_a_centre_each_sender_is_judged():
    """The phone's bias and what it declares are told, the car is not doubted; its rows come every second step alone."""
    data = two_senders(0, 240, (0.0, DECLARED), (WHITE, DECLARED))
    data[1::2, :2] = np.nan
    car, phone = hg.simulation.judge_declared_links(centre(), data)
    assert (car.outputs, phone.outputs) == (("car_along",), ("phone_along",))
    assert (car.classes[0].numbers, phone.classes[0].numbers) == (120, 240)
    assert all(said(phone.sentences())) and not any(said(car.sentences()))
    assert phone.bias.time_low < 3 * MEMORY and phone.bias.times_white_low > 20
    network = hg.Network(ROAD, {name: hg.Node(ALONG, ONE, {}) for name in SENDERS}, {"all": centre()})
    record = hg.run(network, {"car": data[:, :2], "phone": data[:, 2:]})
    warnings = examine(network, record, np.zeros((240, 0))).warnings()
    assert [f"fused/all: phone_along: {line}" for line in phone.sentences()] == [w for w in warnings if "fused" in w]


def test_of_several_links_judge_declared_says_what_judges_them():
    with pytest.raises(ValueError, match="one of 2 such links, which judge_declared_links judges"):
        hg.simulation.judge_declared(centre(), np.zeros((50, 4)))
    assert hg.simulation.judge_declared_links(centre(), np.full((50, 4), np.nan)) == ()
    assert hg.simulation.judge_declared_links(hg.kalman_filter(ROAD, hg.LinearSensor([[1.0, 0.0]], 1.0)), [[0.0]]) == ()


@pytest.mark.slow
def test_what_no_scale_explains_is_said():
    """One reading of 1e100: its likelihood is 0 for every scale in reach, and the judgement had no sentence at all."""
    rows = fixes(3, 100, False, 0.5, 0.5)
    rows[50, 0] = 1e100
    judgement = hg.simulation.judge_declared(FILTER, rows)
    (line,) = judgement.sentences()
    assert judgement.contradicted and line.startswith("no scale explains the innovations")
    assert np.isnan([one.scale for one in judgement.classes]).all()
