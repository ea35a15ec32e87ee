"""Likelihood and gradient of a long recording in chunks side by side: those of the sequential pass."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.rows import chunks
from heliograph.learning.likelihood import LikelihoodData, LikelihoodSurface, make_objectives
from heliograph.learning.parametric_network import describe

ROWS = 40_001  # a chunk that is not full at the end
RNG = np.random.default_rng(11)
Z = 0.1 * np.cumsum(RNG.normal(size=(ROWS, 2)), axis=0) + 0.5 * RNG.normal(size=(ROWS, 2))
HOLES = np.where(RNG.random(Z.shape) < 0.1, np.nan, Z)
HOLES[7_000:9_500] = np.nan  # an outage across a joint, in which nothing is forgotten
FEW_HOLES = Z.copy()  # most chunks are complete
FEW_HOLES[[20_000, 40_000], [1, 0]] = np.nan
PUSHES = RNG.normal(size=(ROWS, 1))


def walk():
    """Positions and speeds of which positions are measured, both noises free."""
    shape = np.diag([1e-2, 1e-2, 1.0, 1.0])
    plant = hg.LinearPlant(np.eye(4) + 0.1 * np.eye(4, k=2), hg.free(0.01, "q") * shape, np.zeros(4), np.eye(4))
    sensor = hg.LinearSensor(np.eye(2, 4), hg.free(0.25, "r") * np.eye(2))
    return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {})})


def everywhere():
    """Numbers of every part; a unit of the first is a millionth of what matters, and the start is soon forgotten."""
    turn = 1e-6 * hg.free(1e5, "turn", "real")
    plant = hg.LinearPlant(
        jnp.array([[0.9, 0.0], [0.0, 0.8]]) + turn * jnp.array([[0.0, 1.0], [-1.0, 0.0]]),
        hg.free(0.3, "Q") * jnp.array([[1.0, 0.2], [0.2, 0.5]]),
        jnp.array([1.0, 0.0]) * hg.free(0.7, "start", "real"),
        jnp.eye(2) * hg.free(2.0, "spread"),
        jnp.ones((2, 1)) * hg.free(0.5, "push", "real"),
    )
    sensor = hg.LinearSensor(np.eye(2), hg.Gaussian(0.4 * np.eye(2), jnp.ones(2) * hg.free(0.2, "bias", "real")))
    return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(2), {})})


def fading():
    """A plant whose moments before data settle, from a start with a mean, behind a random gain with a free law."""
    plant = hg.LinearPlant(
        [[0.95, 0.1], [-0.1, 0.9]], hg.free(0.1, "q") * np.eye(2), hg.free(1.0, "start", "real") * np.ones(2), np.eye(2)
    )
    link = hg.hop(hg.Rayleigh(hg.free(0.8, "scale")), 0.05, dimension=2)
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor(np.eye(2), hg.free(0.2, "r") * np.eye(2)), link, {})})


def evaluated(network, z, u, by_row=False):
    objective = make_objectives(describe(network))[0]
    data = LikelihoodData(z[None], u[None], (len(z),))
    surface, x = LikelihoodSurface(objective, data), objective.description.parameters.start[None] + 0.1
    return surface.evaluate_rows(x) if by_row else surface.evaluations(x)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("network", "z"),
    [(walk, FEW_HOLES), (walk, HOLES), (everywhere, FEW_HOLES), (everywhere, HOLES), (fading, FEW_HOLES)],
    ids=["walk, few missing", "walk, missing", "everywhere, few missing", "everywhere, missing", "fading, few missing"],
)
def test_the_gradient_is_that_of_the_sequential_pass(monkeypatch, network, z):
    """To 1e-10 of a standard deviation of the score, sqrt(I), and information to 1e-10 of two of them."""
    u = PUSHES if network is everywhere else np.zeros((ROWS, 0))
    in_chunks, by_row = evaluated(network, z, u), evaluated(network, z, u, by_row=True)
    with monkeypatch.context() as patch:
        patch.setattr(chunks, "CHUNKS", ROWS)
        row_by_row = evaluated(network, z, u)
    assert in_chunks.density.shape == (1, 1, 1) and by_row.density.shape == row_by_row.density.shape == (1, 1, ROWS)
    deviation = np.sqrt(np.diag(row_by_row.information[0]))
    for result in (in_chunks, by_row):
        assert result.total[0] == pytest.approx(row_by_row.total[0], rel=1e-12)
        assert np.max(np.abs(result.gradient - row_by_row.gradient) / deviation) < 1e-10
        apart = np.abs(result.halves - row_by_row.halves) / np.outer(deviation, deviation)
        assert np.max(apart) < 1e-10
    np.testing.assert_allclose(by_row.density, row_by_row.density, rtol=1e-9, atol=1e-10)


@pytest.mark.slow
def test_a_long_recording_is_summed_by_chunks():
    assert evaluated(walk, Z, np.zeros((ROWS, 0))).density.shape == (1, 1, 1)


def test_what_is_not_forgotten_goes_row_by_row():
    """A constant: its likelihood is known by all rows before."""

    def constant():
        plant = hg.LinearPlant([[1.0]], [[0.0]], [0.0], [[1.0]])
        return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], hg.free(0.2, "r")), hg.perfect(), {})})

    assert evaluated(constant, Z[:, :1], np.zeros((ROWS, 0))).density.shape == (1, 1, ROWS)
