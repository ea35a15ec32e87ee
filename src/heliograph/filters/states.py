"""States of linear filters: Gaussians, whose means depend on data, and what no data change; when two are the same."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.gaussian import Gaussian
from heliograph.numerics.types import Array, Bool, PyTree

TOLERANCE = 1e-11  # of a deviation, between two states that should be the same
ROUNDINGS = 16  # of a number, by which two ways to it differ; of means a million deviations from 0 twice were seen
ROUNDING = ROUNDINGS * float(np.finfo(np.float64).eps)


def agree(states: PyTree, others: PyTree, tolerance: float = TOLERANCE) -> Bool[np.ndarray, " n"]:
    """Test whether states (n, ...) are the same to a share of a deviation, and to some roundings of each number.

    Those of a mean that is far from zero enter all others, by the innovations.
    """
    pairs = [(a, b, np.zeros(())) for a, b in zip(*map(_leaves_beside, (states, others)), strict=True)]
    for x, y in zip(gaussians_of(states), gaussians_of(others), strict=True):
        p, q = np.asarray(x.covariance), np.asarray(y.covariance)
        deviation = np.sqrt(np.diagonal(q, axis1=-2, axis2=-1))
        outer = deviation[..., :, None] * deviation[..., None, :]
        far = np.max(np.abs(y.mean) / np.where(deviation > 0, deviation, np.inf), axis=-1, keepdims=True, initial=0.0)
        pairs += [(x.mean, y.mean, (tolerance + ROUNDING * far) * deviation), (p, q, tolerance * outer)]
    near = [_are_near(*pair).reshape(len(pair[0]), -1).all(axis=1) for pair in pairs]
    result: np.ndarray = np.all(near, axis=0)
    return result


def _are_near(a: np.ndarray, b: np.ndarray, within: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Return which entries differ by no more than is allowed, or are both NaN."""
    with np.errstate(invalid="ignore"):  # of numbers that overflowed
        near: np.ndarray = np.abs(a - b) <= within + ROUNDING * np.abs(b)
    near |= np.isnan(a) & np.isnan(b)
    return near


def select_state(condition: Array, one: PyTree, other: PyTree) -> PyTree:
    """Return one state where a condition holds, else the other."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), one, other)


def gaussians_of(state: PyTree) -> list[Gaussian]:
    """Return the Gaussians of a state."""
    return [part for part in jax.tree.leaves(state, is_leaf=_is_gaussian) if _is_gaussian(part)]


def means_of(state: PyTree) -> list[Any]:
    """Return the means of a state's Gaussians."""
    return [x.mean for x in gaussians_of(state)]


def with_means(state: PyTree, means: Sequence[Any]) -> PyTree:
    """Return a state whose Gaussians have other means."""
    rest = iter(means)
    return jax.tree.map(
        lambda part: part._replace(mean=next(rest)) if _is_gaussian(part) else part, state, is_leaf=_is_gaussian
    )


def beside_gaussians(state: PyTree) -> PyTree:
    """Return what a state holds beside its Gaussians, in their place nothing."""
    return jax.tree.map(lambda part: () if _is_gaussian(part) else part, state, is_leaf=_is_gaussian)


def with_gaussians(beside: PyTree, state: PyTree) -> PyTree:
    """Return the Gaussians of a state, and beside them what another one holds there."""
    parts = iter(_leaves_beside(beside))
    return jax.tree.map(lambda part: part if _is_gaussian(part) else next(parts), state, is_leaf=_is_gaussian)


def _is_gaussian(part: Any) -> bool:
    return isinstance(part, Gaussian)


def _leaves_beside(state: PyTree) -> list[np.ndarray]:
    leaves: list[np.ndarray] = jax.tree.leaves(beside_gaussians(state))
    return leaves
