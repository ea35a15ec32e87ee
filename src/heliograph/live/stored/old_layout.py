"""Layouts of stored states: shapes by the path of each part, and the parts of older ones as those of now.

Until version 0.3.0 a filter's state held a covariance, `.covariance` (..., n, n), where it holds `.lower` and
`.variances` now. States of more than a Gaussian held its parts themselves, which are those of `.gaussian` now.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.numerics.types import PyTree

MEAN, COVARIANCE, LOWER, VARIANCES = ".mean", ".covariance", ".lower", ".variances"
NESTED = ".gaussian"

Shapes = Mapping[str, Sequence[int]]  # of a state's parts, by their paths
Columns = Mapping[str, Mapping[str, Sequence[Any]]]  # by filter and path a part's shape, and its columns' begin and end


def split_by_path(state: PyTree) -> dict[str, np.ndarray]:
    """Return {path of a state's array, such as ".covariance": the array}, in the state's order."""
    return {
        jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_flatten_with_path(state)[0]
    }


def can_read_layout(old: Shapes, new: Shapes) -> bool:
    """Return whether a state of the layout `old` can be read as one of `new`.

    It can if each part of `new` is in `old` with the same shape, or is a factor of a covariance in `old`. A layout has
    the shape of each part of a state.

    A part is known by its path: a stem and an ending such as ".covariance". A covariance's factors have the endings
    LOWER (L below the diagonal, n (n - 1) / 2 numbers) and VARIANCES (D, n numbers).
    """
    shapes = {path: list(shape) for path, shape in old.items()}
    old_paths = _trace_paths(old, new)  # {new path of a part: its path in `old`, or the one that its factor would have}
    for stem in _find_factored(old, old_paths.values()):
        *leading_axes, n, _ = shapes.pop(stem + COVARIANCE)
        shapes[stem + LOWER], shapes[stem + VARIANCES] = [*leading_axes, n * (n - 1) // 2], [*leading_axes, n]
    return shapes == {old_paths[path]: list(shape) for path, shape in new.items()}


def relocate_parts(parts: Mapping[str, np.ndarray], new: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the parts of an older state by their paths in the present layout, `new`.

    `parts`: arrays by old path, with leading axes if there are several states; `can_read_layout` must hold. A
    covariance P = L D L' is factorised if `new` has its factors: L below the diagonal (path with the ending LOWER) and
    D (VARIANCES).
    """
    results, old_paths = dict(parts), _trace_paths(parts, new)
    for stem in _find_factored(parts, old_paths.values()):
        results[stem + LOWER], results[stem + VARIANCES] = factorise_covariance(results.pop(stem + COVARIANCE))
    return {path: results[old_path] for path, old_path in old_paths.items()}


def describe_old_layout(new: Shapes) -> dict[str, list[int]]:
    """Return the layout that a state of the layout `new` had before version 0.3.0, in its order.

    A covariance P then stood in the place of its factors, L below the diagonal (LOWER) and D (VARIANCES).
    """
    results: dict[str, list[int]] = {}
    for path, shape in new.items():
        old_path = _flatten_path(path)
        stem = old_path.removesuffix(VARIANCES)
        if old_path.endswith(VARIANCES) and results.pop(stem + LOWER, None) is not None:
            results[stem + COVARIANCE] = [*shape, shape[-1]]
        else:
            results[old_path] = list(shape)
    return results


@dataclass
class _StatePart:
    """A part of a filter's state in the columns of a row: its shape, its first column, and the end of its columns."""

    shape: Any
    first: int
    end: int

    @property
    def columns(self) -> range:
        """Return the numbers of its columns."""
        return range(self.first, self.end)


class _LostFlag(NamedTuple):
    """A flag whose columns are not known: the end of the part before it, itself, and the parts after it."""

    end_before: int
    flag: _StatePart
    after: list[_StatePart]


def place_flags(filters: Columns) -> dict[str, dict[str, list[Any]]]:
    """Return the columns of a row's states with the true columns of each boolean part (flag).

    Versions before 0.3.0 wrote a flag's value, 0 or 1, in place of its first column. Each column belongs to one part
    only, so that flags have the columns that are left over. The parts of a filter stand in their order: the flag after
    the earliest part has the first free columns, and so on.
    """
    placed = {name: {path: _StatePart(*part) for path, part in parts.items()} for name, parts in filters.items()}
    taken: set[int] = set()
    found = [_take_columns(list(parts.values()), 0, taken) for parts in placed.values()]
    lost = [each for each in found if each is not None]
    # `lost`: the first flag of each filter that is not placed yet. Placing one shows the next of its filter.
    while lost:
        first = min(lost, key=lambda each: each.end_before)
        lost.remove(first)
        flag = first.flag
        begin = next(i for i in range(len(taken) + 1) if i not in taken)
        flag.first, flag.end = begin, begin + len(flag.columns)
        if (following := _take_columns([flag, *first.after], begin, taken)) is not None:
            lost.append(following)
    return {
        name: {path: [part.shape, part.first, part.end] for path, part in parts.items()}
        for name, parts in placed.items()
    }


def _take_columns(parts: list[_StatePart], end: int, taken: set[int]) -> _LostFlag | None:
    """Add the columns of a filter's parts to `taken`, up to the first flag; return that flag, or None without one.

    A flag is a boolean part, of which old versions wrote the value, 0 or 1, instead of its first column. Example: four
    parts have the first columns 0, 4, 1, 7 as written. The third begins before the end of the second, so it is a flag.
    The columns of the other three are added: those of the fourth too, as 7 is after the second part's end.

    Args:
        parts: the parts of one filter, in their order.
        end: the end of the part before them, 0 if they are the filter's first.
        taken: the columns that are taken; those of the parts are added.
    """
    for i, part in enumerate(parts):
        if _is_lost_flag(part, end, taken):
            # A flag that comes first belongs to the memory of fusions, which stands after all filters.
            end = end or sys.maxsize
            parts_after_flag = parts[i + 1 :]
            for later_part in parts_after_flag:
                if later_part.first >= end:
                    taken.update(later_part.columns)
            return _LostFlag(end, part, parts_after_flag)
        taken.update(part.columns)
        end = max(end, part.end)
    return None


def _is_lost_flag(part: _StatePart, end: int, taken: set[int]) -> bool:
    """Return whether a part is a flag (boolean) whose first column old versions did not write.

    They wrote its value, 0 or 1, in place of the column (`part.first`). Parts stand one after another, so that such a
    number is less than the `end` of the part before. For the filter's first part (`end` is 0) it is the number of a
    column that another filter has `taken`.
    """
    if not part.columns:
        return False
    begins_before_end = part.first < end
    is_first_at_taken_column = end == 0 and part.first in taken
    return begins_before_end or is_first_at_taken_column


def factorise_covariance(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of P = L D L': L's entries below the diagonal (..., n (n - 1) / 2), by row, and D (..., n).

    Many covariances P (..., n, n) are eliminated at once, column by column: with the remainder R, at first P, the pivot
    is D_j = R_jj, the column of L below the diagonal is l = R_ij / D_j (i > j), and R goes on as R - l D_j l'. A pivot
    below n eps times its variance is rounding, and is set to this bound.
    """
    n = covariance.shape[-1]
    remainder, diagonal_of_P = covariance.copy(), np.diagonal(covariance, axis1=-2, axis2=-1)
    L, D = np.zeros_like(remainder), np.zeros_like(diagonal_of_P)
    for j in range(n):
        D[..., j] = pivot = np.maximum(remainder[..., j, j], n * np.finfo(float).eps * diagonal_of_P[..., j])
        column_below, pivot = remainder[..., j + 1 :, j], pivot[..., None]
        quotients = np.divide(column_below, pivot, out=np.zeros_like(column_below), where=pivot > 0)
        L[..., j + 1 :, j] = quotients
        remainder[..., j + 1 :, j + 1 :] -= quotients[..., :, None] * column_below[..., None, :]
    return L[..., *np.tril_indices(n, -1)], D


def _trace_paths(old: Iterable[str], new: Iterable[str]) -> dict[str, str]:
    """Return {path of a part now: its path in an older state}.

    It is the same path, or the path without NESTED: older states held the parts of a Gaussian without nesting.
    """
    old_paths = set(old)
    return {path: path if path in old_paths else _flatten_path(path) for path in new}


def _flatten_path(path: str) -> str:
    """Return the path that a part had before its Gaussian was nested: '.gaussian.mean' stood as '.mean'."""
    stem, dot, name = path.rpartition(".")
    is_part_of_gaussian = dot + name in (MEAN, LOWER, VARIANCES)
    return stem.removesuffix(NESTED) + dot + name if is_part_of_gaussian else path


def _find_factored(old: Iterable[str], new: Iterable[str]) -> list[str]:
    """Return the stems (paths without '.covariance') of covariances in `old` whose factors are in `new` instead.

    The paths of the factors end with LOWER (L below the diagonal) and VARIANCES (D).
    """
    before, now = set(old), set(new)
    stems = [path.removesuffix(COVARIANCE) for path in old if path.endswith(COVARIANCE) and path not in now]
    return [stem for stem in stems if {stem + LOWER, stem + VARIANCES} <= now - before]
