"""Choice of the engine for a function of one run: native code where it supports the program, else XLA.

The environment variable HELIOGRAPH_ENGINE forces one: "native", which refuses unsupported programs, or "xla".
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache, wraps
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import numpy as np

from heliograph.engine.size_thresholds import SHORT
from heliograph.numerics import float64
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.process.garbage_collector import pause_collector
from heliograph.numerics.process.interpreter_stack import reserve_stack
from heliograph.numerics.trace_settings import trace_settings
from heliograph.numerics.types import PyTree
from straightline import Unsupported, compile, compile_scan

Code = TypeVar("Code")
P = ParamSpec("P")
R = TypeVar("R")

SETTING = "HELIOGRAPH_ENGINE"
COMPILED = 256  # functions whose code is held at once
ENGINES = ("native", "xla")


@cache
def get_thread_pool() -> ThreadPoolExecutor:
    """Return a pool of threads for parts of one computation, one thread for each core."""
    return ThreadPoolExecutor(os.cpu_count() or 1)


class EngineChoice(NamedTuple):
    """Code of a function, or the reason why XLA computes it; `arrays` are those of its arguments and of its closure."""

    code: Any  # what `straightline.compile` returns
    why: str
    arrays: tuple[Any, ...] = ()

    @property
    def explanation(self) -> str:
        """Sentence "native: ..." with the number of operations, or "xla: ..." with `why` there is no native code."""
        if self.code is None:
            return f"xla: {self.why}"
        divisions = f", {self.code.divisions} of them divisions and roots" if self.code.divisions else ""
        return f"native: {self.code.operations} operations{divisions}"

    def results(self) -> PyTree:
        """Return the results of the native code for the arrays."""
        return self.code(*self.arrays)


def engine_of(function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """Return in words which engine computes a function of one run for several runs, and why.

    Args:
        function: a function of the arrays of one run.
        arguments: its arguments for several runs: trees of arrays with a leading axis of runs.

    Returns:
        "native: ..." with the number of operations, or "xla: ..." with the reason.

    Raises:
        ValueError: no function; HELIOGRAPH_ENGINE is "native" and the program is not supported.
    """
    if not callable(function):
        raise fail("function of one run", "a function of arrays", show_value(function))
    arrays = jax.tree.map(np.asarray, arguments)
    return choose_code(function, arrays, differs_by_run=[True] * len(arguments)).explanation


def explain_refusal(function: Callable[..., PyTree], *arguments: PyTree) -> str:
    """Return why native code refuses a function with these arguments of one run, or "" if it takes the function.

    The answer is also "" where the environment forces XLA, since native code is not asked then.
    """
    if read_forced_engine() == "xla":
        return ""
    with jax.enable_x64(True):
        return _find_compiled_code(function, arguments, differs_by_run=[False] * len(arguments)).why


def choose_code(
    function: Callable[..., PyTree],
    arguments: Sequence[PyTree],
    differs_by_run: Sequence[bool],
    most: int | None = None,
) -> EngineChoice:
    """Return the native code of a function for arguments like these, compiled once; or why XLA has to compute it.

    Native code is quicker for short functions, but does not take all operations of JAX; XLA, JAX's own compiler, does.
    SETTING is the environment variable that forces one of these engines ("native" or "xla"); "" stands for none.

    The result has `code` (None: XLA computes, for the reason `why`) and `arrays`, the arguments that the code takes.

    Args:
        function: a function of the arrays of one run.
        arguments: its arguments.
        differs_by_run: for each argument, whether it has a leading axis of runs; the others are shared by all runs.
        most: operations above which XLA computes, unless native code is forced; no limit by default.

    Raises:
        ValueError: native code is forced and does not take the program.
    """
    engine = read_forced_engine()
    if engine == "xla":
        return EngineChoice(code=None, why=f"{SETTING} is set to it")
    choice = _find_compiled_code(function, arguments, differs_by_run, None if engine == "native" else most)
    # LLVM may refuse what was lowered: only an attempt shows it.
    if choice.code is not None and (why := choice.code.generate_code(choice.arrays)):
        choice = EngineChoice(code=None, why=why)
    if choice.code is None and engine == "native":
        raise fail("native code", "a program of operations that it takes", choice.why)
    return choice


def compute_once(
    function: Callable[..., PyTree], by_xla: Callable[..., PyTree], arguments: Sequence[PyTree], most: int | None = None
) -> PyTree:
    """Compute a function once, in double precision, as NumPy arrays: by native code where it supports the function.

    Args:
        function: a function of trees of arrays.
        by_xla: the same function compiled by XLA. It computes where native code does not.
        arguments: its arguments.
        most: operations above which XLA computes; no limit by default, so that XLA has only what native code refuses.
    """
    with jax.enable_x64(True):
        choice = choose_code(function, arguments, differs_by_run=[False] * len(arguments), most=most)
        if choice.code is None:
            return float64.to_numpy(by_xla(*arguments))
        # The code computes runs, here one. `[0, ...]` keeps arrays, where `[0]` would make NumPy's scalars.
        return map_arrays(lambda leaf: leaf[0, ...], choice.results())


def scan_rows(
    begin: Callable[[Any], PyTree],
    step: Callable[[Any, Any, Any], tuple[PyTree, PyTree]],
    fixed: PyTree,
    rows: PyTree,
    by_xla: Callable[[], PyTree],
    most: int | None = None,
) -> PyTree:
    """Step over rows of data in double precision; return the last state and the outputs of all rows, as NumPy arrays.

    Native code is made by the compiler `straightline`, and serves any number of rows: a recording of another length
    compiles nothing. XLA, JAX's compiler, is used for steps that native code does not support.

    Args:
        begin: a function that returns the state before the first row from `fixed`.
        step: a function that returns the state after a row and the row's output, from `fixed`, the state before it and
            the row.
        fixed: a tree of what is the same for all rows, such as a filter.
        rows: a tree of arrays (rows, ...).
        by_xla: computes the same by XLA, where native code does not take the step, and for no rows.
        most: operations above which `by_xla` computes, unless native code is forced; no limit by default.

    Raises:
        ValueError: native code is forced and does not take the step.
    """
    engine, count = read_forced_engine(), len(jax.tree.leaves(rows)[0])
    with jax.enable_x64(True):
        # Native code first, unless XLA is forced. The flags say which of the four trees differ from row to row.
        if engine != "xla" and count:
            choice = _find_code(_compile_scan, (begin, step, fixed, rows), (False, False, False, True), most=None)
            is_long = most is not None and engine != "native" and choice.code and choice.code.operations > most
            why = choice.why or ("long" if is_long else choice.code.generate_code(count))
            if not why:
                first = len(choice.arrays) - len(jax.tree.leaves(rows))  # of the rows, behind those of `fixed`
                return choice.code(choice.arrays[:first], choice.arrays[first:])
            if engine == "native":
                raise fail("native code", "a program of operations that it takes", why)
        return float64.to_numpy(by_xla())


def map_arrays(change: Callable[[np.ndarray], np.ndarray], results: PyTree) -> PyTree:
    """Change the arrays of results; what they have beside arrays, such as a model's functions, stays."""
    return jax.tree.map(lambda leaf: change(leaf) if isinstance(leaf, np.ndarray) else leaf, results)


