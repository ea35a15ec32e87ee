"""Which engine computes a function of one run: native code where it takes the program, else XLA.

The environment variable HELIOGRAPH_ENGINE forces one: "native", which refuses what it does not take, or "xla".
"""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np

from heliograph.codegen.compiled import Compiled
from heliograph.codegen.graph import Unsupported
from heliograph.codegen.machine import target
from heliograph.codegen.program import lower
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree

Code = TypeVar("Code")

SETTING = "HELIOGRAPH_ENGINE"
COMPILED = 256  # functions whose code is held at once
ENGINES = ("native", "xla")


class Choice(NamedTuple):
    """The code of a function, or why XLA computes it; `values` are the arrays that the function itself holds."""

    code: Compiled | None
    why: str
    values: tuple[Any, ...] = ()

    def __call__(self, *arguments: PyTree) -> PyTree:
        """The function's results for all runs."""
        assert self.code is not None
        return self.code(*self.values, *jax.tree.leaves(arguments))


def engine_of(function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """Say which engine computes a function of one run over runs of these arguments, and why.

    "native: 1902 operations", or "xla: " and the operation that native code does not take, with its line. The
    environment variable HELIOGRAPH_ENGINE forces "native" or "xla".

    Raises:
        ValueError: an engine that is none.
    """
    one = [jax.tree.map(lambda x: np.asarray(x)[0], a) for a in arguments]
    choice = chosen(function, one, [True] * len(one))
    return f"xla: {choice.why}" if choice.code is None else f"native: {choice.code.code.operations} operations"


def chosen(function: Callable[..., PyTree], examples: Sequence[PyTree], differs: Sequence[bool]) -> Choice:
    """The code of a function of one run for arguments like these, made once; or why there is none.

    Each argument differs between runs, with a leading axis, or is the same in all.

    Raises:
        ValueError: an engine that is none, or native code asked for of a program that it does not take.
    """
    engine = setting()
    if engine == "xla":
        return Choice(None, f"{SETTING} is set to it")
    choice = _available() or _cached(function, examples, differs)
    if choice.code is None and engine == "native":
        raise fail("native code", "a program of operations that it takes", choice.why)
    return choice


def setting() -> str:
    """The engine that is forced, "" where none is.

    Raises:
        ValueError: an engine that is none.
    """
    engine = os.environ.get(SETTING, "")
    if engine not in ("", *ENGINES):
        raise fail(SETTING, " or ".join(ENGINES), engine)
    return engine


def attempted(make: Callable[[], Code]) -> Code | None:
    """Native code as it is made, None where XLA is to compute instead.

    Raises:
        ValueError: an engine that is none, or native code asked for of a program that it does not take.
    """
    engine = setting()
    if engine == "xla" or _available() is not None:
        return None
    try:
        return make()
    except Unsupported as found:
        if engine == "native":
            raise fail("native code", "a program of operations that it takes", str(found)) from None
        return None


@cache
def _available() -> Choice | None:
    """None where this machine has native code; it is said once where it has not."""
    try:
        target()
    except RuntimeError as error:
        warnings.warn(f"native code: expected a processor that LLVM knows, got {error}; XLA computes", stacklevel=4)
        return Choice(None, "LLVM does not know this processor")
    return None


def _cached(function: Callable[..., PyTree], examples: Sequence[PyTree], differs: Sequence[bool]) -> Choice:
    """A function may be an object that holds arrays: they are arguments, the same in all runs."""
    parts, form = jax.tree.flatten(function)
    held = tuple(isinstance(x, np.ndarray | jax.Array) for x in parts)
    values = tuple(np.asarray(x) for x, h in zip(parts, held, strict=True) if h)
    fixed = tuple(None if h else x for x, h in zip(parts, held, strict=True))
    leaves, tree = jax.tree.flatten(list(examples))
    each = tuple(d for e, d in zip(examples, differs, strict=True) for _ in jax.tree.leaves(e))
    try:
        code, why = _made(form, fixed, held, tree, tuple(map(_kind, (*values, *leaves))), each)
    except TypeError as error:
        if "unhashable" not in str(error):
            raise
        return Choice(None, f"the function holds what cannot be told from another: {error}")
    return Choice(code, why, values)


def _kind(value: Any) -> tuple[tuple[int, ...], np.dtype]:
    return np.shape(value), np.asarray(value).dtype


@lru_cache(COMPILED)
def _made(
    form: Any, fixed: tuple[Any, ...], held: tuple[bool, ...], tree: Any, kinds: tuple[Any, ...], each: tuple[bool, ...]
) -> tuple[Compiled | None, str]:
    """Code for one structure and one set of shapes."""
    count = sum(held)

    def call(*leaves: Any) -> PyTree:
        values = iter(leaves[:count])
        function = jax.tree.unflatten(form, [next(values) if h else x for x, h in zip(fixed, held, strict=True)])
        return function(*jax.tree.unflatten(tree, leaves[count:]))

    try:
        program = lower(call, *(jax.ShapeDtypeStruct(*kind) for kind in kinds))
        return Compiled(program, [False] * count + list(each)), ""
    except Unsupported as found:
        return None, str(found)
