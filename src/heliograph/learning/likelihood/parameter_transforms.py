"""Transforms of free numbers on their domains to unconstrained coordinates (logarithms, logits), and back."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import expit

from heliograph.numerics.check import fail
from heliograph.numerics.domains import Domain
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Float, PyTree


def map_to_unconstrained(name: str, domain: Domain, value: Float[np.ndarray, "..."]) -> Float[np.ndarray, " size"]:
    """Return the start `value` of the free number `name` as unconstrained coordinates (size,).

    A number of an interval becomes v, its logarithm log(v - low) or its logit, as the interval has ends. A simplex
    becomes log(p_i / p_last). A covariance becomes the entries of its Cholesky factor, row after row, with logarithms
    on the diagonal. `domain.kind` says which of these it is; an interval goes from `domain.low` to `domain.high`.

    Raises:
        ValueError: a start that is not inside the domain.
    """
    if domain.kind == "simplex":
        if not np.all(value > 0) or np.any(np.abs(value.sum(axis=-1) - 1) > 1e-9):
            raise fail(f"start of {name}", "positive probabilities that sum to 1", value.tolist())
        logs: np.ndarray = np.log(value[..., :-1] / value[..., -1:])
        return logs.reshape(-1)
    if domain.kind == "covariance":
        factor = _factorise_start(name, value)
        np.fill_diagonal(factor, np.log(np.diagonal(factor)))
        return np.asarray(factor[np.tril_indices(len(value))])
    if np.any(value <= domain.low) or np.any(value >= domain.high):
        raise fail(f"start of {name}", f"a start {_describe_domain(domain)}", value.tolist())
    return np.asarray(to_unconstrained(domain, value)).reshape(-1)


def map_from_unconstrained(domain: Domain, shape: tuple[int, ...], x: Array) -> Array:
    """Return the number of this shape whose unconstrained coordinates are x (size,), inverting `map_to_unconstrained`.

    A fit searches over unconstrained coordinates, so that every step of it gives a number inside its domain. JAX can
    trace x; plain coordinates of an interval give a plain number.

    Args:
        domain: probabilities that sum to 1 ("simplex"), a covariance, or an interval from `low` to `high`.
        shape: shape of the number.
        x: its coordinates (size,).
    """
    if domain.kind == "simplex":
        return _map_to_simplex(shape, x)
    # A covariance L L', with the entries of L row by row, those on its diagonal by their logarithms.
    if domain.kind == "covariance":
        factor = jnp.zeros(shape).at[np.tril_indices(shape[0])].set(x)
        of_diagonal = jnp.exp(jnp.diag(jnp.diag(factor)))  # of the diagonal alone, as other entries might overflow
        factor = jnp.where(np.eye(shape[0], dtype=bool), of_diagonal, factor)
        return factor @ factor.T
    # An interval: by the logistic function between two ends, an exponential from one, as it is without ends.
    xp = library(x)
    coordinates: Array = xp.reshape(x, shape)
    has_low, has_high = np.isfinite(domain.low), np.isfinite(domain.high)
    if has_low and has_high:
        logistic = expit if xp is np else jax.nn.sigmoid
        return domain.low + (domain.high - domain.low) * logistic(coordinates)
    if not (has_low or has_high):
        return coordinates
    with np.errstate(over="ignore"):  # to infinity, far from the end
        distance: Array = xp.exp(coordinates)
    return domain.low + distance if has_low else domain.high - distance


def _map_to_simplex(shape: tuple[int, ...], x: Array) -> Array:
    """Return probabilities p_i = exp(x_i) / sum_j exp(x_j) over the last axis, where the last one has x = 0.

    `shape`: of the probabilities.
    """
    rows = jnp.reshape(x, (*shape[:-1], shape[-1] - 1))
    logs = jnp.concatenate([rows, jnp.zeros((*shape[:-1], 1))], axis=-1)
    # Subtract the maximum so that exp cannot overflow.
    weights = jnp.exp(logs - jnp.max(logs, axis=-1, keepdims=True))
    return weights / jnp.sum(weights, axis=-1, keepdims=True)


def to_unconstrained(domain: Domain, value: PyTree) -> PyTree:
    """Return an unconstrained number for one of an interval: its logit if that has two ends, else its logarithm.

    The logarithm is of the distance from the only end. Without ends the number stays as it is. `domain`: an interval
    from `low` to `high`, infinite where it has no end.
    """
    if np.isfinite(domain.low) and np.isfinite(domain.high):
        return np.log((value - domain.low) / (domain.high - value))
    if np.isfinite(domain.low):
        return np.log(value - domain.low)
    return np.log(domain.high - value) if np.isfinite(domain.high) else value


def from_unconstrained(domain: Domain, value: PyTree) -> PyTree:
    """Return the number of the interval that `to_unconstrained` maps to this value; an infinite value gives an end.

    `domain`: an interval from `low` to `high`, infinite where it has no end.
    """
    with np.errstate(over="ignore"):
        if np.isfinite(domain.low) and np.isfinite(domain.high):
            return domain.low + (domain.high - domain.low) / (1 + np.exp(-value))
        if np.isfinite(domain.low):
            return domain.low + np.exp(value)
        return domain.high - np.exp(value) if np.isfinite(domain.high) else value


def slope_from_unconstrained(domain: Domain, value: PyTree) -> PyTree:
    """Return the derivative of `from_unconstrained` at an unconstrained value.

    By the chain rule it takes an error of the unconstrained value to one of the number. `domain`: an interval from
    `low` to `high`, infinite where it has no end.
    """
    if np.isfinite(domain.low) and np.isfinite(domain.high):
        return (domain.high - domain.low) / (2 * np.cosh(value / 2)) ** 2
    if np.isfinite(domain.low):
        return np.exp(value)
    return -np.exp(value) if np.isfinite(domain.high) else np.ones_like(value)


def slope_to_unconstrained(domain: Domain, value: PyTree) -> PyTree:
    """Return the derivative of `to_unconstrained` at a number of the interval.

    By the chain rule it takes an error of the number to one of its logarithm or logit. `domain`: an interval from `low`
    to `high`, infinite where it has no end.
    """
    if np.isfinite(domain.low) and np.isfinite(domain.high):
        return (domain.high - domain.low) / ((value - domain.low) * (domain.high - value))
    if np.isfinite(domain.low):
        return 1 / (value - domain.low)
    return -1 / (domain.high - value) if np.isfinite(domain.high) else np.ones_like(value)


def count_coordinates(domain: Domain, shape: tuple[int, ...]) -> int:
    """Return how many unconstrained coordinates a number of this domain and shape has.

    Those that have to fulfil a condition have fewer coordinates than entries: probabilities sum to 1, a covariance is
    symmetric.

    Args:
        domain: an interval, probabilities that sum to 1 over the last axis ("simplex"), or a covariance.
        shape: the number's shape.
    """
    entries = int(np.prod(shape))
    if domain.kind == "simplex":
        # The probabilities of each distribution (last axis) sum to 1: one of them is not free.
        distributions = entries // shape[-1]
        return entries - distributions
    if domain.kind == "covariance":
        return shape[0] * (shape[0] + 1) // 2  # entries on and below the diagonal
    return entries


def _factorise_start(name: str, value: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor L of the start L L' of the free number `name`; raise ValueError if there is none."""
    try:
        return np.linalg.cholesky(value)
    except np.linalg.LinAlgError:
        raise fail(f"start of {name}", "a positive definite matrix", value.tolist()) from None


def _describe_domain(domain: Domain) -> str:
    """Return in words where an interval's numbers lie."""
    if np.isfinite(domain.low) and np.isfinite(domain.high):
        return f"between {domain.low:g} and {domain.high:g}"
    return f"above {domain.low:g}" if np.isfinite(domain.low) else f"below {domain.high:g}"
