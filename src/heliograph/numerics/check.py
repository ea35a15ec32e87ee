"""Checks at construction: one line that names the thing, what was expected and what came."""

import os
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any, TypeGuard, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.domains import PROBABILITY, REAL, SIMPLEX, Domain, report_covariance, report_domain
from heliograph.numerics.masked_arrays import fill_masked, find_packing, holds_texts_or_dates
from heliograph.numerics.numpy_or_jax import is_traced, warn_of_single
from heliograph.numerics.types import ArrayLike, Names, NameWithUnit

SYMMETRY_TOLERANCE = 1e-10  # of two standard deviations: covariances are computed, so rounding is allowed
DEFINITENESS_TOLERANCE = 1e-10  # eigenvalue of the correlations, for the same reason; none depends on units
TINY = float(np.finfo(np.float64).tiny)  # a lower bound of what is positive
T = TypeVar("T")
MOST = 2**32 - 1  # of runs and steps, since each has a key of its own in which 32 bits count
PROBABILITY_TOLERANCE = 1e-9  # sums of decimal fractions such as .1 + .2 + .7


class InputError(ValueError):
    """Input that cannot be used; any other ValueError is a defect of the package."""


def fail(name: str, expected: str, got: object) -> InputError:
    """Build the one error that every check raises, in one line: name, expectation, what came."""
    return InputError(" ".join(f"{name}: expected {expected}, got {got}".split()))


def show_value(value: object) -> str:
    """Return anything as a short part of one line."""
    return " ".join(repr(value).split())[:60]


