"""One filter's step on live data, which keeps its state where something is implausible, until told to accept it.

In one program: native code if possible, else XLA. The step of a network (`simulation/rows/row_step.py`) is another: it
leaves implausible measurements out and goes on, and takes many rows at once.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import read_setting, try_native
from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.numerics.float64 import understood
from heliograph.numerics.trees.static import Static
from heliograph.numerics.types import Float, PyTree
from straightline import Unsupported, compile_one

Leaves = list[np.ndarray]
PARTS = len(Judgement._fields)


class NativeFilterStepper:
    """One filter's step by native code, which reads and writes arrays that stay where they are."""

    def __init__(self, code: Any, numbers: Leaves, state: Leaves):
        """Name the arrays of the code's arguments and results, which are those of `_compile_step`."""
        self._code = code.again(numbers)
        arguments, results, n = self._code.inputs[len(numbers) :], self._code.outputs, len(state)
        self._state, (self._z, self._u, self._k) = arguments[:n], arguments[n:]
        self._judged: Float[np.ndarray, " parts"] = results[0]
        # The last n results are written over the arguments of the state.
        self._flagged, self._after, self._estimate = results[1], results[2 : 2 + n], results[2 + n : len(results) - n]
        self.set_state(state)

    @property
    def judgement(self) -> Float[np.ndarray, " 4"]:
        """Return the judgement of the step."""
        return self._judged[:PARTS]

    @property
    def weight(self) -> Float[np.ndarray, " m"]:
        """Return a copy of the weights of the step's components; empty of a filter that weighs none."""
        return self._judged[PARTS:].copy()

    @property
    def state(self) -> Leaves:
        """Return copies of the leaves of the filter's state."""
        return [leaf.copy() for leaf in self._state]

    def set_state(self, leaves: Sequence[np.ndarray]) -> None:
        """Set the leaves of the filter's state."""
        for leaf_of_state, leaf in zip(self._state, leaves, strict=True):
            leaf_of_state[...] = leaf

    def step(self, z: np.ndarray, u: np.ndarray, k: int) -> bool:
        """Compute a step; False, with the state unchanged, if data are not finite or something is implausible."""
        self._z[...], self._u[...], self._k[...] = z, u, k
        self._code()
        return not self._flagged

    def accept(self) -> None:
        """Accept the state after a step that was flagged."""
        self.set_state(self._after)

    @property
    def estimate(self) -> Leaves:
        """Return the leaves of the estimate after the step."""
        return [leaf.copy() for leaf in self._estimate]


class XlaFilterStepper:
    """One filter's step by a program of XLA, with its state."""

    def __init__(self, run: Any, numbers: list[jax.Array], state: PyTree):
        """Start from `state`; `run` is what `compile_xla_step` returns, `numbers` are the filter's arrays."""
        self._run, self._numbers = run, numbers
        self._state, tree = jax.tree.flatten(state)
        self._tree: Any = tree

    @property
    def judgement(self) -> Float[np.ndarray, " 4"]:
        """Return the judgement of the step."""
        return self._judged[:PARTS]

    @property
    def weight(self) -> Float[np.ndarray, " m"]:
        """Return the weights of the step's components; empty of a filter that weighs none."""
        return self._judged[PARTS:]

    @property
    def state(self) -> Leaves:
        """Return the leaves of the filter's state."""
        return [np.asarray(leaf) for leaf in self._state]

    def set_state(self, leaves: Sequence[np.ndarray]) -> None:
        """Set the leaves of the filter's state."""
        with jax.enable_x64(True):
            self._state = [jnp.array(leaf) for leaf in leaves]

    def step(self, z: np.ndarray, u: np.ndarray, k: int) -> bool:
        """Compute a step; False, with the state unchanged, if data are not finite or something is implausible."""
        with jax.enable_x64(True):
            state = self._tree.unflatten(self._state)
            judged, flagged, self._after, self._estimate = self._run(self._numbers, state, z, u, np.asarray(k))
        self._judged: Float[np.ndarray, " parts"] = np.asarray(judged)
        if flagged:
            return False
        self.accept()
        return True

    def accept(self) -> None:
        """Accept the state after a step that was flagged."""
        self._state = self._after

    @property
    def estimate(self) -> Leaves:
        """Return the leaves of the estimate after the step."""
        return [np.asarray(leaf) for leaf in self._estimate]


