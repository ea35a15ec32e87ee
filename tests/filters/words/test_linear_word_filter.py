"""The linear filter behind words: its claims, against a recursion of scalars and against true bits."""

import re

import numpy as np
import pytest

import heliograph as hg
from heliograph import report

A, Q, R = 0.95, 0.1, 0.05
X = Q / (1 - A**2)  # stationary variance of the state
DEVIATION = np.sqrt(X + R)
PLANT, SENSOR = hg.LinearPlant([[A]], [[Q]], [0.0], [[X]]), hg.LinearSensor([[1.0]], [[R]])


def words(bits, dither, range_=5.0):
    """Return an encoder whose range is so many deviations of y to each side."""
    return hg.Words(bits=bits, low=-range_ * DEVIATION, high=range_ * DEVIATION, dither=dither)


def steady(encoder, channel):
    """Return the claimed variance after 200 steps, which depends on no data."""
    filter = hg.linear_filter(PLANT, SENSOR, channel, encoder=encoder)
    return filter.claim, filter.run(np.zeros((200, filter.received))).covariances[-1, 0, 0]


def share(encoder):
    """Return E f(1 - f) of y, by quadrature."""
    y = np.linspace(-9, 9, 400_001) * DEVIATION
    density = np.exp(-((y / DEVIATION) ** 2) / 2)
    f = (y - encoder.low) / encoder.step % 1
    return np.sum(density * f * (1 - f)) / np.sum(density)


def recursion(encoder, error, p):
    """Return the steady variance with the noise V of the words, divided by g: P = (1/(A^2 P + Q) + g^2/V)^-1."""
    g = 1 - 2 * p
    v = g**2 * (R + error * encoder.step**2) + encoder.power * (1 - g**2)
    variance = X
    for _ in range(3000):
        variance = 1 / (1 / (A**2 * variance + Q) + g**2 / v)
    return variance


@pytest.mark.parametrize(
    ("bits", "p", "subtracted", "stochastic", "triangular"),
    [
        (8, 0.0, 0.03640, 0.03648, 0.03656),
        (8, 0.01, 0.15188, 0.15190, 0.15193),
        (3, 0.01, 0.20170, 0.22730, 0.24972),
        (2, 0.0, 0.24645, 0.35256, 0.40081),
    ],
)
def test_the_claim_is_that_of_the_recursion_of_the_words_moments(bits, p, subtracted, stochastic, triangular):
    channel = hg.decode_and_forward([p])
    errors = {"subtracted": 1 / 12, "stochastic": None, "triangular": 1 / 4}
    for (dither, error), published in zip(errors.items(), (subtracted, stochastic, triangular), strict=True):
        encoder = words(bits, dither)
        claim, variance = steady(encoder, channel)
        expected = recursion(encoder, share(encoder) if error is None else error, p)
        assert claim == "exact"
        assert variance == pytest.approx(expected, rel=1e-9)  # the same algebra in another order
        assert variance == pytest.approx(published, abs=5e-6)  # as printed


def test_a_filter_without_dither_claims_no_more_than_its_noise_dithers():
    fine, coarse = words(8, "none"), words(3, "none")
    assert steady(fine, hg.decode_and_forward([0.01]))[0] == "exact"  # D = 0.043, the noise's deviation 0.22
    assert steady(coarse, hg.decode_and_forward([0.01]))[0] == "nominal"


def test_claims_are_upper_where_the_law_of_the_signal_is_unknown():
    noise = hg.random_affine.FiniteSupport([[-0.3], [0.3]], [0.5, 0.5])
    sensor = hg.LinearSensor([[1.0]], noise)
    channel = hg.decode_and_forward([hg.Discrete([0.0, 0.1], [0.8, 0.2])])
    for dither, claim in (
        ("triangular", "exact"),
        ("stochastic", "upper"),
        ("subtracted", "upper"),
        ("none", "nominal"),
    ):
        assert hg.linear_filter(PLANT, sensor, channel, encoder=words(5, dither)).claim == claim


