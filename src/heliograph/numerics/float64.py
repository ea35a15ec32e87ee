"""Compiled computations in double precision, without flipping JAX's global switch."""

import os
from collections.abc import Callable, Sequence
from functools import cache, wraps
from typing import Literal, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.process.garbage_collector import pause_collector
from heliograph.numerics.types import PyTree

_first: list[int] = []  # the process in which something was computed first; a fork inherits it


def refuse_forked_process() -> None:
    """Raise ValueError in a fork of a process that has computed something; otherwise remember this process.

    `_first` holds the id of the first process that came here. A fork inherits the id, but not JAX's threads.
    """
    here = os.getpid()
    if not _first:
        _first.append(here)
    elif _first[0] != here:
        expected = 'one started anew (multiprocessing.get_context("spawn"))'
        raise fail("process", expected, "a fork of one in which JAX has run, which would hang")


P = ParamSpec("P")
R = TypeVar("R")

Donated = Literal["none", "all-except-first"]  # arguments whose memory the results may take

# The newer way of generating code for a processor takes twice as long and makes code that is a tenth faster. The last
# level of optimisation takes a quarter longer; a network's runs gain 3 to 7 % by it, the cubature kernel 25 %.
# The compiler checks a program again after each of its own passes, a tenth of the time, for those who write passes.
LEVEL = "xla_backend_optimization_level"
Options = dict[str, bool | int | str]
OPTIONS: Options = {"xla_cpu_use_fusion_emitters": False, "xla_disable_hlo_passes": "hlo-verifier", LEVEL: 2}


def quickly_compiled(function: Callable[P, R], donate: Donated = "none") -> Callable[P, R]:
    """Compile a function as `equinox.filter_jit` does, with options that halve the time it takes."""
    return _compile_at_call(function, understood, donate)


def fully_optimised(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a small function that runs millions of steps, at the compiler's last level."""
    return _compile_at_call(function, lambda: {name: value for name, value in understood().items() if name != LEVEL})


def _compile_at_call(
    function: Callable[P, R], options: Callable[[], Options], donate: Donated = "none"
) -> Callable[P, R]:
    """Return the function, compiled at its first call: only then is the compiler asked for its options.

    `options` returns the options of XLA; `donate` says whether results may take the memory of arguments.
    """

    @cache
    def jitted() -> Callable[P, R]:
        """Return the compiled function, the same at every call."""
        program: Callable[P, R] = eqx.filter_jit(function, donate=donate, compiler_options=options())  # type: ignore[call-overload]
        return program

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Return the compiled function's results; the first call for some shapes traces and compiles it."""
        with pause_collector():  # tracing makes many objects that stay
            return jitted()(*args, **kwargs)

    return call


@cache
def in_haste() -> Options:
    """Return the options for a long program that takes few steps: without optimisation it is compiled in a third.

    Of twelve event filters of twelve states the step then takes 0.09 ms for 0.01, and compiles in 11 s for 31.
    """
    return {name: 0 if name == LEVEL else value for name, value in understood().items()}


@cache
def understood() -> Options:
    """Return those of OPTIONS for the compiler XLA that its present release knows, since releases may drop some.

    LEVEL, the optimisation level, is left out if JAX's flag jax_disable_most_optimizations is set, which it would
    override.
    """
    has_no_level = jax.config.values["jax_disable_most_optimizations"]
    names = [name for name in OPTIONS if not (has_no_level and name == LEVEL)]
    return {name: OPTIONS[name] for name in names if _is_understood(name)}


def _is_understood(name: str) -> bool:
    """Return whether this version of XLA knows an entry of OPTIONS, by compiling a trivial program with it."""
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options={name: OPTIONS[name]})()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def to_numpy(tree: PyTree) -> PyTree:
    """Return a tree with its known numeric JAX arrays as NumPy arrays; keys and traced values stay as they are."""

    def convert(leaf: object) -> object:
        """Return a leaf as a NumPy array if it is a known array of numbers; a traced one or random keys as they are."""
        if isinstance(leaf, jax.core.Tracer) or not isinstance(leaf, jax.Array):
            return leaf
        holds_random_keys = jnp.issubdtype(leaf.dtype, jax.dtypes.extended)
        return leaf if holds_random_keys else np.asarray(leaf)

    return jax.tree.map(convert, tree)


def in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, run in double precision (JAX's float64 scope), with NumPy arrays as its results.

    Inside a trace it changes nothing. The same object can thus be called by a user and by a compiled scan, which may
    have chosen single precision.

    Args:
        function: of arrays or model objects; its results too.
    """

    @wraps(function)
    def scoped(*args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function in double precision (JAX's float64 scope), for NumPy arrays; inside a trace as it is."""
        if is_traced((args, kwargs)):
            return function(*args, **kwargs)
        refuse_forked_process()
        with jax.enable_x64(True):
            arrays: R = to_numpy(function(*args, **kwargs))
        return arrays

    return scoped


def let_compute_in_float64(kind: type, names: Sequence[str]) -> None:
    """Make these methods and properties of a user's class compute known numbers in float64, wherever they are called.

    A model is described outside of any float64 scope, where a formula in jax.numpy would give seven digits. The
    library's own classes use NumPy for known numbers, and are left as they are.

    Args:
        kind: the class, while it is made (`__init_subclass__`).
        names: methods that return numbers; those that the class does not define itself are skipped.
    """
    if kind.__module__.split(".")[0] == __name__.split(".")[0]:
        return
    for name in names:
        member = vars(kind).get(name)
        if isinstance(member, property) and member.fget is not None:
            type.__setattr__(kind, name, property(_compute_known_in_float64(member.fget), doc=member.__doc__))
        elif callable(member):
            type.__setattr__(kind, name, _compute_known_in_float64(member))


def _compute_known_in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, computed at once and in double precision if no argument is traced.

    Inside a trace, known numbers are then constants in it, rather than operations in the trace's precision.
    """

    @wraps(function)
    def scoped(*args: P.args, **kwargs: P.kwargs) -> R:
        """Call the function in double precision, at once, where no number is traced, even within a trace."""
        is_in_float64 = jax.dtypes.canonicalize_dtype(float).itemsize == 8
        if is_in_float64 or is_traced((args, kwargs)):
            return function(*args, **kwargs)
        with jax.ensure_compile_time_eval(), jax.enable_x64(True):
            arrays: R = to_numpy(function(*args, **kwargs))
        return arrays

    return scoped


def compile_in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function once per structure and shapes of its arguments, run it in float64, hand NumPy arrays back.

    Numbers in the arguments become arrays first, so that a step counter, which would be a constant of the program, does
    not compile anew at each step. Inside a trace it is the plain function.
    """
    jitted = quickly_compiled(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Call the compiled function in double precision, for NumPy arrays; inside a trace the plain function."""
        if is_traced((args, kwargs)):
            return function(*args, **kwargs)
        refuse_forked_process()
        with jax.enable_x64(True):
            arrays: R = to_numpy(jitted(*jax.tree.map(as_array, args), **jax.tree.map(as_array, kwargs)))
        return arrays

    return call


def as_array(leaf: object) -> object:
    """Return a number as an array, which compiled code takes as an argument; anything else as it is.

    Raises:
        ValueError: texts, and integers too large for a double.
    """
    value = np.asarray(leaf) if isinstance(leaf, int | float) else leaf
    if isinstance(value, np.ndarray) and value.dtype.kind in "OUS":  # objects (so large integers) and texts
        raise fail("argument", "numbers that a double can hold", show_value(leaf))
    return value
