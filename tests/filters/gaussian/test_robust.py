"""Robust filters: exact moments of one component, limits, missing values, units, random gains, and in runs."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import heliograph as hg
from tests.follow import follow

RULES = [
    None,
    hg.filters.Huber(),
    hg.filters.InverseMultiquadric(),
    hg.filters.WoLF(1.3),
    hg.filters.Gate(),
    hg.filters.StudentVB(),
]
A = np.eye(4) + 0.1 * np.eye(4, k=2)
PLANT = hg.LinearPlant(A, 0.1 * np.eye(4), [0.0, 0.0, 1.0, 1.0], np.eye(4))
C = np.eye(2, 4)
OUTLIERS = hg.Contaminated(np.eye(2), 0.05, 100 * np.eye(2))


def law_of(rule, scale=1.0):
    return hg.StudentT(scale * np.eye(2), 3.0) if isinstance(rule, hg.filters.StudentVB) else hg.Contaminated(
        scale * np.eye(2), 0.05, 100 * scale * np.eye(2)
    )  # fmt: skip


def robust(rule=None, law=None, channel=None, plant=PLANT, output=C):
    sensor = hg.LinearSensor(output, law_of(rule) if law is None else law)
    return hg.robust_filter(plant, sensor, hg.perfect(len(output)) if channel is None else channel, rule)


@pytest.mark.parametrize("law", [hg.Contaminated(0.5, 0.2, 8.0, 1.5), hg.StudentT(0.5, 3.0)])
@pytest.mark.parametrize("z", [0.2, 3.0, -6.0])
def test_the_score_has_the_exact_moments_of_one_component(law, z):
    """Against numerical integration over x: 1e-8 for Gaussian branches; 0.03 deviations for 25 of Student's density."""
    plant = hg.LinearPlant([[1.0]], [[0.0]], [0.3], [[2.0]])
    item = hg.robust_filter(plant, hg.LinearSensor([[1.0]], law), hg.perfect(1))
    state, innovation = item.correct(item.init(), [z])
    exact = isinstance(law, hg.Contaminated)

    def normal(x, mean, variance):
        return math.exp(-((x - mean) ** 2) / (2 * variance)) / math.sqrt(2 * math.pi * variance)

    def noise(v):
        if not exact:  # Student's density of three degrees of freedom
            return 2 / (math.pi * math.sqrt(3 * 0.5) * (1 + v**2 / (3 * 0.5)) ** 2)
        return 0.8 * normal(v, 0, 0.5) + 0.2 * normal(v, 1.5, 8.0)

    def moment(f):
        return integrate.quad(lambda x: f(x) * normal(x, 0.3, 2.0) * noise(z - x), -12, 13, epsabs=1e-13, limit=200)[0]

    whole = moment(lambda x: 1.0)
    mean = moment(lambda x: x) / whole
    variance = moment(lambda x: (x - mean) ** 2) / whole
    tolerance = 1e-8 if exact else 0.03
    assert state.mean[0] == pytest.approx(mean, abs=tolerance)
    assert state.covariance[0, 0] == pytest.approx(variance, abs=tolerance)
    assert innovation.log_likelihood == pytest.approx(np.log(whole), abs=tolerance)


@pytest.mark.parametrize(
    "item",
    [
        robust(law=hg.Contaminated(np.eye(2), 0.0, 100 * np.eye(2))),
        robust(hg.filters.Huber(1e9)),
        robust(hg.filters.InverseMultiquadric(1e9)),
        robust(hg.filters.WoLF(1e9)),
        robust(hg.filters.Gate(1e18)),
        robust(hg.filters.StudentVB(), hg.StudentT(np.eye(2), 1e12)),
        robust(law=hg.Gaussian(np.eye(2))),
    ],
)
def test_without_outliers_each_is_the_plain_filter(item):
    """1e-9: of c = 1e9 the weights are 1 to 1e-18, of nu = 1e12 to 1e-12."""
    z = np.random.default_rng(0).normal(size=(12, 2))
    z[3, 0] = z[5] = np.nan
    plain = hg.kalman_filter(PLANT, hg.LinearSensor(C, np.eye(2)))
    ours, theirs = follow(item, z), follow(plain, z)
    np.testing.assert_allclose(ours.mean, theirs.mean, atol=1e-9)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, atol=1e-9)


