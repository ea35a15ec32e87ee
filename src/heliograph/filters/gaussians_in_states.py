"""The Gaussians within a state of a linear filter: find, replace and compare them, beside what no data change.

A state may hold the derivatives of a Gaussian behind it, in some numbers of a model. With the closed loop
L = F (I - K H) an error of the mean falls as L^k, and its derivative as sum_j L^(k - j) L' L^(j - 1), by the same rate
beside a factor of k: what forgets how it began also forgets how its derivatives did, some rows later.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.numerics.types import Array, Bool, PyTree

TOLERANCE = 1e-11  # of a deviation, between two states that should be the same
ROUNDINGS = 16  # of a number, by which two ways to it differ; of means a million deviations from 0 twice were seen
ROUNDING = ROUNDINGS * float(np.finfo(np.float64).eps)


class MomentSlopes(NamedTuple):
    """Derivatives of the Gaussian before them in a state, in one number: of its mean (n,) and covariance (n, n)."""

    mean: jax.Array
    covariance: jax.Array


def find_equal_states(
    states: PyTree, others: PyTree, tolerance: float = TOLERANCE, among: PyTree | None = None
) -> Bool[np.ndarray, " n"]:
    """Return which states (n, ...) are the same as others, to a share of a deviation and some roundings of each number.

    The rounding of a mean far from zero enters all means, by the innovations. Derivatives are measured by the
    deviations of their Gaussian as well, and as shares of the largest such derivative in the same number: of those
    `among` which they are, or of the others.
    """
    # (number, other number, allowed difference besides roundings); the derivatives of a Gaussian come after it, and are
    # measured by its deviations.
    pairs = [(a, b, np.zeros(())) for a, b in zip(*map(_leaves_beside, (states, others)), strict=True)]
    sizes = _find_largest_slopes(others if among is None else among)
    for x, y in zip(*map(_moving_parts, (states, others)), strict=True):
        p, q = np.asarray(x.covariance), np.asarray(y.covariance)
        if isinstance(y, Gaussian):
            deviation, outer = _deviations(q)
            ratio = np.abs(y.mean) / np.where(deviation > 0, deviation, np.inf)
            # Largest mean in its deviations.
            far = np.max(ratio, axis=-1, keepdims=True, initial=0.0)
        size = 1.0 if isinstance(y, Gaussian) else next(sizes)
        pairs += [(x.mean, y.mean, size * (tolerance + ROUNDING * far) * deviation), (p, q, size * tolerance * outer)]
    near = [_are_near(*pair).reshape(len(pair[0]), -1).all(axis=1) for pair in pairs]
    result: np.ndarray = np.all(near, axis=0)
    return result


def _deviations(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviations (n, k) of covariances (n, k, k), and the products of each two of them (n, k, k)."""
    deviation = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return deviation, deviation[..., :, None] * deviation[..., None, :]


def _find_largest_slopes(states: PyTree) -> Iterator[float]:
    """Yield the largest entry of each derivative of a Gaussian in the states (n, ...), in the Gaussian's deviations.

    The parts of a state that data change are Gaussians. Each is followed by the derivatives of its mean and covariance.
    """
    for part in _moving_parts(states):
        if isinstance(part, Gaussian):
            gaussian = part
            continue
        deviations = _deviations(np.asarray(gaussian.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled_slopes = [
                np.where(deviation > 0, np.abs(slope) / deviation, 0.0)
                for slope, deviation in zip(part, deviations, strict=True)
            ]
            yield max(float(np.max(slope, initial=0.0, where=np.isfinite(slope))) for slope in scaled_slopes)


def _are_near(a: np.ndarray, b: np.ndarray, within: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Return which entries of a and b are both NaN, or differ by at most `within` plus ROUNDING |b| (16 eps |b|)."""
    with np.errstate(invalid="ignore"):  # infinite entries of both give NaN, which is not near
        near: np.ndarray = np.abs(a - b) <= within + ROUNDING * np.abs(b)
    near |= np.isnan(a) & np.isnan(b)
    return near


def select_state(condition: Array, if_true: PyTree, if_false: PyTree) -> PyTree:
    """Return one state where a condition holds, else the other."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def gaussians_of(state: PyTree) -> list[Gaussian]:
    """Return the Gaussians of a state."""
    return [part for part in _moving_parts(state) if isinstance(part, Gaussian)]


def means_of(state: PyTree) -> list[Any]:
    """Return the means of a state's Gaussians, and of their derivatives."""
    return [part.mean for part in _moving_parts(state)]


def with_means(state: PyTree, means: Sequence[Any]) -> PyTree:
    """Return the state with the means of its Gaussians, and of their derivatives, replaced by `means` in order."""
    next_mean = iter(means)

    def replace_mean(part: PyTree) -> PyTree:
        """Return a Gaussian, or a derivative of one, with the next of `means`; any other part as it is."""
        return part._replace(mean=next(next_mean)) if _is_moving(part) else part

    return jax.tree.map(replace_mean, state, is_leaf=_is_moving)


def beside_gaussians(state: PyTree) -> PyTree:
    """Return what a state holds beside its Gaussians and their derivatives, with () in their places."""
    return jax.tree.map(lambda part: () if _is_moving(part) else part, state, is_leaf=_is_moving)


def with_gaussians(beside: PyTree, state: PyTree) -> PyTree:
    """Return `state` with its Gaussians and their derivatives, and with all other parts replaced by those of `beside`.

    `beside` is a result of `beside_gaussians`, which leaves out Gaussians.
    """
    other_parts = iter(_leaves_beside(beside))
    return jax.tree.map(lambda part: part if _is_moving(part) else next(other_parts), state, is_leaf=_is_moving)


def _moving_parts(state: PyTree) -> list[Any]:
    """Return the parts of a state with means that depend on data."""
    return [part for part in jax.tree.leaves(state, is_leaf=_is_moving) if _is_moving(part)]


def _is_moving(part: Any) -> bool:
    """Return whether a part of a state is a Gaussian or its derivatives."""
    return isinstance(part, Gaussian | MomentSlopes)


def _leaves_beside(state: PyTree) -> list[np.ndarray]:
    """Return the arrays that a state holds beside its Gaussians and their derivatives."""
    leaves: list[np.ndarray] = jax.tree.leaves(beside_gaussians(state))
    return leaves
