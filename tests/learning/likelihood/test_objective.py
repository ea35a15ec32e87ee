"""Likelihoods, scores and information of native code and of XLA are one; they are those of the filter's likelihood."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.learning.likelihood import LikelihoodData, LikelihoodSurface, make_objectives
from heliograph.learning.likelihood.evaluation import _by_xla
from heliograph.learning.parametric_network import describe

STEPS, RECORDINGS = 157, 2
TOLERANCE = 1e-10  # of the largest entry: what rounding is given that 157 steps add it up, and information squares it
DIFFERENCE = 1e-5  # of a number on the line: errors of central differences are its square


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


def everywhere():
    """Numbers of every part: matrix, input, noises, start, sensor, link."""
    turn = hg.free(0.2, "turn", "real")
    plant = hg.LinearPlant(
        jnp.array([[0.9, 0.0], [0.0, 0.7]]) + turn * jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
        hg.free(0.3, "Q") * jnp.array([[1.0, 0.2], [0.2, 0.5]]),
        jnp.array([1.0, 0.0]) * hg.free(0.7, "start", "real"),
        jnp.eye(2) * hg.free(2.0, "spread"),
        jnp.ones((2, 1)) * hg.free(0.5, "push", "real"),
    )
    matrix, link = jnp.array([[1.0, 0.3], [0.0, 1.0]]) * hg.free(1.1, "scale", "real"), hg.hop(0.8, 0.1, dimension=2)
    sensor = hg.LinearSensor(matrix, hg.Gaussian(0.4 * np.eye(2), jnp.ones(2) * hg.free(0.2, "bias", "real")))
    return hg.Network(plant, {"node": hg.Node(sensor, link, {})})


def without_noise():
    """One combination of the start is uncertain, and a random gain is all noise that sensor and link have."""
    plant = hg.LinearPlant(
        jnp.array([[0.9, 0.2], [0.0, 0.7]]) * hg.free(1.0, "decay"),
        hg.free(0.1, "q") * np.diag([1.0, 0.0]),
        np.array([2.0, 1.0]) * hg.free(1.0, "start", "real"),
        [[1.0, 2.0], [2.0, 4.0]],
    )
    sensor = hg.LinearSensor(np.eye(2), np.zeros((2, 2)))
    link = hg.hop(hg.Rayleigh(hg.free(0.8, "scale")), 0.0, dimension=2)
    return hg.Network(plant, {"node": hg.Node(sensor, link, {})})


@pytest.fixture(scope="module", params=[relayed, walk, everywhere])
def both(request):
    """An objective and data of which one number is lost."""
    objective = make_objectives(describe(request.param))[0]
    received = objective.description.start.nodes["node"].received
    z = np.cumsum(np.random.default_rng(0).normal(size=(RECORDINGS, STEPS, received)), axis=1)
    z[0, 3, 0] = z[0, 20:23] = np.nan
    u = np.random.default_rng(2).normal(size=(RECORDINGS, STEPS, len(objective.description.start.inputs)))
    return objective, LikelihoodData(z, u, (STEPS,) * RECORDINGS)


def points(objective):
    start = objective.description.parameters.start
    return start + np.random.default_rng(1).uniform(-1.5, 1.5, (3, len(start)))


@pytest.mark.slow
def test_native_code_computes_what_the_compiler_of_jax_does(both):
    objective, data = both
    x = points(objective)
    native = LikelihoodSurface(objective, data).evaluations(x)
    with jax.enable_x64(True):
        for i, point in enumerate(x):
            parts = [_by_xla(objective, point, z, u) for z, u in zip(data.measurements, data.inputs, strict=True)]
            expected = (
                np.stack([p.density for p in parts]),
                np.stack([p.score for p in parts]),
                sum(p.halves for p in parts),
            )
            for a, b in zip((leaf[i] for leaf in native), expected, strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=TOLERANCE * np.max(np.abs(b)))


def test_scores_are_the_derivatives_of_the_likelihood(both):
    objective, data = both
    for x in points(objective):
        result = LikelihoodSurface(objective, data).evaluations(x[None])
        with jax.enable_x64(True):
            rows = zip(data.measurements, data.inputs, strict=True)
            total = sum(hg.log_likelihood(objective.filter(x), z, u) for z, u in rows)
        np.testing.assert_allclose(result.total[0], total, rtol=1e-12)
        ends = [
            LikelihoodSurface(objective, data).evaluations(x + sign * DIFFERENCE * np.eye(len(x))).total
            for sign in (-1, 1)
        ]
        slopes = (ends[1] - ends[0]) / (2 * DIFFERENCE)
        np.testing.assert_allclose(result.gradient[0], slopes, rtol=1e-6, atol=1e-6 * np.abs(slopes).max())


@pytest.mark.slow
@pytest.mark.parametrize("network", [walk, everywhere, relayed, without_noise])
def test_they_are_those_of_the_factors(network):
    """To 1e-10 of the largest, a million roundings: the derivatives of factors and of covariances are two ways."""
    objective = make_objectives(describe(network))[0]
    z = np.random.default_rng(0).normal(size=(40, objective.description.start.nodes["node"].received))
    z[[3, 20], 0] = z[21] = np.nan
    u = np.random.default_rng(2).normal(size=(40, len(objective.description.start.inputs)))
    data, x = LikelihoodData(z[None], u[None], (40,)), points(objective)[0]
    result = LikelihoodSurface(objective, data).evaluations(x[None])
    with jax.enable_x64(True):

        def by_factors(x):
            return jnp.sum(objective.filter(x).scan(z, u, lambda state, innovation, k: innovation.log_likelihood))

        total, slopes = jax.value_and_grad(by_factors)(x)
    np.testing.assert_allclose(result.total[0], total, rtol=1e-12)
    np.testing.assert_allclose(result.gradient[0], slopes, rtol=0, atol=1e-10 * np.abs(slopes).max())


def test_nodes_of_which_one_varies_over_time_are_learned_as_one_node():
    """Both networks describe one world, so that their fits agree to rounding."""
    steps = 30
    rising = [hg.LinearSensor([[1.0 + 0.1 * k]], [[0.2]]) for k in range(steps)]
    still = hg.LinearSensor([[0.5]], [[0.1]])

    def plant():
        return hg.LinearPlant([[0.9]], hg.free(0.3, "q"), [0.0], [[1.0]])

    def several():
        nodes = {"a": hg.Node(hg.model.over_time(rising), hg.perfect(), {}), "b": hg.Node(still, hg.perfect(), {})}
        return hg.Network(plant(), nodes)

    def whole():
        joint = hg.model.over_time(
            [hg.LinearSensor([s.matrix[0], still.matrix[0]], np.diag([0.2, 0.1])) for s in rising]
        )
        return hg.Network(plant(), {"ab": hg.Node(joint, hg.perfect(2), {})})

    record = hg.simulate(several(), horizon=steps, key=0)
    z = record.measurements
    apart = hg.fit(several, record, starts=1)
    together = hg.fit(whole, {"ab": np.concatenate([z["a"], z["b"]], axis=-1)}, starts=1)
    assert apart.values["q"] == pytest.approx(together.values["q"], rel=1e-9)
    assert apart.log_likelihood == pytest.approx(together.log_likelihood, rel=1e-12)
