"""Gains that settle and means in chunks give what the plain scan gives; where gains do not settle, the scan does."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import heliograph as hg
from heliograph.filters.linear.plan import Plan
from heliograph.learning.description import describe
from heliograph.learning.likelihood.objective import Data, _with_steady_gains, at_points, objectives
from heliograph.learning.likelihood.steady_gains import in_chunks

STEPS, RECORDINGS, LANES = 157, 2, 2
TOLERANCE = 1e-10  # of the largest entry: what rounding is given that 157 steps add it up, and information squares it


def relayed():
    """Two states behind a relay with a random gain and a direct link, both noises with means."""
    noise = hg.Gaussian(np.eye(2) * hg.free(0.2, "plant noise", "positive"), [0.3, -0.1])
    plant = hg.LinearPlant([[0.6, 0.2], [-0.1, 0.5]], noise, [1.0, -2.0], np.diag([1.0, 3.0]))
    sensor = hg.LinearSensor([[1.0, 0.0], [0.5, 1.0]], hg.Gaussian(np.diag([0.3, 0.2]), [0.2, 0.0]))
    channel = hg.parallel([hg.hop(hg.Rayleigh(hg.free(0.7, "scale")), hg.free(0.3, "hop noise")), hg.perfect()])
    return hg.Network(plant, {"node": hg.Node(sensor, channel, {})})


def walk():
    """A random walk, whose own moments grow without end."""
    plant = hg.LinearPlant([[1.0]], hg.free(0.2, "q"), [0.5], [[2.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[2.0]], hg.free(0.3, "r")), hg.perfect(), {})})


@pytest.fixture(scope="module", params=[relayed, walk])
def both(request):
    """A linear objective with gains that settle, the same by the plain scan, and data."""
    quick = objectives(describe(request.param))[0]
    assert quick.steady
    received = quick.description.start.nodes["node"].received
    z = np.cumsum(np.random.default_rng(0).normal(size=(RECORDINGS, STEPS, received)), axis=1)
    return quick, replace(quick, steady=False), Data(z, np.zeros((RECORDINGS, STEPS, 0)), (STEPS,) * RECORDINGS)


def becomes_steady(objective, x, data):
    with jax.enable_x64(True):
        return bool(_with_steady_gains(objective, x, data.measurements)[1])


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(arrays(float, 3, elements=st.floats(-1.5, 1.5)))
def test_likelihoods_scores_and_information_are_those_of_the_scan(both, shift):
    quick, plain, data = both
    x = quick.description.parameters.start
    x = x + shift[: len(x)]
    assert becomes_steady(quick, x, data)
    item, other = (at_points(item, x[None], data, LANES) for item in (quick, plain))
    for a, b in zip(item, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE * np.max(np.abs(b)))


@pytest.mark.slow
@pytest.mark.parametrize("both", [walk], indirect=True)
def test_where_gains_have_no_steady_state_the_scan_is_taken(both):
    """With hardly any plant noise the covariance falls as 1/k."""
    quick, plain, data = both
    x = np.stack([quick.description.parameters.start] * 3)
    x[1, 0] = -30.0
    assert [becomes_steady(quick, item, data) for item in x] == [True, False, True]
    item, other = (at_points(item, x, data, LANES) for item in (quick, plain))
    for a, b in zip(item, other, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE * np.max(np.abs(b)))
    np.testing.assert_array_equal(item.density[1], other.density[1])


@pytest.mark.slow
def test_with_something_lost_the_scan_is_taken(both):
    quick, plain, data = both
    z = data.measurements.copy()
    z[0, 3] = np.nan
    x, lossy = quick.description.parameters.start[None], data._replace(measurements=z)
    for a, b in zip(*(at_points(item, x, lossy, LANES) for item in (quick, plain)), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("steps", [1, 2, 7, 16])
def test_chunks_are_the_loop(steps):
    """Gains that differ at each step, several recordings, chunks that do not divide the time."""
    rng = np.random.default_rng(steps)
    n, m = 3, 2
    plan = Plan(*(rng.normal(size=size) / 2 for size in ((n, n), n, (n, m), (m, n), m, (m, m))))
    gain, start, z = rng.normal(size=(steps, n, m)) / 4, rng.normal(size=n), rng.normal(size=(2, steps, m))
    expected = np.empty(z.shape)
    for r in range(2):
        mean = start
        for k in range(steps):
            prior = plan.transition @ mean + plan.drift
            expected[r, k] = z[r, k] - plan.output @ prior - plan.offset
            mean = prior + gain[k] @ expected[r, k]
    with jax.enable_x64(True):
        result = jax.jit(in_chunks)(plan, gain, start, z)
    np.testing.assert_allclose(result, expected, rtol=0, atol=1e-13 * np.max(np.abs(expected)))
