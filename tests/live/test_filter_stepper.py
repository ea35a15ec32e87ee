"""Streams stepped by native code and by XLA have the same numbers, refuse the same, and share snapshots."""

import pickle

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import betainc

import heliograph as hg
from heliograph.live.filter_stepper import NativeFilterStepper, XlaFilterStepper

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], 0.1, [1.0, -1.0], 1.0, [[1.0], [0.0]], inputs=["push"])
SENSOR = hg.LinearSensor(np.eye(2), 0.5)
RELAY = hg.hop(hg.Rayleigh(0.7), 0.1, dimension=2)
ACCURACY = 1e-12  # of the claimed deviation: a hundred roundings of a step of some hundred operations


class Exchanging(hg.filters.AbstractFilter):
    """A filter whose state's numbers change places, and which counts its steps."""

    claim: str = eqx.field(static=True, default="none")
    states: tuple[str, ...] = eqx.field(static=True, default=("x",))
    inputs: tuple[str, ...] = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=1)

    def init(self):
        return np.array([1.0, 2.0]), np.array(3.0), np.array(4.0), np.array(0)

    def predict(self, state, u=(), k=0):
        pair, a, b, count = state
        return jnp.asarray(pair)[::-1], b, a, count + 1

    def correct(self, state, z, k=0):
        return state, hg.model.Innovation(z, jnp.eye(1), 0.0)

    def estimate(self, state):
        pair, a, _, count = state
        return hg.model.Estimate((pair[0] + 10 * a + 100 * count)[None], jnp.full((1, 1), jnp.nan), self.claim)


def filters():
    return {
        "kalman": hg.kalman_filter(PLANT, SENSOR),
        "linear": hg.linear_filter(PLANT, SENSOR, RELAY),
        "cubature": hg.cubature_filter(PLANT, SENSOR, RELAY),
        "extended": hg.extended_filter(PLANT, SENSOR, RELAY),
        "no measurement": hg.filters.open_loop_filter(PLANT),
    }


def stream_of(item, engine, monkeypatch, *arguments):
    monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
    stream = hg.Stream(item, *arguments)
    assert isinstance(stream._stepper, NativeFilterStepper if engine == "native" else XlaFilterStepper)
    return stream


def rows(count=30):
    rng = np.random.default_rng(1)
    z = rng.normal(size=(count, 2))
    z[3], z[7, 0] = np.nan, np.nan
    return z, rng.normal(size=(count, 1))


@pytest.mark.slow
@pytest.mark.parametrize("name", filters())
def test_both_engines_have_the_same_numbers(name, monkeypatch):
    item = filters()[name]
    native, xla = (stream_of(item, engine, monkeypatch) for engine in ("native", "xla"))
    for z, u in zip(*rows(), strict=True):
        a, b = native.push(z, u), xla.push(z, u)
        assert a.claim == b.claim
        deviation = np.sqrt(np.diagonal(b.covariance))
        assert np.all(np.abs(a.mean - b.mean) <= ACCURACY * deviation)
        assert np.all(np.abs(a.covariance - b.covariance) <= ACCURACY * np.outer(deviation, deviation))


@pytest.mark.parametrize("engine", ["native", "xla"])
def test_what_is_refused_leaves_the_state_bit_for_bit(engine, monkeypatch):
    """Infinite, not there, or implausible: each in the same words by both engines."""
    item = hg.kalman_filter(PLANT, SENSOR)
    stream, other = stream_of(item, engine, monkeypatch), stream_of(item, engine, monkeypatch)
    for k in range(2):
        stream.push([0.5, k], [0.1])
        other.push([0.5, k], [0.1])
    before = stream._stepper.state
    for z, u, message in (
        (np.array([1.0, np.inf]), [0.0], "measurement: expected numbers, or NaN for what is missing, got"),
        ([1.0, -np.inf], [0.0], "measurement: expected numbers, or NaN for what is missing, got"),
        ([1.0, 2.0], [np.nan], "inputs: expected finite numbers, got"),
        ([1.0, 2.0], np.array([np.inf]), "inputs: expected finite numbers, got"),
        ([1.0, 1e9], [0.0], "measurement of step 2: expected a plausible one"),
        ([1.0, 2.0], [1e200], "inputs of step 2: expected plausible ones"),
    ):
        with pytest.raises(ValueError, match=message):
            stream.push(z, u)
        assert stream.steps == 2
        for a, b in zip(before, stream._stepper.state, strict=True):
            assert a.tobytes() == b.tobytes()
    np.testing.assert_array_equal(stream.push([0.4, 0.3], [0.2]).mean, other.push([0.4, 0.3], [0.2]).mean)


