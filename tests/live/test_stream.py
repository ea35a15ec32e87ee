"""A stream has the numbers of `run`, at little cost; it refuses what is not its filter's, and stays as it was."""

import os
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from straightline.call_arrays import allocate_aligned

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], 0.1, [1.0, -1.0], 1.0, [[1.0], [0.0]], inputs=["push"])
SENSOR = hg.LinearSensor(np.eye(2), 0.5)
ROW = hg.LinearSensor([[1.0, 0.0]], 0.5)
PACKAGES = ("heliograph", "jax", "equinox")


class Remembering(hg.filters.AbstractFilter):
    """Its state is the measurement before, and its mean the sum of that one and the present one."""

    claim: str = eqx.field(static=True, default="none")
    states: tuple[str, ...] = eqx.field(static=True, default=tuple(f"x{i}" for i in range(8)))
    inputs: tuple[str, ...] = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=8)

    def init(self):
        return np.zeros((2, 8))

    def predict(self, state, u=(), k=0):
        return state

    def correct(self, state, z, k=0):
        return jnp.stack([state[1], z]), hg.model.Innovation(z, jnp.eye(8), 0.0)

    def estimate(self, state):
        return hg.model.Estimate(state[0] + state[1], jnp.full((8, 8), jnp.nan), self.claim)


REFUSED = [
    ([1.0], [0.0], r"measurement: expected 2 numbers, got shape \(1,\)"),
    (1.0, [0.0], r"measurement: expected 2 numbers, got shape \(\)"),
    ([1.0, 2.0, 3.0], [0.0], r"measurement: expected 2 numbers, got shape \(3,\)"),
    ([[1.0, 2.0]], [0.0], r"measurement: expected 2 numbers, got shape \(1, 2\)"),
    ([1.0, np.inf], [0.0], "measurement: expected numbers, or NaN for what is missing, got"),
    (None, [0.0], "measurement: expected 2 numbers, got None"),
    (["1", "2"], [0.0], r"measurement: expected 2 numbers, got \['1', '2'\]"),
    ([1j, 2.0], [0.0], "measurement: expected 2 numbers, got"),
    ([[1.0], [1.0, 2.0]], [0.0], "measurement: expected 2 numbers, got"),
    ([1.0, 2.0], (), r"inputs \['push'\]: expected 1 number, got none"),
    ([1.0, 2.0], [0.0, 1.0], r"inputs \['push'\]: expected 1 number, got shape \(2,\)"),
    ([1.0, 2.0], [np.nan], "inputs: expected finite numbers, got"),
    ([1.0, 2.0], [-np.inf], "inputs: expected finite numbers, got"),
    ([1.0, 2.0], "1", r"inputs \['push'\]: expected 1 number, got '1'"),
]


def filters():
    return {"kalman": hg.kalman_filter(PLANT, SENSOR), "linear": hg.linear_filter(PLANT, SENSOR, hg.perfect(2))}


@pytest.mark.parametrize("name", filters())
def test_what_does_not_fit_changes_nothing(name):
    stream, other = hg.Stream(filters()[name]), hg.Stream(filters()[name])
    for z, u, message in REFUSED:
        with pytest.raises(ValueError, match=message) as caught:
            stream.push(z, u)
        assert "\n" not in str(caught.value)
    assert stream.steps == 0
    for z in ([0.5, 1.0], [np.nan, 2.0], [None, 1.0], np.array([1, 2])):  # None did not arrive; whole numbers will do
        np.testing.assert_array_equal(stream.push(z, [0.3]).mean, other.push(z, 0.3).mean)


def test_a_filter_that_receives_nothing_takes_any_measurement():
    stream = hg.Stream(hg.filters.open_loop_filter(PLANT))
    for z in ([1.0], [1.0, 2.0], np.nan):
        stream.push(z, [0.0])
    with pytest.raises(ValueError, match="measurement: expected numbers, got None"):
        stream.push(None, [0.0])


def test_past_the_end_of_what_varies_it_stops():
    channels = hg.model.over_time([hg.hop(1.0, 0.1 * (k + 1), dimension=2) for k in range(3)])
    stream = hg.Stream(hg.linear_filter(PLANT, SENSOR, channels))
    for _ in range(3):
        last = stream.push([1.0, 0.0], [0.0])
    with pytest.raises(ValueError, match="step: expected one of the 3 that the filter covers, counted from 0, got 3"):
        stream.push([1.0, 0.0], [0.0])
    assert stream.steps == 3 and np.all(np.isfinite(last.mean))