@pytest.mark.parametrize("rule", RULES)
def test_no_single_value_takes_the_estimate_far(rule):
    """One reading of -999 takes the plain filter by hundreds, no robust one far."""
    z = np.random.default_rng(1).normal(size=(20, 2))
    z[10] = -999.0
    plain = follow(hg.kalman_filter(PLANT, hg.LinearSensor(C, np.eye(2))), z).mean
    mean = follow(robust(rule), z).mean
    assert np.abs(plain[10, :2] - plain[9, :2]).max() > 300
    assert np.abs(mean[10, :2] - mean[9, :2]).max() < (
        22 if rule is None or isinstance(rule, hg.filters.StudentVB) else 2
    )


@pytest.mark.parametrize("rule", [hg.filters.InverseMultiquadric(), hg.filters.WoLF(1.3), hg.filters.Gate()])
def test_an_infinitely_far_value_counts_as_missing(rule):
    item = robust(rule)
    state, innovation = item.correct(item.init(), [1e160, 0.2])
    other, _ = item.correct(item.init(), [np.nan, 0.2])
    np.testing.assert_allclose(state.mean, other.mean, rtol=1e-12)
    np.testing.assert_allclose(state.covariance, other.covariance, rtol=1e-12)
    assert innovation.weight[0] < 1e-200


@pytest.mark.parametrize("rule", RULES)
def test_nothing_that_arrives_changes_nothing(rule):
    item = robust(rule)
    state, innovation = item.correct(item.init(), [np.nan, np.nan])
    np.testing.assert_array_equal(state.covariance, item.init().covariance)
    np.testing.assert_array_equal(state.mean, item.init().mean)
    assert np.isnan(innovation.weight).all() and innovation.log_likelihood == 0