def error_text(error: Exception) -> str:
    """Return a user function's error in at most 120 characters, or what to write instead if JAX cannot trace it."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return "one that decides by a value: write jnp.where"
    for raised in (error, error.__cause__):
        if isinstance(raised, jax.errors.TracerArrayConversionError | jax.errors.ConcretizationTypeError):
            return "one that calls NumPy or math: write it with jax.numpy"
    if isinstance(error, TypeError) and "immutable" in str(error):
        return "one that assigns to a part of x: write jnp.stack, or x.at[i].set(value)"
    return " ".join(f"{type(error).__name__}: {error}".split())[:120]


def array(name: str, value: ArrayLike, shape: tuple[int | str | None, ...], missing: bool = False) -> Any:
    """Return a user's value as a float64 array of the given shape, NaN where it is masked; raise ValueError for others.

    Numbers must be real and finite. An array that JAX traces, of which the numbers are not known, keeps its precision,
    and only its shape is checked.

    Args:
        name: what an error calls the value.
        value: numbers in any form that NumPy makes an array of.
        shape: the length of each axis; any length where it is None, or a text, which errors show in its place.
        missing: whether numbers may be NaN, for what did not arrive.
    """
    report_domain(name, value, REAL)
    return check_numbers(name, _read_numbers(name, value), shape, missing)


def check_numbers(name: str, numbers: Any, shape: tuple[int | str | None, ...], missing: bool = False) -> Any:
    """Return an array as it is, not a copy, if it has the shape and its numbers are finite; raise ValueError if not.

    The arguments are those of `array`. Of an array that JAX traces only the shape is checked.
    """
    fixed = [(axis, length) for axis, length in enumerate(shape) if isinstance(length, int)]
    if numbers.ndim != len(shape) or any(numbers.shape[axis] != length for axis, length in fixed):
        raise fail(name, _describe_shape(shape, numbers.ndim), f"shape {numbers.shape}")
    if not isinstance(numbers, np.ndarray):  # traced
        return numbers
    # The sum is finite only if all are, and takes a fifth of the time: only else is each number looked at.
    with np.errstate(all="ignore"):
        if np.isfinite(np.sum(numbers)):
            return numbers
    wrong = np.isinf(numbers) if missing else ~np.isfinite(numbers)
    if np.any(wrong):
        got = f"{np.count_nonzero(wrong)} that are not finite"
        raise fail(name, "finite numbers, or NaN for what is missing" if missing else "finite numbers", got)
    return numbers


def _describe_shape(shape: tuple[int | str | None, ...], dimensions: int) -> str:
    """Return an expected shape in words, for an error, with an example if an array of fewer `dimensions` came."""
    if shape == (None,):
        return "a list of numbers, such as [1, 0]"
    words = ("rows", "columns") if len(shape) == 2 else ("any",) * len(shape)  # for lengths that are free
    lengths = ", ".join(word if length is None else str(length) for length, word in zip(shape, words, strict=True))
    example = ", such as [[1, 0]]" if len(shape) == 2 and dimensions < 2 else ""
    return f"shape ({lengths}){example}"


def check_columns(name: str, table: object, names: Sequence[str] = ()) -> None:
    """Raise ValueError if a table's columns have a name twice, or the `names` in another order, or packed numbers.

    Packed numbers, as files of NetCDF have them, are codes that the reader should have decoded. Only texts count as
    names: an array, or a table whose columns have numbers, has none.
    """
    if packing := find_packing(table):
        raise fail(name, "decoded numbers, as xarray.decode_cf makes them", f"an array with the attribute {packing!r}")
    columns: Any = getattr(table, "columns", None)
    is_table = columns is not None and not callable(columns)
    texts = [column for column in columns if isinstance(column, str)] if is_table else []
    repeated = next((column for column in texts if texts.count(column) > 1), None)
    if repeated is not None:
        raise fail(name, "distinct columns", f"{repeated!r} more than once")
    if texts != list(names) and sorted(texts) == sorted(names):
        raise fail(name, f"columns in the order {', '.join(names)}", ", ".join(texts))


def _read_numbers(name: str, value: ArrayLike) -> Any:
    """Return a user's real numbers as an array of doubles, or as JAX traces them; raise ValueError for anything else.

    Masked numbers become NaN. Whole numbers and flags that are traced become floats.
    """
    traced = is_traced(value)
    if not traced:
        check_columns(name, value)
    try:
        numbers = jnp.asarray(value) if traced else np.asarray(fill_masked(value))
        if isinstance(numbers, np.ndarray) and holds_texts_or_dates(numbers):
            raise ValueError
        known = None if traced else numbers.astype(np.float64 if numbers.dtype.kind != "c" else complex)
    except (TypeError, ValueError, OverflowError):
        raise fail(name, "an array of numbers", show_value(value)) from None
    if np.issubdtype(numbers.dtype, np.complexfloating):
        raise fail(name, "real numbers", "complex ones")
    if known is not None:
        if isinstance(value, jax.Array):
            warn_of_single(name, value)
        return known
    return numbers if jnp.issubdtype(numbers.dtype, jnp.floating) else numbers.astype(float)


def scalar(name: str, value: ArrayLike, low: float = -np.inf, high: float = np.inf) -> Any:
    """Return `value` as a finite scalar from `low` to `high`; it may be traced and unchecked, but not True or False."""
    if isinstance(value, bool | np.bool_):
        raise fail(name, _describe_range(low, high), show_value(value))
    report_domain(name, value, Domain(low=low, high=high))
    number = array(name, value, ())
    if not is_traced(number) and not low <= number <= high:
        raise fail(name, _describe_range(low, high), f"{float(number):g}")
    return number


def _describe_range(low: float, high: float) -> str:
    """Return in words, for an error, which numbers lie between two limits, either of which may be infinite."""
    if 0 < low <= TINY:  # the least positive double: a bound that says no more than "positive"
        return "a positive number" + (f" up to {high:g}" if high < np.inf else "")
    return f"a number of at least {low:g}" if high == np.inf else f"a number from {low:g} to {high:g}"


def items(name: str, value: object, what: str) -> list[Any]:
    """Return the items of a list, tuple or other iterable; raise ValueError for others, texts, mappings and sets."""
    try:
        if isinstance(value, str | bytes | Mapping | AbstractSet):
            raise TypeError
        return list(cast(Iterable[object], value))
    except TypeError:
        raise fail(name, f"a list of {what}", show_value(value)) from None


def table(name: str, value: object, what: str) -> dict[str, Any]:
    """Return a copy of a dictionary whose keys are names; raise ValueError, expecting one of `what`, for others."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise fail(name, f"a dictionary of {what} by name", show_value(value))
    return dict(value)


def spread_over_names(name: str, value: T | Mapping[str, T], names: Sequence[str], whom: str = "node") -> list[T]:
    """Return one value for each of `names`, from one value for all of them or a dictionary with exactly these keys."""
    if not isinstance(value, Mapping):
        return [value] * len(names)
    if set(value) != set(names):
        raise fail(name, f"one for each {whom} of {list(names)[:5]}", f"others: {sorted(set(value) ^ set(names))[:3]}")
    return [value[key] for key in names]


def instance(name: str, value: object, kind: type[T], what: str) -> T:
    """Return the value if it is an object of class `kind`; raise ValueError, with `what` was expected, if not."""
    if not isinstance(value, kind):
        raise fail(name, what, show_value(value))
    return value


