"""Free numbers of a network that is a function of them: starts, ends, and one vector of them all."""

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import Any, NamedTuple

import numpy as np

from heliograph.learning.description import Description, describe
from heliograph.numerics.check import array, fail, items, table
from heliograph.numerics.types import Array, Float
from heliograph.simulation.network import Network

Build = Callable[..., Network]
Vector = Float[np.ndarray, "x"]

YOUNG = "young"  # the scalars in the bound of an uncertain mean gain


class Number(NamedTuple):
    """A free number or array of them: its start, and its least and largest values, of its shape."""

    start: np.ndarray
    low: np.ndarray
    high: np.ndarray


def young_scalars(steps: int) -> Number:
    """Scalar of Young's inequality for each step, or a single one of the steady bound."""
    shape = () if steps == 1 else (steps,)
    return Number(*(np.full(shape, value) for value in (0.1, 1e-6, 1e3)))


class Numbers(NamedTuple):
    """All free numbers as one vector."""

    by_name: dict[str, Number]

    @property
    def start(self) -> Vector:
        """Start of a search."""
        return np.concatenate([number.start.ravel() for number in self.by_name.values()])

    @property
    def low(self) -> Vector:
        """Least values."""
        return np.concatenate([number.low.ravel() for number in self.by_name.values()])

    @property
    def high(self) -> Vector:
        """Largest values."""
        return np.concatenate([number.high.ravel() for number in self.by_name.values()])

    def named(self, x: Array) -> dict[str, Any]:
        """Numbers by name, each in its shape."""
        result, begin = {}, 0
        for name, number in self.by_name.items():
            result[name] = x[begin : begin + number.start.size].reshape(number.start.shape)
            begin += number.start.size
        return result

    def drawn(self, draws: np.random.Generator) -> Vector:
        """Another start: anywhere between the ends, or where there are none by a factor about the first."""
        between = np.isfinite(self.low) & np.isfinite(self.high)
        within = draws.uniform(np.where(between, self.low, 0.0), np.where(between, self.high, 1.0))
        factor = np.exp(draws.normal(size=len(self.low)))
        return np.where(between, within, np.clip(self.start * factor, self.low, self.high))


def as_numbers(free: object) -> Numbers:
    """Free numbers from {name: (start, low, high)}; the start may be an array, the ends numbers or of its shape.

    Raises:
        ValueError: nothing free, ends that do not enclose the start.
    """
    result = {}
    for name, value in table("free", free, "(start, low, high)").items():
        parts = items(f"free number {name!r}", value, "(start, low, high)")
        if len(parts) != 3:
            raise fail(f"free number {name!r}", "(start, low, high)", f"{len(parts)} numbers")
        start = array(f"start of {name!r}", parts[0], (None,) * np.ndim(parts[0]))
        low, high = (_end(name, end, start.shape) for end in parts[1:])
        if not np.all((low <= start) & (start <= high)):
            raise fail(f"free number {name!r}", "a start between its ends", f"{parts[0]} of {parts[1]} to {parts[2]}")
        result[name] = Number(start, low, high)
    if YOUNG in result:
        raise fail("free", f"names other than {YOUNG!r}, which stands for a scalar of the bound", YOUNG)
    if not result:
        raise fail("free", "at least one number (name: (start, low, high))", "none: nothing is free")
    return Numbers(result)


def _end(name: str, end: object, shape: tuple[int, ...]) -> np.ndarray:
    """A least or largest value, which may be infinite, of the start's shape."""
    try:
        value = np.broadcast_to(np.asarray(end, dtype=float), shape)
    except (TypeError, ValueError):
        raise fail(f"end of {name!r}", f"a number, or numbers of shape {shape}", repr(end)) from None
    if np.any(np.isnan(value)):
        raise fail(f"end of {name!r}", "numbers", "nan")
    return value


def function_of_numbers(build: Build, free: object) -> tuple[Build, Numbers]:
    """Function and its free numbers, from {name: (start, low, high)} or, without, from the marks `hg.free` in it.

    Raises:
        ValueError: arguments of the function that are not the free numbers, marks that are no intervals.
    """
    names = list(table("free", free, "(start, low, high)")) if free is not None else []
    try:
        signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise fail("free", "the arguments of the function, (start, low, high) by name", str(error)) from None
    if free is not None:
        return build, as_numbers(free)
    description = describe(build)
    marks = {}
    for mark in description.parameters.every:
        if mark.domain.kind != "interval":
            raise fail(f"free number {mark.name!r}", "one between two limits", f"a {mark.domain.kind}")
        ends = (np.full(mark.start.shape, end) for end in (mark.domain.low, mark.domain.high))
        marks[mark.name] = Number(np.asarray(mark.start), *ends)
    return partial(_with_marks, description), Numbers(marks)


def _with_marks(description: Description, **values: object) -> Network:
    return description.at(values)
