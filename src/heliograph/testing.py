"""Contract checks for your own channels and filters: call them in your tests; they raise AssertionError."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from heliograph.filter.base import STRENGTH, AbstractFilter
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.monomials import monomials

FALSE_ALARM = 1e-6  # probability that a correct object fails, shared by all numbers compared (Bonferroni)


def check_random_affine(channel: AbstractRandomAffine, seed: int = 0, samples: int = 20_000, highest: int = 4) -> float:
    """Compare a channel's samples with its joint moments, E[mono_k(z) | y] for k = 1 .. highest, at two points y.

    Returns the largest |z| seen. Wrong moments of size s are found when s exceeds about 6 standard errors, so more
    samples make it stricter.

    Raises:
        AssertionError: a moment that differs from the samples by more than chance, shapes that disagree.
    """
    generator, worst = np.random.default_rng(seed), 0.0
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(seed), samples)
        drawn = np.asarray(jax.jit(jax.vmap(channel.sample))(keys))
    expected_shape = (samples, channel.outputs + 1, channel.inputs + 1)
    assert drawn.shape == expected_shape, f"sample: expected shape {expected_shape[1:]}, got {drawn.shape[1:]}"
    bottom = np.eye(1, channel.inputs + 1, channel.inputs)
    assert np.array_equal(drawn[:, -1:], np.broadcast_to(bottom, drawn[:, -1:].shape)), "last row: expected [0, 1]"
    for y in (channel.example_input(generator), channel.example_input(generator)):
        z = drawn[:, :-1] @ np.append(y, 1.0)
        for order in range(1, highest + 1):
            worst = max(worst, _compare(channel, y, z, order))
    return worst


def _compare(channel: AbstractRandomAffine, y: np.ndarray, z: np.ndarray, order: int) -> float:
    moments = channel.moments(order)
    expected = moments.expect(monomials(y, order))
    with jax.enable_x64(True):
        seen = np.asarray(jax.vmap(lambda row: monomials(row, order))(jnp.asarray(z)))
    error = seen.std(axis=0) / np.sqrt(len(seen))
    difference = np.abs(seen.mean(axis=0) - expected)
    scale = np.abs(seen).max(axis=0) + np.abs(expected)
    certain = error <= 1e-12 * scale  # the monomial does not vary: moments must agree to rounding
    assert np.all(difference[certain] <= 1e-9 * scale[certain]), f"order {order}: a known moment differs"
    ratios = difference[~certain] / error[~certain]
    limit = float(stats.norm.isf(FALSE_ALARM / 2 / max(len(ratios), 1)))
    largest = float(ratios.max(initial=0.0))
    assert largest <= limit, f"order {order}: a moment differs from the samples by {largest:.1f} standard errors"
    return largest


def check_filter(item: AbstractFilter, received: int, inputs: Any = (), steps: int = 5, seed: int = 0) -> None:
    """Check the (init, step) contract on random measurements of length `received`.

    A step is deterministic; leaves the structure of the state alone; gives a finite mean and a symmetric positive
    semidefinite bound, also when some or all components are missing; and does the same inside vmap.

    Raises:
        AssertionError: naming what does not hold.
    """
    generator = np.random.default_rng(seed)
    assert item.claim in STRENGTH, f"claim: expected one of {list(STRENGTH)}, got {item.claim!r}"
    state = item.init()
    structure = str(jax.tree.structure(state))
    for k in range(steps):
        z = generator.normal(size=received)
        z[generator.random(received) < 0.3 * (k > 0)] = np.nan
        if k == steps - 1:
            z[:] = np.nan
        following, estimate = item.step(state, z, inputs, k)
        again = item.step(state, z, inputs, k)[1]
        assert np.array_equal(estimate.mean, again.mean), "step: expected the same estimate from the same arguments"
        assert str(jax.tree.structure(following)) == structure, "step: expected a state of init's structure"
        _check_estimate(np.asarray(estimate.mean), np.asarray(estimate.bound), k)
        _check_vmapped(item, state, z, inputs, k, np.asarray(estimate.mean))
        state = following


def _check_estimate(mean: np.ndarray, bound: np.ndarray, k: int) -> None:
    n = mean.shape[-1]
    assert bound.shape == (n, n), f"step {k}: expected a bound of shape {(n, n)}, got {bound.shape}"
    assert np.all(np.isfinite(mean)) and np.all(np.isfinite(bound)), f"step {k}: expected a finite estimate"
    size = np.abs(bound).max()
    assert np.abs(bound - bound.T).max() <= 1e-9 * size, f"step {k}: expected a symmetric bound"
    smallest = np.linalg.eigvalsh((bound + bound.T) / 2)[0]
    assert smallest >= -1e-9 * size, (
        f"step {k}: expected a positive semidefinite bound, smallest eigenvalue {smallest:g}"
    )


def _check_vmapped(item: AbstractFilter, state: Any, z: np.ndarray, inputs: Any, k: int, mean: np.ndarray) -> None:
    with jax.enable_x64(True):
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
        means = jax.vmap(lambda s, m: item.step(s, m, inputs, k)[1].mean)(batch, jnp.stack([z, z]))
    gap = np.abs(np.asarray(means) - mean).max()
    assert gap <= 1e-9 * (1 + np.abs(mean).max()), f"step {k}: expected the same estimate inside vmap, off by {gap:g}"
