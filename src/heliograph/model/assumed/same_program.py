"""Whether two functions are the same program: equal operations, in order, on equal constants."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from heliograph.numerics.module import are_same

ASIDE = ("name", "jvp_jaxpr_fun", "fwd_jaxpr_thunk", "bwd")  # labels, and rules of derivatives beside the program


def same_function(f: Callable[..., Any], g: Callable[..., Any], *shapes: tuple[int, ...]) -> bool:
    """Return whether two functions of arrays are the same object, or the same program when JAX traces them.

    Args:
        f: one function, written with jax.numpy.
        g: the other.
        shapes: shapes of the arguments.
    """
    if are_same(f, g):
        return True
    try:
        with jax.enable_x64(True):
            programs = [jax.make_jaxpr(function)(*map(np.zeros, shapes)) for function in (f, g)]
    except Exception:  # a function that cannot be traced equals only itself
        return False
    return _same_parameter(*programs)


def _same_parameter(a: Any, b: Any) -> bool:
    """Return whether parameters of two operations are the same.

    Inner programs (jaxprs) are compared by their operations, lists entry by entry, and everything else by value.
    """
    if isinstance(a, core.ClosedJaxpr) and isinstance(b, core.ClosedJaxpr):
        return are_same(list(a.consts), list(b.consts)) and _same_program(a.jaxpr, b.jaxpr)
    if isinstance(a, core.Jaxpr) and isinstance(b, core.Jaxpr):
        return _same_program(a, b)
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(_same_parameter, a, b))
    return are_same(a, b)


def _same_program(a: core.Jaxpr, b: core.Jaxpr) -> bool:
    """Return whether two programs (jaxprs) do the same operations in the same order, whatever variables are called.

    A program is a list of operations (`eqns`) with inputs, outputs and parameters. Variables get numbers in the order
    in which they appear, by which they are compared. ASIDE: parameters that change no result, such as labels.
    """
    if len(a.eqns) != len(b.eqns):
        return False
    names: tuple[dict[Any, int], dict[Any, int]] = {}, {}
    _number_variables(names, [*a.constvars, *a.invars], [*b.constvars, *b.invars])
    for x, y in zip(a.eqns, b.eqns, strict=True):
        if x.primitive is not y.primitive or x.params.keys() != y.params.keys():
            return False
        if not _same_atoms(names, x.invars, y.invars):
            return False
        if not all(_same_parameter(x.params[key], y.params[key]) for key in x.params if key not in ASIDE):
            return False
        _number_variables(names, x.outvars, y.outvars)
    return _same_atoms(names, a.outvars, b.outvars)


def _number_variables(names: tuple[dict[Any, int], dict[Any, int]], a: Sequence[Any], b: Sequence[Any]) -> None:
    """Number the variables a of one program and b of the other in the order given, after those numbered before.

    `names` has for each program the number of each variable, and is changed in place. Variables of two programs that
    have the same number play the same part.
    """
    for known, variables in zip(names, (a, b), strict=True):
        known.update({variable: len(known) + i for i, variable in enumerate(variables)})


def _same_atoms(names: tuple[dict[Any, int], dict[Any, int]], a: Sequence[Any], b: Sequence[Any]) -> bool:
    """Return whether the operands of two operations are the same one by one (`_same_atom`).

    `names`: for each program, the number of each variable.
    """
    if len(a) != len(b):
        return False
    return all(_same_atom(names, x, y) for x, y in zip(a, b, strict=True))


def _same_atom(names: tuple[dict[Any, int], dict[Any, int]], x: Any, y: Any) -> bool:
    """Return whether the operand x of one program and y of another are equal constants, or the same variable.

    Variables are the same if they have the same number and type.

    `names`: for each program, the number of each variable in order of appearance.
    """
    if isinstance(x, core.Literal) and isinstance(y, core.Literal):
        return are_same(np.asarray(x.val), np.asarray(y.val))
    if isinstance(x, core.Literal) or isinstance(y, core.Literal):
        return False
    numbers_in_a, numbers_in_b = names
    has_same_type = x.aval == y.aval
    return numbers_in_a[x] == numbers_in_b[y] and has_same_type
