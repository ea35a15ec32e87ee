"""Checks at construction: one line that names the thing, what was expected and what came."""

from typing import Any

import jax
import numpy as np

SYMMETRY_TOLERANCE = 1e-10  # relative to the largest entry: covariances are computed, so rounding is allowed
DEFINITENESS_TOLERANCE = 1e-10  # relative to the largest eigenvalue, for the same reason
PROBABILITY_TOLERANCE = 1e-9  # sums of decimal fractions such as .1 + .2 + .7


def fail(name: str, expected: str, got: object) -> ValueError:
    """Build the one error that every check raises: name, expectation, what came."""
    return ValueError(f"{name}: expected {expected}, got {got}")


def array(name: str, value: Any, shape: tuple[int | None, ...]) -> Any:
    """Return `value` as a finite float64 array of the given shape (None: any length); traced values pass through."""
    if isinstance(value, jax.Array):  # inside a compiled function: shapes were checked outside
        return value
    try:
        result = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise fail(name, "an array of numbers", repr(value)[:60]) from None
    matches = result.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, result.shape, strict=True)
    )
    if not matches:
        want = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
        raise fail(name, f"shape {want}", f"shape {result.shape}")
    if not np.all(np.isfinite(result)):
        raise fail(name, "finite numbers", f"{np.count_nonzero(~np.isfinite(result))} that are not finite")
    return result


def scalar(name: str, value: Any, low: float = -np.inf, high: float = np.inf) -> Any:
    """Return `value` as a finite scalar between `low` and `high`."""
    result = array(name, value, ())
    if not isinstance(result, jax.Array) and not low <= result <= high:
        raise fail(name, f"a number from {low:g} to {high:g}", f"{float(result):g}")
    return result


def check_count(name: str, value: Any) -> int:
    """Return a whole number of at least one."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise fail(name, "a positive whole number", value)
    return int(value)


def covariance(name: str, value: Any, dimension: int | None = None) -> Any:
    """Return a symmetric positive semidefinite matrix; a scalar is taken as that multiple of the identity.

    Raises:
        ValueError: wrong shape, not finite, not symmetric, or with a negative eigenvalue.
    """
    if dimension is not None and np.ndim(value) == 0 and not isinstance(value, jax.Array):
        value = scalar(name, value) * np.eye(dimension)
    result = array(name, value, (dimension, dimension))
    if isinstance(result, jax.Array):
        return result
    if result.shape[0] != result.shape[1]:
        raise fail(name, "a square matrix", f"shape {result.shape}")
    largest = np.max(np.abs(result), initial=0.0)
    skew = np.max(np.abs(result - result.T), initial=0.0)
    if skew > SYMMETRY_TOLERANCE * largest:
        raise fail(name, "a symmetric matrix", f"entries that differ by {skew:.3g} across the diagonal")
    smallest = np.min(np.linalg.eigvalsh(result), initial=np.inf)
    if smallest < -DEFINITENESS_TOLERANCE * largest:
        raise fail(name, "a positive semidefinite matrix", f"smallest eigenvalue {smallest:.3g}")
    return (result + result.T) / 2


def probabilities(name: str, value: Any, count: int | None = None) -> Any:
    """Return non-negative numbers that sum to one."""
    result = array(name, value, (count,))
    if isinstance(result, jax.Array):
        return result
    if np.any(result < 0):
        raise fail(name, "no negative probability", result.tolist())
    if abs(result.sum() - 1) > PROBABILITY_TOLERANCE:
        raise fail(name, "probabilities that sum to 1", f"{result.tolist()} with sum {result.sum():.10g}")
    return result


def radii(name: str, value: Any, nominal: np.ndarray) -> Any:
    """Return the radius of each uncertain probability; a scalar is the same radius for each.

    A radius above max(p, 1 - p) is refused: no probability could ever move that far.
    """
    if np.ndim(value) == 0 and not isinstance(value, jax.Array):
        value = np.full(nominal.shape, scalar(name, value))
    result = array(name, value, nominal.shape)
    if isinstance(result, jax.Array):
        return result
    limit = np.maximum(nominal, 1 - nominal)
    if np.any(result < 0) or np.any(result > limit + PROBABILITY_TOLERANCE):
        raise fail(name, f"each radius from 0 to what its probability allows {limit.tolist()}", result.tolist())
    return result


def names(name: str, value: Any, count: int, prefix: str) -> tuple[str, ...]:
    """Return `count` distinct names; None gives prefix0, prefix1, ..."""
    if value is None:
        return tuple(f"{prefix}{i}" for i in range(count))
    result = tuple(str(v) for v in value)
    if len(result) != count or len(set(result)) != count:
        raise fail(name, f"{count} distinct names", list(result))
    return result
