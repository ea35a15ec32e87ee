"""A planned filter is the filter itself on complete data."""

import equinox as eqx
import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.engine.choice import compute_once
from heliograph.numerics import compile_in_float64

STEPS = 7
PLANT = hg.LinearPlant([[0.95, 0.2], [-0.2, 0.9]], 0.05, [1.0, -0.5], [[0.5, 0.1], [0.1, 0.4]], [[0.0], [1.0]])
STILL = hg.LinearPlant(PLANT.matrix, 0.05, PLANT.initial_mean, PLANT.initial_covariance)
SENSORS = hg.model.over_time([hg.LinearSensor([[1.0, 0.1 * k], [0.5, 1.0]], 0.02) for k in range(STEPS)])
FADING = hg.amplify_and_forward(
    [hg.hop(hg.Rayleigh(0.8), 0.1, dimension=2), hg.hop(hg.random_affine.bernoulli(0.85), 0.01, dimension=2)]
)
SURE = hg.hop(0.7, hg.Gaussian([[0.2, 0.1], [0.1, 0.3]], [0.5, -1.0]))
UNSURE = hg.hop(hg.Discrete([0.2, 1.3], [0.4, 0.6], 0.05), 0.1, dimension=2)
SENSOR = hg.LinearSensor([[1.0, 0.2], [0.5, 1.0]], 0.02)
ORIGINALS = {
    "linear": hg.linear_filter(PLANT, SENSORS, FADING),
    "linear, uncertain": hg.linear_filter(PLANT, SENSORS, UNSURE),
    "Kalman": hg.kalman_filter(PLANT, SENSORS, initial_covariance=3.0),
    "cubature": hg.cubature_filter(PLANT, SENSORS, SURE),
    "tighter": hg.cubature_filter(PLANT, SENSORS, SURE, hg.filters.ZeroMean()),
    "system": hg.filters.LinearSystemFilter(hg.linear.lifted_system(STILL, SENSOR, FADING, 1, STEPS)),
    "quadratic": hg.polynomial_filter(STILL, SENSOR, SURE, STEPS),
}


def taken(item, z, u):
    """The steps of a filter: estimates of the prediction, after the step, and of the state after it; the innovation."""

    def body(state, row):
        z, u, k = row
        prior = item.predict(state, u, k)
        after, estimate = item.step(state, z, u, k)
        return after, (item.estimate(prior), item.correct(prior, z, k)[1], estimate, item.estimate(after))

    start = jax.tree.map(jax.numpy.asarray, item.init())
    return jax.lax.scan(body, start, (z, u, jax.numpy.arange(len(z))))[1]


taken_by_xla = compile_in_float64(taken)


@pytest.mark.parametrize("name", ORIGINALS)
def test_its_steps_are_the_originals(name):
    original, draw = ORIGINALS[name], np.random.default_rng(3)
    inputs, data = draw.normal(size=(STEPS, len(original.inputs))), 3 * draw.normal(size=(STEPS, 2))
    planned = original.planned(inputs)
    assert planned.claim == original.claim and planned is not original
    expected, steps = (compute_once(taken, taken_by_xla, (item, data, inputs)) for item in (original, planned))
    for x, y in zip(jax.tree.leaves((*expected, expected[2])), jax.tree.leaves((*steps, steps[3])), strict=True):
        np.testing.assert_allclose(y, x, rtol=0, atol=1e-12 * np.maximum(1.0, np.abs(x).max()))


@pytest.mark.parametrize("name", ["linear", "Kalman", "cubature", "tighter"])
def test_covariances_do_not_depend_on_the_mean(name):
    """Their derivatives by it are symbolically zero: no arithmetic is spent on them."""
    item = ORIGINALS[name]
    u, z = np.zeros(len(item.inputs)), np.zeros(item.received)

    def held(state):
        return getattr(state, "gaussian", state)

    def variances(mean):
        prior = item.predict(eqx.tree_at(lambda state: held(state).mean, item.init(), mean), u, 1)
        return held(item.correct(prior, jax.numpy.asarray(z), 1)[0]).variances

    with jax.enable_x64(True):
        mean = jax.numpy.asarray(held(item.init()).mean)
        value, slope = jax.make_jaxpr(lambda m: jax.jvp(variances, (m,), (m,)))(mean).jaxpr.outvars
        assert not np.any(jax.jit(lambda m: jax.jvp(variances, (m,), (m,))[1])(mean))
        assert value is not slope


def test_what_depends_on_data_stays_as_it_is():
    nonlinear = hg.Plant(lambda x, u: x - 0.1 * x**3, 0.1 * np.eye(2), [1.0, 0.0], np.eye(2))
    for item in (hg.cubature_filter(STILL, SENSOR, FADING), hg.extended_filter(nonlinear, SENSOR, SURE)):
        assert item.planned(np.zeros((3, 0))) is item


def test_it_is_made_inside_a_compiled_function_for_nodes_side_by_side():
    items = [hg.linear_filter(PLANT, SENSOR, hg.hop(hg.Rayleigh(s), 0.1, dimension=2)) for s in (0.5, 1.0)]
    inputs, z = np.ones((STEPS, 1)), np.array([0.3, -0.2])
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *(eqx.filter(i, eqx.is_array) for i in items))

    @eqx.filter_jit
    def first(arrays):
        def single(part):
            planned = eqx.combine(part, eqx.filter(items[0], eqx.is_array, inverse=True)).planned(inputs)
            return planned.step(planned.init(), z, inputs[0], 0)[1].mean

        return jax.vmap(single)(arrays)

    with jax.enable_x64(True):
        values = np.asarray(first(stacked))
    expected = [item.step(item.init(), z, inputs[0], 0)[1].mean for item in items]
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-13)


def test_missing_data_is_seen():
    planned = ORIGINALS["Kalman"].planned(np.zeros((STEPS, 1)))
    assert np.all(np.isnan(planned.step(planned.init(), [np.nan, 0.0], [0.0])[1].mean))


def test_inputs_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"inputs: expected shape \(rows, 1\), got shape \(7, 2\)"):
        ORIGINALS["Kalman"].planned(np.zeros((STEPS, 2)))