def test_a_polynomial_filter_goes_on_only_in_its_steady_state():
    plant, sensor = hg.LinearPlant([[0.7]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.5)
    unsettled = hg.Stream(hg.polynomial_filter(plant, sensor, hg.hop(hg.Rayleigh(1.0), 0.1), 4))
    for _ in range(4):
        unsettled.push(1.0)
    with pytest.raises(ValueError, match="step: expected one of the 4"):
        unsettled.push(1.0)


def test_a_network_refuses_filters_that_do_not_fit_it():
    item = hg.kalman_filter(PLANT, SENSOR)
    with pytest.raises(
        ValueError, match="filter 'f': expected one that receives the 1 numbers that arrive, got one that"
    ):
        hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.5), hg.perfect(), {"f": item})
    still = hg.LinearPlant(PLANT.matrix, 0.1, [1.0, -1.0], 1.0)
    node = hg.Node(SENSOR, hg.perfect(2), {"f": item})
    with pytest.raises(ValueError, match="filter 'f' of node 'a': expected the plant's 0 inputs"):
        hg.Network(still, {"a": node})
    with pytest.raises(ValueError, match="fused 'all': expected one that receives the 4 numbers that arrive"):
        hg.Network(PLANT, {"a": node, "b": node}, {"all": item})
    hg.Network(PLANT, {"a": node, "b": node}, {"all": hg.filters.sequential_filter([item, item])})


def test_its_numbers_are_those_of_run():
    """Of order one, up to a hundred roundings: the compiler orders sums in each program as it likes."""
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.7), 0.1), hg.hop(hg.Discrete([0.8, 1.2], [0.4, 0.6], 0.1), 1)])
    items = {"row": hg.cubature_filter(PLANT, ROW, relay), "extended": hg.extended_filter(PLANT, ROW, relay)}
    rng = np.random.default_rng(0)
    z, u = rng.normal(size=(20, 1)), rng.normal(size=(20, 1))
    z[4] = np.nan
    known = hg.run(hg.Network(PLANT, {"n": hg.Node(ROW, relay, items)}), {"n": z}, u).estimates["n"]
    for name, item in items.items():
        stream = hg.Stream(item)
        for k in range(len(z)):
            estimate = stream.push(z[k], u[k])
            np.testing.assert_allclose(estimate.mean, known[name].mean[k], rtol=0, atol=1e-14)
            np.testing.assert_allclose(estimate.covariance, known[name].covariance[k], rtol=0, atol=1e-14)
            assert estimate.claim == known[name].claim


def test_a_sample_runs_little_python():
    """Calls of Python functions in a push, which is what it costs, as the step is compiled; not of shapes' checks."""
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event == "call" and any(f"{os.sep}{of}{os.sep}" in frame.f_code.co_filename for of in PACKAGES)

    stream = hg.Stream(hg.linear_filter(PLANT, SENSOR, hg.perfect(2)))
    stream.push([1.0, 0.0], [0.0])
    sys.setprofile(count)
    stream.push([1.0, 0.0], [0.0])
    sys.setprofile(None)
    assert calls <= 30, calls


def test_what_is_pushed_is_copied():
    """The caller may fill one array again and again."""
    stream, other = hg.Stream(Remembering()), hg.Stream(Remembering())
    z = allocate_aligned(8 * 8).view(float)  # as JAX would take it without a copy
    for k in range(4):
        z[:] = k
        known = stream.push(z).mean, other.push(np.full(8, float(k))).mean
        z[:] = np.nan
        np.testing.assert_array_equal(*known)


def test_streams_of_one_filter_share_what_they_do_not_change():
    item = hg.kalman_filter(PLANT, SENSOR)
    single, other = hg.Stream(item), hg.Stream(item)
    single.push([1.0, 2.0], [0.0])
    assert single._compiled is other._compiled
    np.testing.assert_array_equal(other.push([1.0, 2.0], [0.0]).mean, hg.Stream(item).push([1.0, 2.0], [0.0]).mean)


def test_what_is_no_filter_makes_no_stream():
    with pytest.raises(ValueError, match="stream: expected a filter, got LinearPlant"):
        hg.Stream(PLANT)


def test_a_stream_that_was_saved_goes_on_with_the_same_bits():
    filter_ = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
    z = np.random.default_rng(0).normal(size=(6, 2))
    item = hg.Stream(filter_)
    for row in z[:3]:
        item.push(row, [0.1])
    other = hg.Stream.restore(filter_, item.save())
    assert other.steps == 3
    for row in z[3:]:
        a, b = item.push(row, [0.1]), other.push(row, [0.1])
        assert np.array_equal(a.mean, b.mean) and np.array_equal(a.covariance, b.covariance)


def test_the_snapshot_of_another_filter_is_refused_with_what_differs():
    data = hg.Stream(hg.linear_filter(PLANT, SENSOR, hg.perfect(2))).save()
    same = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
    hg.Stream.restore(same, data)  # equal is the same
    for other, what in (
        (hg.linear_filter(PLANT, hg.LinearSensor(np.eye(2), 0.6), hg.perfect(2)), r"\(numbers: \w+\)"),
        (hg.linear_filter(PLANT, ROW, hg.perfect()), "numbers received: 1"),
        (hg.cubature_filter(PLANT, SENSOR, hg.perfect(2)), "filter: "),
    ):
        with pytest.raises(ValueError, match=what):
            hg.Stream.restore(other, data)
    with pytest.raises(ValueError, match="what save returned"):
        hg.Stream.restore(same, data[:-9])
