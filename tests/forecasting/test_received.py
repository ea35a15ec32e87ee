"""What is forecast to be measured and to arrive, by filters that are told, or learn, what a message went through."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.95]], 0.2, [5.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.3)
RAYLEIGH = hg.Rayleigh(0.8)
DECLARED = {"about": ["variance"], "typical": [2.0]}


def noisy(numbers):
    return hg.hop(1.0, numbers * jnp.eye(1))


@pytest.mark.parametrize("build", [hg.linear_filter, hg.extended_filter])
def test_a_gain_that_will_be_told_has_its_law_ahead(build):
    """Var z = E[g^2] (E[x^2] + R) - E[g]^2 (E[x^2] - P) + r, and the mean E[g] times that of x.

    E[x^2] is given the data, but before any data in the best linear filter, whose covariances depend on none.
    """
    found = build(PLANT, SENSOR, hg.hop(RAYLEIGH, 0.1, known=True)).run([[4.0, 0.9], [5.0, 1.1]])
    ahead = hg.forecast(found, 3)
    x, P = ahead.states.mean[:, 0], ahead.states.covariance[:, 0, 0]
    mean, square = RAYLEIGH.moment(1), RAYLEIGH.moment(2)
    np.testing.assert_allclose(ahead.received.mean[:, 0], mean * x, rtol=1e-12)
    power = P + x**2
    if build is hg.linear_filter:
        powers = [26.0]
        for _ in range(5):
            powers.append(0.95**2 * powers[-1] + 0.2)
        power = np.array(powers[3:])
    variance = square * (power + 0.3) - mean**2 * (power - P) + 0.1
    np.testing.assert_allclose(ahead.received.covariance[:, 0, 0], variance, rtol=1e-12)
    assert np.isnan(ahead.received.mean[:, 1]).all() and ahead.received.claim == "exact"


def test_limits_of_a_state_do_not_hide_that_its_gain_will_be_told():
    """Far within its limits a state has the forecast of one without them."""
    link, rows = hg.hop(RAYLEIGH, 0.1, known=True), [[4.0, 0.9], [5.0, 1.1]]
    limited = hg.LinearPlant([[0.95]], 0.2, [5.0], 1.0, limits={"x0": (-100.0, None)})
    found, plain = (hg.forecast(hg.extended_filter(p, SENSOR, link).run(rows), 2).received for p in (limited, PLANT))
    np.testing.assert_allclose(found.mean[:, 0], plain.mean[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found.covariance[:, 0, 0], plain.covariance[:, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("build", [hg.linear_filter, hg.extended_filter])
def test_inputs_of_a_sensor_do_not_hide_that_its_gain_will_be_told(build):
    plant = hg.LinearPlant([[0.95]], 0.2, [5.0], 1.0, [[0.0]], inputs=["on"])
    scaled = hg.LinearSensor(lambda u: u[0] * jnp.eye(1), 0.3, ["y0"], inputs=["on"])
    link, rows, inputs = hg.hop(RAYLEIGH, 0.1, known=True), [[4.0, 0.9], [5.0, 1.1]], np.ones((2, 1))
    found, plain = (
        hg.forecast(build(plant, sensor, link).run(rows, inputs), 2, inputs).received for sensor in (scaled, SENSOR)
    )
    np.testing.assert_allclose(found.mean[:, 0], plain.mean[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found.covariance[:, 0, 0], plain.covariance[:, 0, 0], rtol=1e-12)


def test_a_variance_that_will_be_declared_has_its_law_or_is_typical():
    variances = {}
    for law in (hg.Discrete([1.0, 3.0], [0.25, 0.75]), None):
        link = hg.model.told(noisy, law=law, **DECLARED)
        ahead = hg.forecast(hg.linear_filter(PLANT, SENSOR, link).run([[4.0, 1.0], [5.0, 3.0]]), 1)
        variances[ahead.received.claim] = ahead.received.covariance[0, 0, 0] - ahead.states.covariance[0, 0, 0] - 0.3
    assert variances == {"exact": pytest.approx(2.5, rel=1e-12), "nominal": pytest.approx(2.0, rel=1e-12)}


@pytest.mark.slow
def test_what_is_forecast_behind_a_pilot_is_what_comes():
    """Squared errors over their claim, of 1,500 runs; Rayleigh gains make them vary by 1.6, so 5 standard errors."""
    link = hg.hop(RAYLEIGH, 0.1, known=hg.model.Pilot(0.1))
    filter = hg.linear_filter(PLANT, SENSOR, link)
    z = hg.monte_carlo(hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": filter})}), 3, 1500, 0).measurements["a"]
    streams = [hg.Stream(filter) for _ in z]
    for stream, rows in zip(streams, z, strict=True):
        stream.push(rows[0])
        stream.push(rows[1])
    received = hg.forecast(streams, 1).received
    squares = (z[:, 2, 0] - received.mean[:, 0, 0]) ** 2 / received.covariance[:, 0, 0, 0]
    assert np.mean(squares) == pytest.approx(1, abs=5 * 1.6 / np.sqrt(1500))


def test_outputs_have_the_noise_that_was_learned():
    """A sensor a hundred times as noisy as it was said: what it will measure is what will arrive."""
    z = 5 * 0.95 ** np.arange(300) + np.sqrt(30) * np.random.default_rng(0).normal(size=300)
    filter = hg.adaptive_filter(hg.kalman_filter(PLANT, SENSOR), memory=1.0)
    ahead = hg.forecast(filter.run(z), 2)
    np.testing.assert_allclose(ahead.outputs.covariance, ahead.received.covariance, rtol=1e-12)
    assert ahead.outputs.deviation[0, 0] > 4
    drawn = hg.forecasting.draw_paths(filter.run(z), 2, draws=4000).y[:, :, 0]
    np.testing.assert_allclose(drawn.std(axis=0), ahead.outputs.deviation[:, 0], rtol=5 / np.sqrt(8000))
    # Of the other output nothing is learned where only the first arrives.
    both = hg.LinearSensor([[1.0], [2.0]], np.diag([0.3, 0.7]))
    link = hg.random_affine.known([[1.0, 0.0]])
    ahead = hg.forecast(hg.adaptive_filter(hg.extended_filter(PLANT, both, link)).run(z), 1)
    P = ahead.states.covariance[0, 0, 0]
    assert ahead.outputs.covariance[0, 1, 1] == pytest.approx(4 * P + 0.7, rel=1e-12)
    assert ahead.outputs.covariance[0, 0, 0] > P + 10


@pytest.mark.parametrize("degrees", [2.0, 1.5, 1.0])
def test_noise_without_variance_is_used_and_its_forecast_has_no_end(degrees):
    """Student's law of two degrees is no special case: between those of a little less and a little more."""
    z = np.array([0.5, 0.7, 40.0, 0.3])

    def run(nu):
        sensor = hg.LinearSensor([[1.0]], hg.StudentT(1.0, nu))
        return hg.robust_filter(PLANT, sensor, hg.perfect()).run(z)

    found, near = run(degrees), run(degrees + 1e-6)
    np.testing.assert_allclose(found.means, near.means, rtol=1e-5)
    np.testing.assert_allclose(found.covariances, near.covariances, rtol=1e-5)
    ahead = hg.forecast(found, 2)
    for predicted in (ahead.outputs, ahead.received):
        assert np.isinf(predicted.deviation).all() and np.isnan(predicted.below(0.0)).all()
    assert np.isfinite(ahead.states.deviation).all()
