"""A filter over rows of data: its estimates and innovations against its steps, one by one."""

import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas
import pytest

import heliograph as hg
from tests.follow import follow

PLANT, SENSOR = hg.state_space(
    [[1.0, 1.0], [0.0, 0.9]], [[1.0, 0.0], [0.0, 1.0]], 0.1, 0.5, [0.0, 0.0], 1.0, [[0.0], [1.0]]
)
RELAY = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1, dimension=2)
RNG = np.random.default_rng(3)
Z, U = RNG.normal(size=(20, 2)), RNG.normal(size=(20, 1))
Z[[3, 4, 4, 9], [0, 0, 1, 1]] = np.nan


@pytest.mark.parametrize("item", [hg.kalman_filter(PLANT, SENSOR), hg.linear_filter(PLANT, SENSOR, RELAY)])
def test_it_is_the_steps_of_the_filter(item):
    by_rows, by_steps = item.run(Z, U), follow(item, Z, U)
    close = dict(rtol=1e-12, atol=1e-12)  # numbers of size one, other orders of sums
    np.testing.assert_allclose(by_rows.means, by_steps.mean, **close)
    np.testing.assert_allclose(by_rows.covariances, by_steps.covariance, **close)
    np.testing.assert_allclose(by_rows.innovations, by_steps.innovation.value, **close)
    np.testing.assert_allclose(by_rows.innovation_covariances, by_steps.innovation.covariance, **close)
    np.testing.assert_allclose(by_rows.log_likelihood, hg.log_likelihood(item, Z, U), rtol=1e-12)
    assert np.isnan(by_rows.innovations).tolist() == np.isnan(Z).tolist()
    assert by_rows.claim == item.claim == "exact"


@pytest.mark.parametrize("make", [hg.kalman_filter, lambda plant, sensor: hg.linear_filter(plant, sensor, RELAY)])
def test_rows_and_steps_begin_with_the_same_digits(make):
    """The start of a linear filter is known: both factor it once, and compute the same from there on."""
    start = [[2.0, 0.7], [0.7, 0.3]]
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 0.9]], 0.1 * np.eye(2), [1.0, 0.0], start)
    item = make(plant, SENSOR)
    by_rows, state = item.run(Z), item.init()
    for k, z in enumerate(Z):
        state, estimate = item.step(state, z)
        np.testing.assert_array_equal(by_rows.means[k], estimate.mean)
        np.testing.assert_array_equal(by_rows.covariances[k], estimate.covariance)


class Traced(hg.filters.AbstractFilter):
    """A filter around another, which notes each time that its correction is traced."""

    base: hg.filters.AbstractFilter
    noted: list = eqx.field(static=True)
    claim: str = eqx.field(static=True, default="exact")
    states: tuple = eqx.field(static=True, default=PLANT.states)
    inputs: tuple = eqx.field(static=True, default=PLANT.inputs)
    received: int = eqx.field(static=True, default=2)

    def init(self):
        return self.base.init()

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        return self.base.predict(state, u, k)

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        self.noted.append(k)
        return self.base.correct(state, z, k)

    def estimate(self, state):
        return self.base.estimate(state)


class Notes(list):
    """Notes that a filter may hold as a part that is no array: known by what they are, not by what stands in them."""

    __hash__, __eq__ = object.__hash__, object.__eq__


def test_a_step_is_traced_once_for_recordings_of_any_length_and_alone():
    item = Traced(hg.linear_filter(PLANT, SENSOR, RELAY), Notes())
    item.run(Z, U)
    item.run(Z[:5], U[:5])
    state, _ = item.step(item.init(), Z[0], U[0])
    assert len(item.noted) == 1
    np.testing.assert_allclose(item.estimate(state).mean, item.run(Z, U).means[0], rtol=1e-13)  # another program


class Compiled(Traced):
    """A filter that also notes each time that its estimate is traced: once for each program that is compiled of it."""

    def estimate(self, state):
        self.noted.append(state)
        return self.base.estimate(state)


class Started(Traced):
    """A filter that also notes each time that its start is traced."""

    def init(self):
        self.noted.append("init")
        return self.base.init()


