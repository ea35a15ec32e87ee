"""The Gaussians within a state of a linear filter: find, replace and compare them. Data do not change its other parts.

After a Gaussian, a state may hold its derivatives in some parameters of the model. With the closed loop
L = F (I - K H) an error of the mean falls as L^k, and its derivative as sum_j L^(k - j) L' L^(j - 1), at the same rate
times a factor k. So if a filter forgets its start, its derivatives forget theirs too, some rows later.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.numerics.types import Array, Bool, PyTree

TOLERANCE = 1e-11  # of a deviation, between two states that should be the same
ROUNDINGS = 16  # eps by which two computations of one number may differ; 2 were seen, of means 1e6 deviations from 0
ROUNDING = ROUNDINGS * float(np.finfo(np.float64).eps)


class MomentSlopes(NamedTuple):
    """Derivatives of a Gaussian's mean (n,) and covariance (n, n) by one parameter; they follow it in a state."""

    mean: jax.Array
    covariance: jax.Array


def find_equal_states(
    states: PyTree, others: PyTree, tolerance: float = TOLERANCE, among: PyTree | None = None
) -> Bool[np.ndarray, " n"]:
    """Return which of two stacks of states (n, ...) agree, a flag (n,) for each pair.

    A long recording is filtered in chunks from guessed states, and a guess is then compared with the state in which the
    chunk before ended. Means may differ by `tolerance` deviations and some roundings. A mean far from zero is rounded
    more, and its rounding enters all means through the innovations, so the largest |mean| / deviation scales the
    allowed rounding. A derivative of a Gaussian is compared in the Gaussian's deviations too, relative to the largest
    derivative by the same parameter in the states `among` (n', ...), by default `others`.
    """
    # Each comparison: (number, other number, allowed difference beside some roundings of the number itself).
    # First the arrays that belong to no Gaussian; then means and covariances of the Gaussians, and of derivatives.
    no_difference = np.zeros(())
    comparisons = [(a, b, no_difference) for a, b in zip(_other_leaves(states), _other_leaves(others), strict=True)]
    largest_slopes = _find_largest_slopes(others if among is None else among)
    # A state lists each Gaussian and then its derivatives, which are compared in units of the Gaussian's deviations.
    for x, y in zip(_moving_parts(states), _moving_parts(others), strict=True):
        p, q = np.asarray(x.covariance), np.asarray(y.covariance)
        if isinstance(y, Gaussian):
            deviation, deviation_products = _deviations(q)  # also of the derivatives that follow
            ratio = np.abs(y.mean) / np.where(deviation > 0, deviation, np.inf)
            mean_tolerance = tolerance + ROUNDING * np.max(ratio, axis=-1, keepdims=True, initial=0.0)
            size = 1.0
        else:
            size = next(largest_slopes)
        comparisons += [
            (x.mean, y.mean, size * mean_tolerance * deviation),
            (p, q, size * tolerance * deviation_products),
        ]
    agree = [_are_near(*numbers).reshape(len(numbers[0]), -1).all(axis=1) for numbers in comparisons]
    all_agree: np.ndarray = np.all(agree, axis=0)
    return all_agree


def _deviations(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviations (n, k) of covariances (n, k, k), and the products of each two of them (n, k, k)."""
    deviation = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    return deviation, deviation[..., :, None] * deviation[..., None, :]


def _find_largest_slopes(states: PyTree) -> Iterator[float]:
    """Yield the largest entry of each derivative of a Gaussian in the states (n, ...), in the Gaussian's deviations.

    A state holds each Gaussian and, after it, the derivatives of its mean m and covariance P by each parameter. They
    are scaled: |dm_i| / s_i and |dP_ij| / (s_i s_j), with the deviations s.
    """
    for part in _moving_parts(states):
        if isinstance(part, Gaussian):
            gaussian = part
            continue
        deviation, deviation_products = _deviations(np.asarray(gaussian.covariance))
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled_slopes = [
                np.where(unit > 0, np.abs(slope) / unit, 0.0)
                for slope, unit in ((part.mean, deviation), (part.covariance, deviation_products))
            ]
            yield max(float(np.max(slope, initial=0.0, where=np.isfinite(slope))) for slope in scaled_slopes)


def _are_near(a: np.ndarray, b: np.ndarray, within: np.ndarray) -> Bool[np.ndarray, "..."]:
    """Return which entries of a and b are both NaN, or differ by at most `within` plus ROUNDING |b| (16 eps |b|)."""
    with np.errstate(invalid="ignore"):  # infinite entries of both give NaN, which is not near
        near: np.ndarray = np.abs(a - b) <= within + ROUNDING * np.abs(b)
    near |= np.isnan(a) & np.isnan(b)
    return near


def select_state(condition: Array, if_true: PyTree, if_false: PyTree) -> PyTree:
    """Return `if_true` where the condition (a traced boolean) holds, else `if_false`, array by array."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def gaussians_of(state: PyTree) -> list[Gaussian]:
    """Return the Gaussians that a filter's state holds, in the order of its fields."""
    return [part for part in _moving_parts(state) if isinstance(part, Gaussian)]


def means_of(state: PyTree) -> list[Any]:
    """Return all parts of a state that data change: the means of its Gaussians, and the derivatives of these means."""
    return [part.mean for part in _moving_parts(state)]


def with_means(state: PyTree, means: Sequence[Any]) -> PyTree:
    """Return the state with other `means` of its Gaussians and other derivatives of means, as `means_of` lists them."""
    next_mean = iter(means)

    def replace_mean(part: PyTree) -> PyTree:
        """Return a Gaussian, or a derivative of one, with the next of `means`; any other part as it is."""
        return part._replace(mean=next(next_mean)) if _is_moving(part) else part

    return jax.tree.map(replace_mean, state, is_leaf=_is_moving)


def beside_gaussians(state: PyTree) -> PyTree:
    """Return the state with () in place of each Gaussian and each derivative: the parts that data do not change."""
    return jax.tree.map(lambda part: () if _is_moving(part) else part, state, is_leaf=_is_moving)


def with_gaussians(without_gaussians: PyTree, state: PyTree) -> PyTree:
    """Return `state` with its own Gaussians and their derivatives, and all other parts of `without_gaussians`.

    `without_gaussians` is a state as `beside_gaussians` returns it, with () in place of Gaussians and derivatives.
    """
    other_parts = iter(_other_leaves(without_gaussians))
    return jax.tree.map(lambda part: part if _is_moving(part) else next(other_parts), state, is_leaf=_is_moving)


def _moving_parts(state: PyTree) -> list[Any]:
    """Return the Gaussians of a state and their derivatives, in order: the parts with means, which depend on data."""
    return [part for part in jax.tree.leaves(state, is_leaf=_is_moving) if _is_moving(part)]


def _is_moving(part: Any) -> bool:
    """Return whether a part of a state is a Gaussian or its derivatives."""
    return isinstance(part, Gaussian | MomentSlopes)


def _other_leaves(state: PyTree) -> list[np.ndarray]:
    """Return the arrays of a state that belong to no Gaussian and to no derivative of one."""
    leaves: list[np.ndarray] = jax.tree.leaves(beside_gaussians(state))
    return leaves