def world(encoder, channel, sensor=SENSOR, plant=PLANT):
    filter = hg.linear_filter(plant, sensor, channel, encoder=encoder)
    return hg.Network(plant, {"a": hg.Node(sensor, channel, {"linear": filter}, encoder=encoder)})


def two_paths():
    """One word over two paths behind a common hop: flips are not common, rounding and the common hop are."""
    links = [hg.decode_and_forward([0.02]), hg.decode_and_forward([0.05])]
    return hg.random_affine.Series([hg.decode_and_forward([0.01]), hg.random_affine.Stack(links)])


FADING = hg.decode_and_forward([0.004, hg.Discrete([0.0, 0.15], [0.8, 0.2])])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("encoder", "channel"),
    [
        (words(8, "subtracted"), hg.decode_and_forward([0.004, 0.006])),
        (words(4, "stochastic"), hg.decode_and_forward([0.01])),
        (words(3, "triangular"), hg.decode_and_forward([0.0])),
        (words(4, "subtracted"), FADING),
        (words(5, "subtracted"), two_paths()),
        (words(8, "none", 6.5), hg.model.delayed(hg.decode_and_forward([0.01]), 2)),
    ],
)
def test_claims_hold_of_true_bits(encoder, channel):
    network = world(encoder, channel)
    errors = hg.monte_carlo(network, 40, 20_000, 3, keep=hg.Statistics())["a"]["linear"]
    assert network.claims()["a"]["linear"] in ("exact", "upper")
    nees, low, high = errors.nees_per_dimension(0.999)
    assert low < 1 < high, nees


def told():
    """Error rates of a mode that is told."""
    chain = hg.random_affine.MarkovChain([[0.95, 0.05], [0.2, 0.8]])
    links = [hg.decode_and_forward([0.001]), hg.decode_and_forward([0.1])]
    return hg.model.with_flag(hg.random_affine.Modes(chain, links))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dither", "claim"), [("subtracted", "exact"), ("triangular", "exact"), ("stochastic", "upper")]
)
def test_claims_hold_of_modes_that_are_told(dither, claim):
    """The dither is taken off by the gain of the mode; a filter of modes bounds that of stochastic rounding."""
    network = world(words(3, dither, 6.6), told())
    errors = hg.monte_carlo(network, 40, 20_000, 3, keep=hg.Statistics())["a"]["linear"]
    assert network.claims()["a"]["linear"] == claim
    nees, low, high = errors.nees_per_dimension(0.999)
    assert low < 1 < high or (claim == "upper" and nees < 1), nees


def test_words_whose_dither_cannot_be_taken_off_are_not_used():
    """Nobody told the mode, on which the gain depends."""
    filter = hg.linear_filter(PLANT, SENSOR, told(), encoder=words(5, "subtracted"))
    assert filter.received == 3
    z = np.array([[words(5, "subtracted").low, np.nan, 0.1]])
    assert filter.run(z).covariances[0, 0, 0] == pytest.approx(A**2 * X + Q, rel=1e-12)


@pytest.mark.slow
def test_claims_hold_of_several_components_and_one_fade_for_a_message():
    plant = hg.LinearPlant([[0.9, 0.2], [-0.1, 0.8]], [[0.1, 0.02], [0.02, 0.2]], [0.5, 0.0], np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0], [0.3, 1.0]], [[0.05, 0.02], [0.02, 0.08]])
    encoder = hg.Words(bits=5, low=[-6.0, -8.0], high=[7.0, 8.0], dither="subtracted")
    law = hg.Discrete([0.0, 0.2], [0.7, 0.3])
    claims = []
    for per_message in (True, False):
        channel = hg.decode_and_forward([law], dimension=2, per_message=per_message)
        errors = hg.monte_carlo(world(encoder, channel, sensor, plant), 40, 20_000, 3, keep=hg.Statistics())
        nees, low, high = errors["a"]["linear"].nees_per_dimension(0.999)
        assert low < 1 < high, (per_message, nees)
        claims.append(errors["a"]["linear"].mean_trace())
    assert claims[0] != pytest.approx(claims[1], rel=1e-4)  # the fade of a message is not that of each word