def compile_on_call(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that computes the same by compiled code, made once per structure and shapes of its arguments.

    It is for functions that users call now and then, such as one step of a filter. There are two compilers: native code
    (the package straightline) costs little per call, and computes functions of at most SHORT operations; XLA computes
    longer ones. Both compute in double precision, and return NumPy arrays. Each keeps its code in a cache, also what
    `_trace_once` returns. Inside a trace of JAX the function itself is called, or where all arguments are traced one
    stored trace of it, so that a step alone and a loop over rows share the trace, which saves time.
    """
    by_xla = float64.compile_in_float64(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's results for these arguments, by one of the ways that `compile_on_call` says."""
        # All arguments traced: the operations of one stored trace. Some of them traced, or keywords: XLA's function.
        leaves, structure = jax.tree.flatten(args)
        are_all_traced = bool(leaves) and all(isinstance(leaf, jax.core.Tracer) for leaf in leaves)
        if are_all_traced and not kwargs:
            traced: R = _trace_once(function, structure, trace_settings())(*args, **kwargs)
            return traced
        if kwargs or is_traced(*args):
            return by_xla(*args, **kwargs)
        # Numbers: native code, or XLA above SHORT operations. A fork of a process lacks JAX's threads: it is refused.
        float64.refuse_forked_process()
        arrays = jax.tree.map(float64.as_array, args)
        returned: R = compute_once(function, by_xla, arrays, most=SHORT)
        return returned

    return call


@lru_cache(COMPILED)
def _trace_once(function: Callable[P, R], structure: Any, settings: object) -> Callable[P, R]:
    """Return the function wrapped in `jax.jit`, so that a surrounding trace traces it once for the same shapes.

    `structure` (of the arguments) and `settings` (on which a trace depends) are only keys of this cache.
    JAX keeps a trace as long as its function lives. The cache holds COMPILED wrapped functions, and when it drops one,
    the traces of that structure and these settings are freed with it.
    """

    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Return the function's results: a new function, so that JAX keeps its traces apart from others'."""
        return function(*args, **kwargs)

    program: Callable[P, R] = jax.jit(call)
    return program


def read_forced_engine() -> str:
    """Return the engine of ENGINES that the environment variable SETTING forces, or "" if it is not set."""
    engine = os.environ.get(SETTING, "")
    if engine not in ("", *ENGINES):
        raise fail(SETTING, " or ".join(ENGINES), engine)
    return engine


def make_native_or_none(make: Callable[[], Code]) -> Code | None:
    """Return the native code that `make` makes, or None if XLA has to compute.

    XLA has to compute where the environment forces it, and where `make` raises Unsupported.

    Raises:
        ValueError: native code is forced and does not take the program.
    """
    engine = read_forced_engine()
    if engine == "xla":
        return None
    try:
        with pause_collector():
            return reserve_stack(make)()
    except Unsupported as error:
        if engine == "native":
            raise fail("native code", "a program of operations that it takes", str(error)) from None
        return None


def _find_compiled_code(
    function: Callable[..., PyTree],
    arguments: Sequence[PyTree],
    differs_by_run: Sequence[bool],
    most: int | None = None,
) -> EngineChoice:
    """Return the native code of a function for arguments of this structure, compiled once, or why there is none.

    Args:
        function: the function, which may be a tree with arrays itself, as a bound method of a filter is.
        arguments: trees with arrays.
        differs_by_run: for each argument whether its arrays have a leading axis of runs.
        most: operations above which there is no code; the compiler's own limit if None.
    """
    return _find_code(_compile_for_structure, (function, *arguments), (False, *differs_by_run), most)


def _find_code(
    compile: Callable[..., tuple[Any, str]], trees: Sequence[PyTree], has_axis: Sequence[bool], most: int | None
) -> EngineChoice:
    """Return the native code that `compile` makes of trees of this structure, made once, or why there is none.

    One code serves all calls that differ in the numbers of arrays alone, so that it is cached by everything else.

    Args:
        compile: one of the functions of this module that compile, which cache the code by their arguments.
        trees: functions and their arguments, with arrays.
        has_axis: for each tree whether its arrays have a leading axis, of runs or of rows.
        most: number of operations above which there is no code; the compiler's own limit if None.
    """
    # All arrays and other objects in a list, and for each whether it has a leading axis.
    leaves, structure = jax.tree.flatten(tuple(trees))
    leaf_has_axis = list[bool]()  # the same of each leaf
    for tree, tree_has_axis in zip(trees, has_axis, strict=True):
        leaf_has_axis += [tree_has_axis] * len(jax.tree.leaves(tree))
    # The key of the cache of code: the structure and its leaves, of arrays their shape in one run and their type.
    # Arrays become arguments of the code; all other leaves are part of it.
    arrays, key_leaves = list[Any](), list[Any]()
    for leaf, is_led in zip(leaves, leaf_has_axis, strict=True):
        if isinstance(leaf, np.ndarray | jax.Array):
            arrays.append(leaf)
            key_leaves.append(_ArrayOfRun(leaf.shape[1:] if is_led else leaf.shape, leaf.dtype, is_led))
        else:
            key_leaves.append(leaf)
    try:
        code, why = compile(structure, tuple(key_leaves), most)
    except TypeError as error:  # a leaf without a hash has no key: XLA computes
        is_of_key = "unhashable" in str(error)  # rather than one that the function raises while it is traced
        if not is_of_key:
            raise
        return EngineChoice(
            code=None, why=f"the function holds an object that cannot be compared with another: {error}"
        )
    return EngineChoice(code=code, why=why, arrays=tuple(arrays))


class _ArrayOfRun(NamedTuple):
    """Shape and type of one run's array, or of one row's, and whether each run or row has its own."""

    shape: tuple[int, ...]
    dtype: np.dtype
    differs: bool


@lru_cache(COMPILED)
@reserve_stack
@pause_collector()
def _compile_for_structure(structure: Any, leaves: tuple[Any, ...], most: int | None) -> tuple[Any, str]:
    """Return the code of a function in a tree (function, *arguments) with these leaves, or None and why there is none.

    Of arrays the leaves have shapes and types: these are the arguments of the code.
    """

    def call(*values: Any) -> PyTree:
        """Call the function with these values in the places of the placeholders among `leaves`, and return its result.

        `leaves` and `structure` are those of the tree (function, *arguments), since the function may hold arrays too.
        """
        function, *arguments = _put_in_tree(structure, leaves, values)
        return function(*arguments)

    arrays = [leaf for leaf in leaves if isinstance(leaf, _ArrayOfRun)]
    shared = [n for n, array in enumerate(arrays) if not array.differs]
    try:
        return compile(call, *_make_examples(arrays), shared=shared, most=most), ""
    except Unsupported as error:
        return None, str(error)


@lru_cache(COMPILED)
@reserve_stack
@pause_collector()
def _compile_scan(structure: Any, leaves: tuple[Any, ...], most: int | None) -> tuple[Any, str]:
    """Return the code of a scan in a tree (begin, step, fixed, rows) with these leaves, or None and why there is none.

    A scan is state = begin(fixed), then (state, output) = step(fixed, state, row) for each row. The code depends on
    structure and shapes alone, so that it is cached by them: a leaf that is an array stands here as an `_ArrayOfRun`,
    its shape and type (of the rows' arrays those of one row), and `differs` marks the arrays of rows.

    Args:
        structure: JAX's structure of the tree (begin, step, fixed, rows).
        leaves: its leaves: an `_ArrayOfRun` for each array, all others themselves.
        most: passed on to `compile_scan`.
    """

    def begin(fixed: Any) -> PyTree:
        """Return the state before the first row; the rows' places in the tree hold None, since `begin` sees none."""
        function, _, tree, _ = _put_in_tree(structure, leaves, [*fixed, *[None] * len(of_rows)])
        return function(tree)

    def step(fixed: Any, state: PyTree, row: Any) -> tuple[PyTree, PyTree]:
        """Return the state after a row, and the row's output."""
        _, function, *trees = _put_in_tree(structure, leaves, [*fixed, *row])
        after: tuple[PyTree, PyTree] = function(trees[0], state, trees[1])
        return after

    # The arrays of rows come last in the tree, so `[*fixed, *row]` are the values of all arrays in order.
    arrays = [leaf for leaf in leaves if isinstance(leaf, _ArrayOfRun)]
    of_rows = [array for array in arrays if array.differs]
    fixed = [array for array in arrays if not array.differs]
    try:
        return compile_scan(begin, step, _make_examples(fixed), _make_examples(of_rows), most=most), ""
    except Unsupported as error:
        return None, str(error)


def _put_in_tree(structure: Any, leaves: Sequence[Any], values: Sequence[Any]) -> Any:
    """Return a tree of this structure with `values` in the places of the placeholders among its leaves."""
    next_value = iter(values)
    with_values = [next(next_value) if isinstance(leaf, _ArrayOfRun) else leaf for leaf in leaves]
    return jax.tree.unflatten(structure, with_values)


def _make_examples(arrays: Sequence[_ArrayOfRun]) -> list[Any]:
    """Return JAX's placeholders for arrays of these shapes and types, by which a compiler traces a function."""
    placeholder: Any = jax.ShapeDtypeStruct
    return [placeholder(array.shape, array.dtype) for array in arrays]