@pytest.mark.parametrize("rule", RULES)
def test_units_change_no_weight(rule):
    """Components in units of their own: weights agree to 1e-11, estimates too."""
    units, z = np.array([1e-6, 1e3]), np.array([4.0, -0.3])
    item = robust(rule)
    law = law_of(rule)
    scaled = np.diag(units**2)
    other_law = (
        hg.StudentT(scaled, 3.0) if isinstance(law, hg.StudentT) else hg.Contaminated(scaled, 0.05, 100 * scaled)
    )
    other = robust(rule, other_law, output=units[:, None] * C)
    (state, innovation), (again, same) = item.correct(item.init(), z), other.correct(other.init(), units * z)
    np.testing.assert_allclose(same.weight, innovation.weight, rtol=1e-11)
    np.testing.assert_allclose(again.mean, state.mean, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(again.covariance, state.covariance, rtol=1e-10, atol=1e-12)


def test_a_branch_before_a_random_gain_arrives_with_the_variance_that_draws_have():
    """z = g (y + v) + n: branch moments of 200,000 draws, 4 standard errors; without 2 Var(g) y m it is off by 30 %."""
    law = hg.Contaminated(0.5, 0.3, 1.0, 3.0)
    gain = hg.Rayleigh(np.sqrt(2 / np.pi))
    plant = hg.LinearPlant([[1.0]], [[0.0]], [2.0], [[1e-12]])
    item = hg.robust_filter(plant, hg.LinearSensor([[1.0]], law), hg.hop(gain, 0.1))
    before, sensed = item.predict_received(item.init(), 0)
    received = item.noise.find_branches(sensed)
    rng = np.random.default_rng(2)
    g = rng.rayleigh(np.sqrt(2 / np.pi), 200_000)
    for branch, (mean, variance) in enumerate([(0.0, 0.5), (3.0, 1.0)]):
        z = g * (2.0 + mean + np.sqrt(variance) * rng.normal(size=len(g))) + np.sqrt(0.1) * rng.normal(size=len(g))
        claimed = float(before.columns.diagonal[0] + received.variance[0, branch])
        assert z.mean() == pytest.approx(float(before.signal[0] + received.mean[0, branch]), abs=4 * z.std() / 447)
        assert z.var() == pytest.approx(claimed, abs=4 * np.std((z - z.mean()) ** 2) / 447)


@pytest.mark.parametrize(
    "transform", [hg.filters.Cubature(), hg.filters.Linearization(), hg.filters.Unscented(1.0, 0.0, 1.0)]
)
def test_every_transform_serves_a_nonlinear_sensor(transform):
    """Near linear (a state known to 1e-3) all agree with the linear filter to the curvature, some 1e-6."""
    plant = hg.LinearPlant(np.eye(2), np.zeros((2, 2)), [3.0, 4.0], 1e-6 * np.eye(2))
    law = hg.Contaminated(1e-6, 0.1, 1e-4)
    ranges = hg.Sensor(lambda x: jnp.hypot(x[0], x[1])[None], law)
    item = hg.robust_filter(plant, ranges, hg.perfect(1), None, transform)
    line = hg.robust_filter(plant, hg.LinearSensor([[0.6, 0.8]], law), hg.perfect(1))
    state, other = item.correct(item.init(), [5.003])[0], line.correct(line.init(), [5.003])[0]
    np.testing.assert_allclose(state.mean, other.mean, atol=2e-6)


def over(item, rows):
    """States of a filter after each row of one run."""

    def step(state, row):
        after, _ = item.correct(item.predict(state), row)
        return after, item.estimate(after)

    return jax.lax.scan(step, jax.tree.map(jax.numpy.asarray, item.init()), rows)[1]


def judged(item, truth, z, first=50):
    """Error of the place and NEES of all states over runs."""
    result = hg.simulation.over_runs(jax.tree_util.Partial(over, item), z)
    e = (truth - result.mean)[:, first:]
    nees = np.einsum("rti,rtij,rtj->rt", e, np.linalg.inv(result.covariance[:, first:]), e).mean() / e.shape[-1]
    return np.sqrt(np.mean(np.sum(e[..., :2] ** 2, axis=-1))), nees


def test_claims_are_what_is_proved():
    bound = hg.LinearSensor(C, hg.Contaminated.at_most(np.eye(2), 0.05, 100 * np.eye(2)))
    assert hg.kalman_filter(PLANT, bound).claim == "upper"
    assert hg.linear_filter(PLANT, bound, hg.hop(hg.Rayleigh(1.0), 0.5, dimension=2)).claim == "upper"
    assert hg.kalman_filter(PLANT, hg.LinearSensor(C, OUTLIERS)).claim == "exact"
    assert all(robust(rule).claim == "nominal" for rule in RULES)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: robust(law=hg.StudentT([[1.0, 0.5], [0.5, 1.0]], 3.0)), "independent components"),
        (lambda: robust(hg.filters.Huber(), np.zeros((2, 2))), "noise of the sensor"),
        (
            lambda: robust(hg.filters.Huber(), np.ones((2, 2))),
            "some in each combination of the received",
        ),
        (lambda: robust(hg.filters.StudentVB(), np.eye(2)), "StudentVB: expected noise of Student's law"),
        (lambda: robust("huber"), r"rule: expected one such as Huber\(1.345\)"),
        (lambda: hg.filters.Huber(0.0), "constant of Huber's rule: expected a positive number"),
        (
            lambda: hg.kalman_filter(PLANT, hg.LinearSensor(C, hg.StudentT(np.eye(2), 2.0))),
            "more than 2, below which",
        ),
        (lambda: robust(channel=hg.random_affine.known([[1.0, 1.0], [0.0, 1.0]])), "noise of one output"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