def _judge_step(
    static: Static, numbers: Sequence[jax.Array], state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array
) -> tuple[jax.Array, jax.Array, list[jax.Array], list[jax.Array]]:
    """Step a filter from its arrays; return judgement, whether to refuse, leaves of the state and of the estimate.

    The weights of a filter that weighs follow its judgement.
    """
    filter: AbstractFilter = static.filled(numbers)
    after, estimate, judgement, innovation = filter.judge_step(state, z, u, k)
    # NaN in z did not arrive; infinite measurements and inputs that are no numbers are refused.
    unusable = jnp.any(jnp.isinf(z)) | ~jnp.all(jnp.isfinite(u))
    flagged = unusable | (judgement.reason > 0) | (judgement.input > 0)
    judged = jnp.stack(judgement)
    if innovation.weight is not None:
        judged = jnp.concatenate([judged, innovation.weight])
    return judged, flagged, jax.tree.leaves(after), jax.tree.leaves(estimate)


@lru_cache
def compile_xla_step(static: Static) -> Any:
    """Compile (numbers, state, z, u, k) to (judgement, whether to refuse, leaves of the state, of the estimate)."""

    def step(*data: PyTree) -> PyTree:
        return _judge_step(static, *data)

    return jax.jit(step, compiler_options=understood())


def compile_native_step(static: Static, numbers: Sequence[jax.Array], state: PyTree, data: Sequence[np.ndarray]) -> Any:
    """Compile native code with arguments (numbers, state, z, u, k), flattened; None if XLA has to step the filter."""
    leaves, tree = jax.tree.flatten(state)
    shapes = tuple((np.shape(leaf), str(leaf.dtype)) for leaf in (*numbers, *leaves, *data))
    return _compile_step(static, shapes, (len(numbers), len(leaves)), tree, read_setting())


@lru_cache
def _compile_step(
    static: Static, shapes: tuple[tuple[tuple[int, ...], str], ...], counts: tuple[int, int], tree: Any, engine: str
) -> Any:
    """Compile the native code, once for each structure, set of shapes and engine; None if XLA has to do it.

    Args:
        static: the filter without its arrays.
        shapes: shape and type of each argument: the filter's numbers, leaves of its state, z, u, k.
        counts: how many of the arguments are numbers, and how many leaves of the state.
        tree: structure of the state.
        engine: the setting of the engine, by which results are kept apart.
    """
    numbers, state = counts

    def step(*leaves: jax.Array) -> PyTree:
        """Return judgement, whether to refuse, state after, estimate, and what takes the state's place."""
        before, (z, u, k) = leaves[numbers : numbers + state], leaves[numbers + state :]
        # The step, and the state that replaces the old one: unchanged if the step was flagged.
        judged, flagged, after, estimate = _judge_step(static, leaves[:numbers], tree.unflatten(before), z, u, k)
        if any(a.shape != b.shape or a.dtype != b.dtype for a, b in zip(after, before, strict=True)):
            raise Unsupported("a state whose shape or type changes")
        placed = [jnp.where(flagged, b, a) for a, b in zip(after, before, strict=True)]
        return judged, flagged, after, estimate, placed

    def compile_code() -> Any:
        # The last results are written over the arguments of the state: {number of the result: of the argument}.
        in_place = {-state + i: numbers + i for i in range(state)}
        return compile_one(step, *(np.zeros(shape, kind) for shape, kind in shapes), in_place=in_place)

    return try_native(compile_code)
