"""Cases of an operation: a function of one run's arrays, and runs of edge values for it."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np

DTYPES = (np.float64, np.bool_, np.int32, np.int64, np.uint32, np.uint64)
REALS = np.array([
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 1.5, 2.5, -2.5, 3.0, 0.49999999999999994, 1e-300,
    2.0**31 - 0.5, 2.0**31, -(2.0**31) - 1, 2.0**32, 2.0**53 + 2, 2.0**63, -(2.0**63), 2.0**64, 1e300, -1e300,
    np.pi, 1e-9, 30.5, -30.0, 170.0,
])  # fmt: skip
TRUTHS = np.array([False, True])


def numbers(dtype: Any) -> np.ndarray:
    """Edge values of a type: NaN, infinities, both zeros, halves; of integers both ends and what is near zero."""
    if dtype == np.float64:
        return REALS
    if dtype == np.float32:
        return REALS[~(np.isfinite(REALS) & (np.abs(REALS) > 1e38))].astype(dtype)
    if dtype == np.bool_:
        return TRUTHS
    ends = np.iinfo(dtype)
    near = [0, 1, 2, 3, 7, 31, 32, 33, 63, 64, 65]
    low = [-1, -2, -7] if ends.min < 0 else []
    return np.array([ends.min, ends.min + 1, *low, *near, ends.max - 1, ends.max], dtype)


class Case(NamedTuple):
    """A function of one run's arrays, its arguments with a leading axis of runs, and what may differ.

    `units`: of rounding, by which a result may differ; beside 0 only for what is computed in another order or way.
    """

    function: Callable[..., Any]
    arguments: tuple[np.ndarray, ...]
    units: float = 0.0
    label: str = ""

    @property
    def runs(self) -> int:
        """Count of runs."""
        return len(self.arguments[0])

    def row(self, run: int) -> tuple[np.ndarray, ...]:
        """One run's arguments."""
        return tuple(a[run] for a in self.arguments)


class Table(Mapping[str, list[Case]]):
    """Cases by operation, each made when it is asked for: what JAX takes is found by tracing it."""

    def __init__(self, makers: Mapping[str, Callable[[], list[Case]]]):
        self._makers, self._made = makers, dict[str, list[Case]]()

    def __getitem__(self, name: str) -> list[Case]:
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


def in_single(case: Case, units: float) -> Case:
    """Return the case with reals of single precision; runs with a number that is beyond that are left out."""
    with np.errstate(over="ignore"):
        floats = tuple(a.astype(np.float32) if a.dtype == np.float64 else a for a in case.arguments)
    pairs_ = zip(case.arguments, floats, strict=True)
    beyond = [np.isfinite(a) != np.isfinite(f) for a, f in pairs_ if f.dtype == np.float32]
    kept = ~np.any([b.reshape(case.runs, -1).any(axis=1) for b in beyond], axis=0)
    return case._replace(arguments=tuple(f[kept] for f in floats), units=units, label=f"{case.label} in single")


def pairs(*tables: np.ndarray) -> tuple[np.ndarray, ...]:
    """Every combination of entries, as runs."""
    places = np.array(list(product(*(range(len(t)) for t in tables)))).T
    return tuple(t[p] for t, p in zip(tables, places, strict=True))


def is_taken(function: Callable[..., Any], arguments: Sequence[np.ndarray]) -> bool:
    """Whether JAX takes arguments of these types."""
    with jax.enable_x64(True):
        try:
            jax.eval_shape(function, *arguments)
        except (TypeError, ValueError):
            return False
    return True


def of_each_type(
    function: Callable[..., Any], arity: int, units: float = 0.0, mixed: bool = False, dtypes: Iterable[Any] = DTYPES
) -> list[Case]:
    """Cases of a function of scalars for every type that it takes; `mixed`: also of different types."""
    combinations = product(dtypes, repeat=arity) if mixed else ((d,) * arity for d in dtypes)
    cases = []
    for types in combinations:
        arguments = pairs(*map(numbers, types))
        if is_taken(function, [a[0] for a in arguments]):
            cases.append(Case(function, arguments, units, " ".join(np.dtype(t).name for t in types)))
    return cases
