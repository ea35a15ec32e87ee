"""The free numbers of a network that is a function of them: starts, ends, and one vector of them all."""

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


def scalars_of_young(steps: int) -> Number:
    """One scalar for each step, or one of the steady bound."""
    shape = () if steps == 1 else (steps,)
    return Number(*(np.full(shape, value) for value in (0.1, 1e-6, 1e3)))


class Numbers(NamedTuple):
    """All free numbers as one vector."""

    each: dict[str, Number]

    @property
    def start(self) -> Vector:
        """Where a search begins."""
        return np.concatenate([one.start.ravel() for one in self.each.values()])

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """The least and the largest."""
        low, high = (
            [part.ravel() for part in parts]
            for parts in zip(*((n.low, n.high) for n in self.each.values()), strict=True)
        )
        return np.concatenate(low), np.concatenate(high)

    def named(self, x: Array) -> dict[str, Any]:
        """The numbers by name, each in its shape."""
        result, begin = {}, 0
        for name, one in self.each.items():
            result[name] = x[begin : begin + one.start.size].reshape(one.start.shape)
            begin += one.start.size
        return result

    def drawn(self, draws: np.random.Generator) -> Vector:
        """Another start: anywhere between the ends, or where there are none by a factor about the first."""
        low, high = self.ends
        between = np.isfinite(low) & np.isfinite(high)
        within = draws.uniform(np.where(between, low, 0.0), np.where(between, high, 1.0))
        return np.where(between, within, np.clip(self.start * np.exp(draws.normal(size=len(low))), low, high))


def as_numbers(free: object) -> Numbers:
    """{name: (start, low, high)}; the start may be an array, and the ends numbers or arrays of its shape.

    Raises:
        ValueError: nothing free, ends that do not enclose the start.
    """
    found = {}
    for name, given in table("free", free, "(start, low, high)").items():
        parts = items(f"free number {name!r}", given, "(start, low, high)")
        if len(parts) != 3:
            raise fail(f"free number {name!r}", "(start, low, high)", f"{len(parts)} numbers")
        start = array(f"start of {name!r}", parts[0], (None,) * np.ndim(parts[0]))
        low, high = (_end(name, end, start.shape) for end in parts[1:])
        if not np.all((low <= start) & (start <= high)):
            raise fail(f"free number {name!r}", "a start between its ends", f"{parts[0]} of {parts[1]} to {parts[2]}")
        found[name] = Number(start, low, high)
    if YOUNG in found:
        raise fail("free", f"names other than {YOUNG!r}, which stands for a scalar of the bound", YOUNG)
    if not found:
        raise fail("free", "at least one number (name: (start, low, high))", "none: nothing is free")
    return Numbers(found)


def _end(name: str, end: object, shape: tuple[int, ...]) -> np.ndarray:
    """A least or largest value, which may be infinite, of the start's shape."""
    try:
        value = np.broadcast_to(np.asarray(end, dtype=float), shape)
    except (TypeError, ValueError):
        raise fail(f"end of {name!r}", f"a number, or numbers of shape {shape}", repr(end)) from None
    if np.any(np.isnan(value)):
        raise fail(f"end of {name!r}", "numbers", "nan")
    return value


def check_arguments(build: Build, free: object) -> None:
    """Raise ValueError unless the function takes the free numbers by name, or without any no arguments."""
    names = list(table("free", free, "(start, low, high)")) if free is not None else []
    try:
        signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise fail("free", "the arguments of the function, (start, low, high) by name", str(error)) from None


def marked(build: Build) -> tuple[Build, Numbers]:
    """A function without arguments as one of the numbers that `hg.free` marks in it, each anywhere it may be."""
    description = describe(build)
    found = {}
    for one in description.parameters.every:
        if one.domain.kind != "interval":
            raise fail(f"free number {one.name!r}", "one between two limits", f"a {one.domain.kind}")
        ends = (np.full(one.start.shape, end) for end in (one.domain.low, one.domain.high))
        found[one.name] = Number(np.asarray(one.start), *ends)
    return partial(_with_marks, description), Numbers(found)


def _with_marks(description: Description, **values: object) -> Network:
    return description.at(values)
