"""Outputs that repeat others, noise and all: the state is that of the outputs without them, in exact fractions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline
from heliograph import LinearPlant, LinearSensor, Stream, linear_filter
from heliograph.factors import (
    WeightedColumns,
    columns_of,
    condition_on_observation,
    from_covariance,
    gain_of,
    join_columns,
    rounding_of,
    triangularise,
    triangularise_noise,
)
from heliograph.random_affine import Constant, GainAndNoise
from tests.factors.exact import after, exactly

observe, gain = jax.jit(condition_on_observation), jax.jit(gain_of)
triangularise, triangularise_noise = jax.jit(triangularise), jax.jit(triangularise_noise)
N, M, EXTRA = 3, 2, 2


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def problem(seed):
    """P, H and R of whole numbers, and W whose rows are the outputs and sums of them, in any order: W H is exact."""
    rng = np.random.default_rng(seed)
    root, noise = rng.integers(-4, 5, (N, N)) + 5.0 * np.eye(N), rng.integers(-2, 3, (M, M)) + 3.0 * np.eye(M)
    p, r = root @ root.T * 4.0 ** rng.integers(-3, 4), noise @ noise.T * 4.0 ** rng.integers(-6, 3)
    h, extra = rng.integers(-9, 10, (M, N)) / 7, rng.integers(-9, 10, (EXTRA, M)) / 3
    w = np.concatenate([np.eye(M), extra])[rng.permutation(M + EXTRA)]
    return p, h, r, w


def measured_noise(p, h, r):
    """What a filter makes of a sensor: the noise and the rounding of what is received."""
    return triangularise_noise(join_columns(columns_of(r), rounding_of(np.diagonal(h @ p @ h.T + r))))


@pytest.mark.parametrize("seed", range(40))
def test_a_repeated_output_says_nothing(seed):
    """Right to 1e-9 of each variance: the noises are given to 1e-16, and four components are taken one by one."""
    p, h, r, w = problem(seed)
    expected, kept = (np.array(part, dtype=float) for part in after(*map(exactly, (p, h, r))))
    x, rows = from_covariance(np.zeros(N), p), w @ h
    sent = w @ r @ w.T
    noise = measured_noise(p, rows, (sent + sent.T) / 2)
    z = np.random.default_rng(seed).normal(size=M)
    found, _ = observe(x, rows @ x.root, jnp.asarray(w @ z), noise)
    unit = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-9)
    np.testing.assert_allclose(found.mean / unit, kept @ z / unit, atol=1e-9)
    np.testing.assert_allclose(gain(x, rows @ x.root, noise) @ w @ z / unit, kept @ z / unit, atol=1e-9)


def test_without_noise_a_repeated_output_says_nothing_of_what_it_does_not_reach():
    """Three times the same combination without noise: of the two others no variance is lost, but rounding."""
    p, h, _, _ = problem(3)
    expected = np.array(after(*map(exactly, (p, h[:1], [[0.0]])))[0], dtype=float)
    rows = np.array([[1.0], [0.85], [-7.1]]) @ h[:1]
    x = from_covariance(np.zeros(N), p)
    found, _ = observe(x, rows @ x.root, jnp.zeros(3), measured_noise(p, rows, np.zeros((3, 3))))
    unit = np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_without_noise_sums_of_outputs_say_nothing_of_what_they_do_not_reach(seed):
    """Two outputs and two sums of them in any order: right to 1e-12 of the prior, where 1 % of it was lost.

    What rounding leaves of a sum's slopes is that of all that was taken from it, each as often as it is in it.
    """
    p, h, r, w = problem(seed)
    expected, kept = (np.array(part, dtype=float) for part in after(*map(exactly, (p, h, 0 * r))))
    x, rows, z = from_covariance(np.zeros(N), p), w @ h, np.random.default_rng(seed).normal(size=M)
    found, _ = observe(x, rows @ x.root, jnp.asarray(w @ z), measured_noise(p, rows, np.zeros((M + EXTRA,) * 2)))
    unit = np.sqrt(np.diagonal(p))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-12)
    np.testing.assert_allclose(found.mean / unit, kept @ z / unit, atol=1e-12)


def test_what_follows_a_repeated_output_keeps_its_noise():
    """A noise of rounding alone would be correlated with all that follow: a part of theirs would be lost."""
    r = np.array([[2.0, 0.3], [0.3, 1.0]])
    w = np.array([[1.0, 0.0], [0.85, 0.0], [0.0, 1.0]])
    sent = w @ r @ w.T
    factors = triangularise_noise(join_columns(columns_of(sent), rounding_of(np.diagonal(sent))))
    assert factors.weights[2] == pytest.approx(1.0 - 0.3**2 / 2.0, rel=1e-12)
    assert factors.weights[1] < 1e-28


@pytest.mark.parametrize("m", [1, 2, 3, 12])
def test_noises_without_repetition_are_factored_as_any_covariance(m):
    root = np.random.default_rng(m).normal(size=(m, m))
    noise = columns_of(root @ root.T + np.eye(m))
    for mine, others in zip(triangularise_noise(noise), triangularise(noise), strict=True):
        np.testing.assert_allclose(mine, others, rtol=1e-12, atol=1e-12)


def test_natively_noises_of_many_outputs_on_their_own_cost_what_each_costs():
    """Of an output a square, and whether it is above rounding; what is known to be zero costs nothing."""
    n = 26

    def noise(w):
        factors = triangularise_noise(WeightedColumns(jnp.diag(w), jnp.ones(n)))
        return factors.matrix, factors.weights

    w = np.random.default_rng(2).uniform(0.5, 2.0, size=(3, n))
    code = straightline.compile(noise, w[0])
    assert code.operations < 20 * n
    matrix, weights = code(w)
    np.testing.assert_array_equal(matrix, np.broadcast_to(np.eye(n), (3, n, n)))
    np.testing.assert_allclose(weights, w**2, rtol=1e-15)


def test_a_filter_of_repeated_outputs_claims_what_one_without_them_does():
    """A sensor with noise behind a link with noise, sums and multiples of its outputs; 3e-3 of a claim was lost."""
    rng = np.random.default_rng(18)
    plant = LinearPlant(0.9 * np.eye(3) + 0.1 * rng.normal(size=(3, 3)), 0.1 * np.eye(3), np.full(3, 50.0), np.eye(3))
    h, w = rng.normal(size=(2, 3)), np.array([[0.85, 0.0], [1.0, 0.0], [0.3, -1.7], [0.0, 1.0]])
    r, n = np.array([[2.0, 0.3], [0.3, 1.0]]), np.array([[0.5, 0.1], [0.1, 0.4]])

    def claims(w):
        link = GainAndNoise(Constant(1.0), np.eye(len(w)), w @ n @ w.T)
        stream = Stream(linear_filter(plant, LinearSensor(w @ h, w @ r @ w.T), link))
        return [stream.push(w @ z).covariance for z in np.random.default_rng(1).normal(size=(5, 2))]

    for found, expected in zip(claims(w), claims(np.eye(2)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