def function(name: str, value: object, of: str) -> Any:
    """Return the value if it can be called; raise ValueError, which expects a function of `of`, if not."""
    if not callable(value):
        raise fail(name, f"a function of {of}", show_value(value))
    return value


def check_progress(value: object, of: str) -> None:
    """Raise ValueError unless `value` can report progress: a function of `of`, or None for no reports."""
    if value is not None:
        function("progress", value, of)


def file_path(name: str, value: object) -> Path:
    """Return a value as the path of a file or folder; raise ValueError for anything else."""
    if not isinstance(value, str | os.PathLike) or "\0" in os.fspath(value):
        raise fail(name, "a path", show_value(value))
    return Path(value)


def rank(name: str, value: object) -> int:
    """Return the number of axes of what may become an array; raise ValueError for anything else."""
    try:
        return np.ndim(cast(ArrayLike, value))
    except (TypeError, ValueError, OverflowError):  # rows of different lengths, a set of arrays, a key
        raise fail(name, "an array of numbers", show_value(value)) from None


def flag(name: str, value: object) -> bool:
    """Return a value that is True or False; raise ValueError for anything else."""
    if not isinstance(value, bool | np.bool_):
        raise fail(name, "True or False", show_value(value))
    return bool(value)


def text(name: str, value: object) -> str:
    """Return the value if it is a text; raise ValueError, which names it, for anything else."""
    return instance(name, value, str, "a text")


def repeat_per_step(name: str, value: ArrayLike, count: int) -> np.ndarray:
    """Return numbers (count,), one for each step, from one number for all steps or a list of one for each."""
    numbers: np.ndarray = np.broadcast_to(array(name, value, (count,) if rank(name, value) else ()), (count,))
    return numbers


def is_whole(value: object) -> TypeGuard[int | np.integer]:
    """Return whether it is a whole number: an int or one of NumPy's, of which a span of time is none."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)


def check_count(name: str, value: object, least: int = 1) -> int:
    """Return a whole number from `least` to MOST (2^32 - 1), an int or NumPy's; raise ValueError for others."""
    if not is_whole(value) or value < least:
        expected = "a positive whole number" if least == 1 else f"a whole number of at least {least}"
        raise fail(name, expected, value if isinstance(value, int | float) else show_value(value))
    if value > MOST:
        raise fail(name, f"at most {MOST}", value)
    return int(value)


def check_seed(name: str, value: object) -> int:
    """Return a whole number from 0 to MOST (2^32 - 1), the 32 bits of a seed; raise ValueError for others."""
    if not is_whole(value) or not 0 <= value <= MOST:
        raise fail(name, f"a whole number from 0 to {MOST}", show_value(value))
    return int(value)


def check_horizon(value: object, covered: int | None = None) -> int:
    """Return a number of steps, at most the `covered` steps of something that varies (None: nothing varies)."""
    horizon = check_count("horizon", value)
    if covered is not None and horizon > covered:
        raise fail("horizon", f"at most {covered} steps, which what varies over time covers", horizon)
    return horizon


def covariance(name: str, value: ArrayLike, dimension: int | None = None) -> Any:
    """Return a value checked to be a symmetric positive semidefinite matrix, made exactly symmetric.

    A number c stands for c I where the `dimension` is known. Of a traced value only the shape is checked.
    """
    report_covariance(name, value)
    matrix = _read_numbers(name, value)
    if dimension is not None and matrix.ndim == 0:  # c, for c I
        matrix = array(name, matrix, ()) * np.eye(dimension)
    if matrix.ndim != 2:
        expected = "a square matrix, such as [[4, 0], [0, 1]], or [[4]] of one component"
        raise fail(name, expected, f"shape {matrix.shape}")
    matrix = array(name, matrix, (dimension, dimension))
    if matrix.shape[0] != matrix.shape[1]:
        raise fail(name, "a square matrix", f"shape {matrix.shape}")
    if is_traced(matrix):
        return matrix / 2 + matrix.T / 2  # the sum of two large variances may overflow
    # Symmetry and definiteness are judged by correlations P_ij / (d_i d_j), so that neither depends on units.
    deviations = standard_deviations(matrix)
    asymmetry = np.abs(matrix - matrix.T)
    if np.any(asymmetry > SYMMETRY_TOLERANCE * np.outer(deviations, deviations)):
        raise fail(name, "a symmetric matrix", f"entries that differ by {np.max(asymmetry):.3g} across the diagonal")
    correlations = matrix / np.outer(deviations, deviations)
    eigenvalues = np.diagonal(correlations) if is_diagonal(correlations) else np.linalg.eigvalsh(correlations)
    smallest = np.min(eigenvalues, initial=np.inf)
    if smallest < -DEFINITENESS_TOLERANCE:
        raise fail(name, "a positive semidefinite matrix", f"smallest eigenvalue {np.linalg.eigvalsh(matrix)[0]:.3g}")
    return matrix / 2 + matrix.T / 2  # halves first: the sum of two large variances may overflow


