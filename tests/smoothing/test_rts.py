"""The Rauch-Tung-Striebel smoother against the textbook's pass back."""

import equinox as eqx
import numpy as np
import pytest

import heliograph as hg

F, H = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[1.0, 0.0]])
Q, R = np.array([[0.1, 0.02], [0.02, 0.2]]), np.array([[0.4]])
PLANT, SENSOR = hg.state_space(F, H, Q, R, [0.3, -0.1], 0.5)
Z = np.random.default_rng(5).normal(size=25)
Z[[4, 11]] = np.nan


def test_it_is_the_textbooks_pass_back():
    item = hg.kalman_filter(PLANT, SENSOR)
    forward, result = item.run(Z), hg.rts_smoother(item, Z)
    x, P = forward.means.copy(), forward.covariances.copy()
    for k in range(len(Z) - 2, -1, -1):
        prior = F @ P[k] @ F.T + Q
        G = P[k] @ F.T @ np.linalg.inv(prior)
        x[k] = x[k] + G @ (x[k + 1] - F @ x[k])
        P[k] = P[k] + G @ (P[k + 1] - prior) @ G.T
    np.testing.assert_allclose(result.means, x, atol=1e-12)  # numbers of size one
    np.testing.assert_allclose(result.covariances, P, atol=1e-12)
    assert result.claim == "exact"


def test_what_cannot_be_smoothed_is_refused():
    with pytest.raises(ValueError, match="filter: expected a filter, such as kalman_filter"):
        hg.rts_smoother(PLANT, Z)
    with pytest.raises(ValueError, match="measurements: expected"):
        hg.rts_smoother(hg.kalman_filter(PLANT, SENSOR), np.zeros((3, 2)))


def test_one_row_is_smoothed_to_what_the_filter_says_and_none_is_refused():
    """Alone, and in the runs of a simulation."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    item = hg.kalman_filter(plant, sensor)
    result, forward = hg.rts_smoother(item, [0.3]), item.run([0.3])
    np.testing.assert_allclose(result.means, forward.means, rtol=1e-14)
    np.testing.assert_allclose(result.covariances, forward.covariances, rtol=1e-14)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": item})})
    record = hg.monte_carlo(network, 1, 3, 0, smooth=hg.smoothing.FixedInterval())
    for part in ("mean", "covariance"):
        both = (getattr(item.estimates["a"]["f"], part) for item in (record.smoothed, record))
        np.testing.assert_allclose(*both, rtol=1e-14)
    with pytest.raises(ValueError, match="measurements: expected at least one row, got none"):
        hg.rts_smoother(item, [])


class FadingMemory(hg.filters.AbstractFilter):
    """The Kalman filter of a plant whose covariance is enlarged before each prediction, which is nobody's model."""

    base: hg.filters.AbstractFilter
    claim: str = eqx.field(static=True, default="nominal")
    states: tuple = eqx.field(static=True, default=PLANT.states)
    inputs: tuple = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=1)

    @hg.filters.in_float64
    def init(self):
        return self.base.init()

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        return self.base.predict(state._replace(variances=1.1 * state.variances), u, k)

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        return self.base.correct(state, z, k)

    @hg.filters.estimates
    def estimate(self, state):
        within = self.base.estimate(state)
        return hg.model.Estimate(within.mean, within.covariance, self.claim)

    def smoother_step(self, step):
        return self.base.smoother_step(step)


@pytest.mark.parametrize("rows", [25, 5000])
def test_smoothing_claims_no_more_than_the_filter_around_another(rows):
    """Its smoother step is that of an exact filter, row by row and in chunks."""
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, hg.perfect(1), {})})
    z = hg.simulate(network, horizon=rows, key=6).measurements["node"]
    fading = FadingMemory(hg.kalman_filter(PLANT, SENSOR))
    assert hg.rts_smoother(fading.base, z).claim == "exact"
    assert hg.rts_smoother(fading, z).claim == "nominal"
