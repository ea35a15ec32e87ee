"""What an estimate claims: nothing where it is no number, or where its covariance is none."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.model import Estimate
from tests.losing import Losing

MEAN = np.zeros((4, 2))
COVARIANCE = np.array([np.eye(2), np.full((2, 2), np.nan), np.diag([1.0, -1.0]), np.diag([1.0, 0.0])])


@pytest.mark.parametrize("claim", ["exact", "upper", "nominal"])
def test_a_claim_holds_where_mean_and_covariance_are_numbers(claim):
    result = Estimate(MEAN, COVARIANCE, claim)
    assert result.claims.tolist() == [claim, "none", "none", claim]
    lost = Estimate(np.where([[True], [False], [False], [False]], np.nan, MEAN), COVARIANCE, claim)
    assert lost.claims.tolist() == ["none", "none", "none", claim]
    alone = [Estimate(m, p, claim).claims for m, p in zip(MEAN, COVARIANCE, strict=True)]
    assert alone == list(result.claims)  # a stream's claim is lowered so, below


def test_covariances_that_repeat_are_judged_as_each_by_itself():
    """As of a long recording: most are the one before, few are not, and some of these are none."""
    rng = np.random.default_rng(0)
    which = np.where(rng.random(3_000) < 0.9, 0, rng.integers(4, size=3_000))
    which[[1_500, -1]] = 0  # of equal ends
    of_rows = Estimate(np.zeros((3_000, 2)), COVARIANCE[which], "exact").claims
    assert of_rows.tolist() == Estimate(MEAN, COVARIANCE, "exact").claims[which].tolist()


def test_of_no_covariance_nothing_is_claimed():
    assert Estimate(MEAN, COVARIANCE, "none").claims.tolist() == ["none"] * 4


def losing():
    """A network whose one filter claims a covariance that is none from its third step on."""
    plant = hg.LinearPlant([[1, 1], [0, 1]], 1e-9, [0.0, 0.0], 1.0, states=("p", "v"))
    sensor = hg.LinearSensor([[1, 0]], 1.0)
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": losing_filter(plant, sensor)})})


@hg.filters.believes
def losing_filter(plant, sensor):
    return Losing(claim="exact")


def test_a_record_says_of_each_row_what_is_claimed():
    record = hg.monte_carlo(losing(), 4, 3, 1)
    result = record.estimates["a"]["f"]
    np.testing.assert_array_equal(result.claims, [["exact", "exact", "none", "none"]] * 3)
    assert record.failures()


def test_a_table_of_statistics_claims_nothing_of_what_failed():
    with pytest.warns(UserWarning, match="no valid covariance"):
        frame = hg.monte_carlo(losing(), 4, 64, 1, keep=hg.Statistics()).to_pandas()
        hg.monte_carlo(losing(), 4, 64, 1, keep=hg.Statistics())["a"]["f"].rmse()
    assert frame["claim"].tolist() == ["none"]


def test_digits_that_a_prior_takes_leave_a_covariance_that_is_no_less_than_the_error():
    """Two states tied to the last digit by a prior of 1e14: the second position leaves rounding, claimed as such."""
    plant = hg.LinearPlant([[1, 1], [0, 1]], 1e-9, [0.0, 0.0], 1e14)
    sensor = hg.LinearSensor([[1, 0]], 1e-14)
    item = hg.linear_filter(plant, sensor, hg.perfect())
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": item})}), 4, 200, 1)
    result = record.estimates["a"]["f"]
    assert (result.claims == "exact").all() and not record.failures()
    error = np.mean((record.truth - result.mean) ** 2, axis=0)  # (step, state)
    claimed = np.diagonal(result.covariance[0], axis1=-2, axis2=-1)
    assert (error <= 1.5 * claimed).all()  # 200 runs: a mean square is within .1 of its own, five times over


def test_a_live_estimate_whose_covariance_is_lost_claims_nothing():
    """Saved gains lose theirs where data are missing; the mean goes on, in a stream and in a timeline."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    item = hg.filters.scheduled_polynomial_filter(plant, sensor, hg.perfect(), 6, 1)
    stream, expected = hg.Stream(item), ["exact", "none", "none"]
    timeline = hg.Timeline(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": item})}), window=10.0)
    for k, (z, claim) in enumerate(zip((0.1, np.nan, 0.2), expected, strict=True)):
        assert stream.push([z]).claim == claim
        timeline.push("a", k, k, [z])
        result = timeline.estimates()["a"]["f"]
        assert result.claim == claim and np.isfinite(result.mean).all()
    timeline.advance(100.0)
    assert timeline.final().estimates["a"]["f"].claims.tolist() == expected


@pytest.mark.parametrize("z", [[0.1], [np.nan]])
def test_a_live_prediction_whose_variance_is_negative_is_refused(z):
    """Whether anything arrived or not: its covariance would be lost, and the state before it stays."""
    stream = hg.Stream(Losing())
    assert [stream.push(z).claim for _ in range(2)] == ["nominal", "nominal"]
    for _ in range(2):
        with pytest.raises(ValueError, match="the prediction to its time is no finite number, its covariance is none"):
            stream.push(z)
    assert stream.steps == 2


class LosingByData(Losing):
    """A filter whose covariance is no number after a value beyond one."""

    def predict(self, state, u=(), k=0):
        return state

    def correct(self, state, z, k=0):
        after = jnp.where(jnp.abs(z[0]) > 1.0, jnp.nan, state)
        return after, hg.model.Innovation(z, jnp.eye(1), 0.0)


def test_a_measurement_that_would_lose_the_covariance_is_refused_live_and_the_claim_stays():
    stream = hg.Stream(LosingByData())
    before = stream.push([0.0])
    with pytest.raises(ValueError, match="with it the estimate is no number, or its covariance is none"):
        stream.push([2.0])
    assert stream.steps == 1 and before.claim == "nominal"
    assert stream.push([0.1]).claim == "nominal"