@pytest.mark.parametrize("make", [hg.linear_filter, hg.cubature_filter])
def test_recordings_of_any_length_share_one_program(make, monkeypatch):
    """The rows of a shorter one are the first of a longer one, bit for bit; rows behind others have a program too."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    item = Compiled(make(PLANT, SENSOR, RELAY), Notes())
    whole, compiled = item.run(Z, U), len(item.noted)
    for rows in (1, 2, 13, 19):
        part = item.run(Z[:rows], U[:rows])
        np.testing.assert_array_equal(part.means, whole.means[:rows])
        np.testing.assert_array_equal(part.covariances, whole.covariances[:rows])
    assert len(item.noted) == compiled
    for rows in (1, 2, 13):
        behind = item.run(Z[rows:], U[rows:], after=item.run(Z[:rows], U[:rows]))
        np.testing.assert_array_equal(behind.means, whole.means[rows:])
    assert len(item.noted) == compiled + 1


def whiten(item, z, u):
    return hg.simulation.whitened_innovations(z, item, u)


@pytest.mark.parametrize("function", [hg.log_likelihood, whiten, hg.forecasting.predict_rows])
def test_what_is_computed_of_rows_has_one_program_for_any_number_of_them(function, monkeypatch):
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    item = Started(hg.linear_filter(PLANT, SENSOR, RELAY), Notes())
    function(item, Z, U)
    compiled = len(item.noted)
    for rows in (1, 2, 13):
        function(item, Z[:rows], U[:rows])
    assert len(item.noted) == compiled


def test_a_log_likelihood_is_the_sum_of_those_of_rows():
    item = hg.linear_filter(PLANT, SENSOR, RELAY)
    for rows in (1, 2, 13, 20):
        assert hg.log_likelihood(item, Z[:rows], U[:rows]) == item.run(Z[:rows], U[:rows]).log_likelihood


def test_native_code_computes_it(monkeypatch):
    """If it did not, the forced engine would say why."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    assert len(hg.cubature_filter(PLANT, SENSOR, RELAY).run(Z, U).means) == len(Z)


def test_rows_of_one_number_need_no_second_axis():
    plant, sensor = hg.state_space([[0.9]], [[1.0]], 1.0, 1.0, [0.0], 1.0)
    item = hg.kalman_filter(plant, sensor)
    assert np.array_equal(item.run(Z[:, 0]).means, item.run(Z[:, :1]).means)
    assert item.run([1.0, np.nan, 2]).means.shape == (3, 1)
    assert item.run(np.zeros(0)).means.shape == (0, 1) and item.run(np.zeros(0)).log_likelihood == 0


@pytest.mark.parametrize(
    ("z", "u", "words"),
    [
        (np.zeros((4, 3)), np.zeros((4, 1)), "measurements: expected"),
        (np.zeros((4, 2)), np.zeros((3, 1)), "inputs"),
        (np.zeros((4, 2)), None, "inputs: expected shape .* got none"),
        (np.full((4, 2), np.inf), np.zeros((4, 1)), "finite"),
        ("junk", np.zeros((4, 1)), "numbers"),
    ],
)
def test_what_does_not_fit_is_refused(z, u, words):
    with pytest.raises(ValueError, match=words):
        hg.kalman_filter(PLANT, SENSOR).run(z, u)


def test_a_matrix_that_does_not_fit_is_named():
    with pytest.raises(ValueError, match="sensor: expected to measure a state of length 2, got a matrix of shape"):
        hg.state_space(np.eye(2), [[1.0]], 1.0, 1.0, [0.0, 0.0], 1.0)


def test_likelihoods_are_differentiated_through_the_same_scan():
    def value(q):
        plant, sensor = hg.state_space([[0.9]], [[1.0]], q, 1.0, [0.0], 1.0)
        return hg.log_likelihood(hg.kalman_filter(plant, sensor), Z[:, 0])

    with jax.enable_x64(True):
        slope = jax.jit(jax.grad(value))(jnp.asarray(0.5))
    assert slope == pytest.approx((value(0.5 + 1e-5) - value(0.5 - 1e-5)) / 2e-5, rel=1e-7)  # central difference


def test_a_table_without_rows_gives_none():
    table = pandas.DataFrame({"y0": [], "y1": []}, index=pandas.DatetimeIndex([]))
    item = hg.kalman_filter(*hg.state_space(np.eye(2), np.eye(2), 0.1, 0.5, [0.0, 0.0], 1.0))
    assert item.run(table).means.shape == (0, 2)


AUTONOMOUS = hg.LinearPlant(PLANT.matrix, 0.1, [0.0, 0.0], 1.0)


@pytest.mark.parametrize("item", [hg.kalman_filter(AUTONOMOUS, SENSOR), hg.linear_filter(AUTONOMOUS, SENSOR, RELAY)])
def test_steps_of_a_linear_filter_have_the_bits_of_its_run(item):
    """Both are computed by one code, for any number of rows."""
    run, state = item.run(Z), item.init()
    for k, z in enumerate(Z):
        state, estimate = item.step(state, z, k=k)
        np.testing.assert_array_equal(estimate.mean, run.means[k])
        np.testing.assert_array_equal(estimate.covariance, run.covariances[k])


def test_a_first_step_after_a_run_traces_nothing():
    """A first step that is compiled calls some 150,000 functions, for a filter of four states; here some 2,000."""
    item, calls = hg.linear_filter(AUTONOMOUS, hg.LinearSensor([[1.0, 0.3]], 0.2), hg.hop(hg.Rayleigh(0.8), 0.3)), 0

    def count(*event):
        nonlocal calls
        calls += 1

    item.run(Z[:, :1])
    state = item.init()
    sys.setprofile(count)
    try:
        item.step(state, Z[0, :1])
    finally:
        sys.setprofile(None)
    assert calls < 20_000