def test_a_range_that_is_overloaded_is_refused_with_the_bound():
    with pytest.raises(ValueError, match=r"range of the words: .*1000 steps.*0\.0\d+ a step; the claim may be off by"):
        hg.linear_filter(PLANT, SENSOR, hg.decode_and_forward([0.0]), encoder=words(8, "none", 2.0))
    filter = hg.linear_filter(PLANT, SENSOR, hg.decode_and_forward([0.0]), encoder=words(8, "none", 4.0))
    assert filter.claim == "nominal"  # bound 1.3 %
    assert float(filter.overload.bound) == pytest.approx(0.013, abs=5e-4)
    assert float(filter.overload.probability[0]) == pytest.approx(6e-5, rel=0.1)


def test_records_and_reports_say_what_check_says_of_overload():
    encoder = words(8, "none", 4.0)
    network = world(encoder, hg.decode_and_forward([0.0]))
    record = hg.run(network, {"a": hg.simulate(network, 30, 1).measurements["a"]})
    overload = record.overloads["a"]["linear"]
    assert float(overload.bound) == pytest.approx(0.013, abs=5e-4)
    health = report.examine(network, record)
    page = re.sub("<[^>]*>", "", report.run_page(health, "words", {}).html())
    share = float(overload.probability[0])
    assert f"are overloaded in at most {share:.2g} of the steps" in page
    assert "differs from its claim by at most 1.3%" in page
    assert report.run_summary(health)["overloads"]["a"]["linear"]["bound"] == float(overload.bound)


def test_what_a_filter_of_words_cannot_know_is_refused():
    flips, encoder = hg.decode_and_forward([0.01]), words(5, "subtracted")
    with pytest.raises(ValueError, match="words pass, which are not amplified"):
        hg.linear_filter(PLANT, SENSOR, hg.hop(2.0, 0.1), encoder=encoder)
    with pytest.raises(ValueError, match="encoder of the words"):
        hg.linear_filter(PLANT, SENSOR, flips)
    with pytest.raises(ValueError, match="without resolution"):
        hg.linear_filter(PLANT, hg.LinearSensor([[1.0]], [[R]], resolution=0.1), flips, encoder=encoder)
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.5, 0.5]])
    modes = hg.random_affine.Modes(chain, [flips, hg.decode_and_forward([0.2])])
    with pytest.raises(ValueError, match="triangular"):
        hg.linear_filter(PLANT, SENSOR, modes, encoder=encoder)


def test_a_filter_that_believes_another_encoder_claims_nothing_exact():
    channel = hg.decode_and_forward([0.01])
    filter = hg.linear_filter(PLANT, SENSOR, channel, encoder=words(5, "triangular"))
    node = hg.Node(SENSOR, channel, {"linear": filter}, encoder=words(6, "triangular"))
    network = hg.Network(PLANT, {"a": node})
    assert network.claims() == {"a": {"linear": "nominal"}}
    assert "encoder" in str(network.beliefs()[0].words)


def test_a_sensor_of_finite_resolution_is_what_every_filter_sees():
    fine, coarse = (hg.LinearSensor([[1.0]], [[R]], resolution=d) for d in (0.2, 0.5))
    filter = hg.kalman_filter(PLANT, fine)
    assert filter.claim == "exact"  # the noise's deviation is more than a step
    assert np.allclose(fine.noise.covariance, R + 0.2**2 / 12, rtol=1e-15)
    assert hg.kalman_filter(PLANT, coarse).claim == "nominal"
    network = hg.Network(PLANT, {"a": hg.Node(coarse, hg.perfect(), {"f": hg.kalman_filter(PLANT, coarse)})})
    z = hg.simulate(network, 20, 1).measurements["a"]
    assert np.allclose(z / 0.5, np.round(z / 0.5), atol=1e-12)
    assert np.ptp(z) > 1