@pytest.mark.parametrize("engine", ["native", "xla"])
def test_a_state_may_exchange_its_numbers(engine, monkeypatch):
    """Numbers in memory are read before others take their place."""
    stream = stream_of(Exchanging(), engine, monkeypatch)
    assert [stream.push(0.0).mean[0] for _ in range(3)] == [142.0, 231.0, 342.0]


@pytest.mark.slow
def test_a_state_goes_on_under_the_other_engine(monkeypatch):
    item, (z, u) = hg.cubature_filter(PLANT, SENSOR, RELAY), rows()
    for first, second in (("native", "xla"), ("xla", "native")):
        stream = stream_of(item, first, monkeypatch)
        for k in range(10):
            stream.push(z[k], u[k])
        data = stream.save()
        other = stream_of(item, second, monkeypatch).restore(item, data)
        for k in range(10, 30):
            np.testing.assert_allclose(stream.push(z[k], u[k]).mean, other.push(z[k], u[k]).mean, rtol=0, atol=ACCURACY)


@pytest.mark.parametrize("engine", ["native", "xla"])
def test_a_copy_goes_on_alone_with_the_same_bits(engine, monkeypatch):
    item, (z, u) = hg.cubature_filter(PLANT, SENSOR, RELAY), rows()
    stream = stream_of(item, engine, monkeypatch)
    for k in range(10):
        stream.push(z[k], u[k])
    copies = [pickle.loads(pickle.dumps(stream)), hg.Stream.restore(item, stream.save())]
    first = stream.push(z[10], u[10])
    mean, covariance = first.mean.tobytes(), first.covariance.tobytes()
    for k in range(11, 30):
        stream.push(z[k], u[k])
    for other in copies:
        again = other.push(z[10], u[10])
        assert again.mean.tobytes() == mean and again.covariance.tobytes() == covariance
    assert first.mean.tobytes() == mean  # a result is no part of the stream


def test_limits_are_counted_by_both_engines(monkeypatch):
    item = hg.kalman_filter(PLANT, SENSOR)
    for engine in ("native", "xla"):
        stream = stream_of(item, engine, monkeypatch, (-5.0, 5.0))
        other = stream_of(item, engine, monkeypatch)
        np.testing.assert_array_equal(stream.push([9.0, 1.0], [0.0]).mean, other.push([np.nan, 1.0], [0.0]).mean)
        assert sum(stream.refused.values()).tolist() == [1, 0]
        with pytest.raises(ValueError, match="measurement: expected numbers"):
            stream.push([np.inf, 1.0], [0.0])


def test_a_filter_that_native_code_does_not_take_is_stepped_by_xla(monkeypatch):
    """One of a plant with an incomplete beta function; by native code alone it is refused in one line."""
    plant = hg.Plant(
        lambda x, u: 0.5 * x + betainc(2.0, 3.0, x**2 / (1 + x**2)) * u,
        0.1 * np.eye(2),
        [1.0, -1.0],
        np.eye(2),
        inputs=["push"],
    )
    item = hg.cubature_filter(plant, SENSOR, hg.hop(1.0, 0.1, dimension=2))
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    with pytest.raises(ValueError, match="native code: expected a program of operations that it takes") as caught:
        hg.Stream(item)
    assert "\n" not in str(caught.value)
    monkeypatch.delenv("HELIOGRAPH_ENGINE")
    stream = hg.Stream(item)
    assert isinstance(stream._stepper, XlaFilterStepper)
    assert np.isfinite(stream.push([0.1, 0.2], [0.3]).mean).all()