def is_diagonal(matrix: np.ndarray) -> bool:
    """Return whether a square matrix is zero off its diagonal."""
    return bool(np.count_nonzero(matrix) == np.count_nonzero(np.diagonal(matrix)))


def standard_deviations(matrix: np.ndarray) -> np.ndarray:
    """Return standard deviations (..., n) of covariances (..., n, n), by which a matrix is judged in any units.

    A component of variance zero gets the least deviation that its off-diagonal entries allow, or 1 if all are zero.
    """
    deviations = np.sqrt(np.abs(np.diagonal(matrix, axis1=-2, axis2=-1)))
    divisors = np.where(deviations > 0, deviations, np.inf)  # an entry divided by inf is 0, which allows any deviation
    least_allowed = np.max(np.abs(matrix) / divisors[..., None, :], axis=-1, initial=0.0)
    of_zero_variance = np.where(least_allowed > 0, least_allowed, 1.0)
    return np.asarray(np.where(deviations > 0, deviations, of_zero_variance))


def probabilities(name: str, value: ArrayLike, count: int | None = None) -> Any:
    """Return non-negative numbers (count,) that sum to 1 within PROBABILITY_TOLERANCE; traced ones are not checked."""
    report_domain(name, value, SIMPLEX, PROBABILITY)
    chances = array(name, value, (count,))
    if is_traced(chances):
        return chances
    if np.any(chances < 0):
        raise fail(name, "no negative probability", chances.tolist())
    if abs(chances.sum() - 1) > PROBABILITY_TOLERANCE:
        raise fail(name, "probabilities that sum to 1", f"{chances.tolist()} with sum {chances.sum():.10g}")
    return chances


def radii(name: str, value: ArrayLike, nominal: Any) -> np.ndarray:
    """Return the radius of each uncertain probability; a scalar is the same radius for each.

    A radius is how far p (`nominal`) may be off. Above max(p, 1 - p) it is refused, since p cannot move so far. It
    cannot be traced, nor can p with a positive radius, since the extreme laws are found from the numbers.
    """
    numbers = _read_numbers(name, value)
    if is_traced(numbers):
        raise fail(name, "a number, since the corners of what is possible depend on it", "a traced one")
    radius: np.ndarray = array(name, np.full(nominal.shape, numbers) if numbers.ndim == 0 else numbers, nominal.shape)
    if is_traced(nominal):
        if np.any(radius > 0):
            raise fail(name, "zero, where the probabilities are traced", radius.tolist())
        return radius
    limit = np.maximum(nominal, 1 - nominal)
    if np.any(radius < 0) or np.any(radius > limit + PROBABILITY_TOLERANCE):
        raise fail(name, f"each radius from 0 to what its probability allows {limit.tolist()}", radius.tolist())
    return radius


def name_list(name: str, value: Names) -> list[str]:
    """Return names as a list, none of them blank; a mapping {name: unit} gives names that carry their units."""
    names: list[str]
    if isinstance(value, Mapping):
        names = [NameWithUnit(str(key), text(f"{name}, unit of {key!r}", unit)) for key, unit in value.items()]
    else:
        names = [item if isinstance(item, NameWithUnit) else str(item) for item in items(name, value, "names")]
    if any(not single.strip() for single in names):
        raise fail(name, "names that are not blank", show_value(list(map(str, names))))
    return names


def names(name: str, value: Names | None, count: int, prefix: str) -> tuple[str, ...]:
    """Return `count` distinct names: those given (those of {name: unit} carry units), or prefix0, ... for None."""
    if value is None:
        return tuple(f"{prefix}{i}" for i in range(count))
    distinct = tuple(name_list(name, value))
    if len(distinct) != count or len(set(distinct)) != count:
        raise fail(name, f"{count} distinct names", show_value(list(distinct)))
    return distinct
