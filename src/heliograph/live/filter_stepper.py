"""One filter's step on live data, which keeps its state where something is implausible, until told to accept it.

In one program: native code if possible, else XLA. The step of a network (`simulation/rows/row_step.py`) is another: it
leaves implausible measurements out and goes on, and takes many rows at once.
"""

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Wrapped
from scipy.stats import chi2

from heliograph.engine.choice import make_native_or_none, read_forced_engine
from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.stored.old_layout import split_by_path
from heliograph.live.stored.snapshot import Identity, list_versions
from heliograph.model.channel import Channel
from heliograph.model.estimate import JudgedEstimate
from heliograph.model.over_time import first
from heliograph.model.readings.reading_limits import ScreenedReadings
from heliograph.model.trigger import AbstractTrigger
from heliograph.numerics.caching import share_by_object
from heliograph.numerics.float64 import understood
from heliograph.numerics.trees.program_text import hash_numbers, write_program_text
from heliograph.numerics.trees.tree_structure import Static, split_structure
from heliograph.numerics.types import Float, PyTree
from straightline import Unsupported, compile_one

SingleRunCode: TypeAlias = Any  # what `straightline.compile_one` returns; its class is not public
Leaves = list[np.ndarray]
PARTS = len(Judgement._fields)
RARE = 1e-4  # probability with which an honest filter sees what counts as unexpected


class NativeFilterStepper:
    """One filter's step by native code, which reads and writes arrays that stay where they are."""

    def __init__(self, code: SingleRunCode, numbers: Leaves, state: Leaves):
        """Name the arrays that the compiled code reads and writes at each call, and set the state.

        The code's arguments are (numbers, state, z, u, k). Its results are (judgement, flagged, state after, estimate,
        next state), of which the next state, the last, is written over the argument "state".

        Args:
            code: the compiled step, as `compile_native_step` returns it.
            numbers: the filter's arrays.
            state: the leaves (arrays) of the filter's state to start from.
        """
        self._code = code.with_new_memory(numbers)
        n = len(state)
        arguments, results = self._code.inputs[len(numbers) :], self._code.outputs
        self._state, (self._z, self._u, self._k) = arguments[:n], arguments[n:]
        self._judged: Float[np.ndarray, " parts"] = results[0]
        self._flagged = results[1]
        self._after = results[2 : 2 + n]
        self._estimate = results[2 + n : len(results) - n]
        self.set_state(state)

    @property
    def judgement(self) -> Float[np.ndarray, " 4"]:
        """Return the parts of the newest step's `Judgement`, in the order of its fields."""
        return self._judged[:PARTS]

    @property
    def weight(self) -> Float[np.ndarray, " m"]:
        """Return a copy of the weights of the step's components; empty of a filter that weighs none."""
        return self._judged[PARTS:].copy()

    @property
    def state(self) -> Leaves:
        """Return copies of the arrays of the filter's state, the leaves of its tree."""
        return [leaf.copy() for leaf in self._state]

    def set_state(self, leaves: Sequence[np.ndarray]) -> None:
        """Set the arrays of the filter's state, given in the order that `state` returns them in."""
        for leaf_of_state, leaf in zip(self._state, leaves, strict=True):
            leaf_of_state[...] = leaf

    def step(self, z: np.ndarray, u: np.ndarray, k: int) -> bool:
        """Compute step k from z and u; return whether it was accepted.

        If z or u is implausible or infinite, it is not, and the state stays unchanged. The compiled code reads the
        arrays `_z`, `_u` and `_k`, and writes `_flagged`: whether it refuses them.
        """
        self._z[...], self._u[...], self._k[...] = z, u, k
        self._code()
        return not self._flagged

    def accept(self) -> None:
        """Take over the state that the newest step led to, although it was refused (flagged)."""
        self.set_state(self._after)

    @property
    def estimate(self) -> Leaves:
        """Return the arrays of the estimate after the newest step, the leaves of its tree."""
        return [leaf.copy() for leaf in self._estimate]


class XlaFilterStepper:
    """One filter's step by a program of XLA, with its state."""

    def __init__(self, run: Wrapped, numbers: list[jax.Array], state: PyTree):
        """Start from a state of the filter.

        Args:
            run: the compiled step, as `compile_xla_step` returns it.
            numbers: the filter's arrays.
            state: the filter's state, a tree of arrays.
        """
        self._run, self._numbers = run, numbers
        self._state, tree = jax.tree.flatten(state)
        self._tree: PyTree = tree

    @property
    def judgement(self) -> Float[np.ndarray, " 4"]:
        """Return the parts of the newest step's `Judgement`, in the order of its fields."""
        return self._judged[:PARTS]

    @property
    def weight(self) -> Float[np.ndarray, " m"]:
        """Return the weights of the step's components; empty of a filter that weighs none."""
        return self._judged[PARTS:]

    @property
    def state(self) -> Leaves:
        """Return the arrays of the filter's state, the leaves of its tree."""
        return [np.asarray(leaf) for leaf in self._state]

    def set_state(self, leaves: Sequence[np.ndarray]) -> None:
        """Set the arrays of the filter's state, given in the order that `state` returns them in."""
        with jax.enable_x64(True):
            self._state = [jnp.array(leaf) for leaf in leaves]

    def step(self, z: np.ndarray, u: np.ndarray, k: int) -> bool:
        """Compute step k from z and u; return whether it was accepted.

        If z or u is implausible or infinite, it is not, and the state stays unchanged (`accept` overrules this). `_run`
        is the compiled step, `_tree` the state's structure, and `_state` its leaves (arrays).
        """
        with jax.enable_x64(True):
            state = self._tree.unflatten(self._state)
            judged, flagged, self._after, self._estimate = self._run(self._numbers, state, z, u, np.asarray(k))
        self._judged: Float[np.ndarray, " parts"] = np.asarray(judged)
        if flagged:
            return False
        self.accept()
        return True

    def accept(self) -> None:
        """Take over the state that the newest step led to, although it was refused (flagged)."""
        self._state = self._after

    @property
    def estimate(self) -> Leaves:
        """Return the arrays of the estimate after the newest step, the leaves of its tree."""
        return [np.asarray(leaf) for leaf in self._estimate]


def _judge_step(
    static: Static, numbers: Sequence[jax.Array], state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array
) -> tuple[jax.Array, jax.Array, list[jax.Array], list[jax.Array]]:
    """Step a filter; return its judgement, whether the step is refused, and the leaves of the new state and estimate.

    If the filter weighs what arrives, its weights follow the judgement's numbers in the same array.

    Args:
        static: the filter without its arrays.
        numbers: the filter's arrays.
        state: the filter's state before the step.
        z: measurement (received,), NaN where a component did not arrive.
        u: inputs (inputs,).
        k: step number.
    """
    filter: AbstractFilter = static.with_arrays(numbers)  # the whole filter again
    state_after, estimate, judgement, innovation = filter.judge_step(state, z, u, k)
    # NaN in z means that a component did not arrive. Infinite measurements, and NaN or infinite inputs, are refused.
    has_unusable_numbers = jnp.any(jnp.isinf(z)) | ~jnp.all(jnp.isfinite(u))
    # The filter's judgement: a reason number above 0 says why z is implausible, and `input` why u is.
    is_refused = has_unusable_numbers | (judgement.reason > 0) | (judgement.input > 0)
    judgement_numbers = jnp.stack(judgement)
    if innovation.weight is not None:
        judgement_numbers = jnp.concatenate([judgement_numbers, innovation.weight])
    return judgement_numbers, is_refused, jax.tree.leaves(state_after), jax.tree.leaves(estimate)


@lru_cache
def compile_xla_step(static: Static) -> Wrapped:
    """Return a filter's step, compiled by XLA: `_judge_step` as a function of (numbers, state, z, u, k).

    `static` is the filter without its arrays. Filters that differ in these alone share the compiled step.
    """

    def step(*data: PyTree) -> PyTree:
        """Return what `_judge_step` returns for the data (numbers, state, z, u, k) of the filter `static`."""
        return _judge_step(static, *data)

    return jax.jit(step, compiler_options=understood())


def compile_native_step(
    static: Static, numbers: Sequence[jax.Array], state: PyTree, data: Sequence[np.ndarray]
) -> SingleRunCode | None:
    """Return a filter's step as native code, or None if the native compiler lacks an operation of it.

    Its arguments are (numbers, state, z, u, k), flattened. Its results are those of `_judge_step`, and the next state,
    which is written over the argument. The next state is the old one if the step was flagged (refused).

    Args:
        static: the filter without its arrays.
        numbers: the filter's arrays.
        state: a state of the filter; only its structure and shapes count.
        data: z, u and k; only their shapes count.
    """
    leaves, tree = jax.tree.flatten(state)
    # All that the code depends on, in a form that can be hashed: `_compile_step` remembers what it compiled.
    shapes = tuple((np.shape(leaf), str(leaf.dtype)) for leaf in (*numbers, *leaves, *data))
    return _compile_step(static, shapes, (len(numbers), len(leaves)), tree, read_forced_engine())


@lru_cache
def _compile_step(
    static: Static,
    shapes: tuple[tuple[tuple[int, ...], str], ...],
    counts: tuple[int, int],
    tree: PyTree,
    engine: str,
) -> SingleRunCode | None:
    """Return a filter's step as native code (see `compile_native_step`); None if XLA has to step the filter.

    A live filter makes one step per message, where native code saves the overhead of JAX. None is returned if the
    native compiler lacks an operation, so that XLA has to step the filter. It is compiled once for each structure, set
    of shapes and engine.

    Args:
        static: the filter without its arrays (its structure and settings).
        shapes: shape and type of each argument, in order: the filter's arrays, leaves of its state, measurement z,
            input u, step number k.
        counts: how many arguments are arrays of the filter, and how many are leaves of the state.
        tree: structure of the state.
        engine: the setting of the engine. It is not read here: each setting has a compiled step of its own.
    """
    number_count, state_count = counts
    state_end = number_count + state_count

    def step(*arguments: jax.Array) -> PyTree:
        """Return the judgement, whether the step is refused, the new state, the estimate, and the next state.

        `arguments` are the filter's arrays (up to `number_count`), the leaves of its state (up to `state_end`), z, u
        and k. `tree` is the state's structure, and `static` the filter without its arrays.
        """
        numbers, before = arguments[:number_count], arguments[number_count:state_end]
        z, u, k = arguments[state_end:]
        judged, flagged, after, estimate = _judge_step(static, numbers, tree.unflatten(before), z, u, k)
        # The new state is written over the old one, and must fit.
        if any(new.shape != old.shape or new.dtype != old.dtype for new, old in zip(after, before, strict=True)):
            raise Unsupported("a state whose shape or type changes")
        # The next state is the old one if the step was refused.
        next_state = [jnp.where(flagged, old, new) for new, old in zip(after, before, strict=True)]
        return judged, flagged, after, estimate, next_state

    def compile_code() -> SingleRunCode:
        """Return the code of the step; the next state is written over the arguments of the state."""
        # {number of a result: number of the argument that it is written over}; -1 is the last result.
        in_place = {i - state_count: number_count + i for i in range(state_count)}
        return compile_one(step, *(np.zeros(shape, kind) for shape, kind in shapes), in_place=in_place)

    return make_native_or_none(compile_code)


class DecidingSender(NamedTuple):
    """A sender that decides when to send, as its filter believes it: its rule, its link, its number of outputs."""

    trigger: AbstractTrigger
    channel: Channel
    outputs: int


def find_deciding_sender(filter: AbstractFilter) -> DecidingSender | None:
    """Return the sender whose silence a filter can interpret, or None if there is none.

    Such a sender decides by a trigger when to send: that nothing came says something of its measurement.
    """
    assumed = filter.assumed  # the plant, sensor, channel and trigger that the filter was made for
    if not filter.silence_tells or assumed is None or assumed.trigger is None:
        return None
    assert assumed.sensor is not None and assumed.channel is not None  # a sender has both
    return DecidingSender(assumed.trigger, assumed.channel, outputs=len(first(assumed.sensor).outputs))


class CompiledFilter:
    """A filter's compiled step, with its arrays and the names of what goes in and comes out; streams share it.

    Attributes:
        horizon: how many steps the filter covers; None for all.
        received, given: how many numbers a measurement and the inputs have.
        sender: the sender that decides when to send, if the filter can interpret its silence; else None.
        values: how many of the received numbers are such a sender's values, before its numbers of lost messages; 0
            without such a sender.
        numbers: the filter's arrays.
        state: structure of its state, to which leaves are put together; `layout`: {path of a leaf: its shape}.
        estimate: structure of the estimate of a step.
        rare: by count of numbers that arrived, what their nis exceeds with probability RARE.
    """

    def __init__(self, filter: AbstractFilter):
        """Take a filter apart into arrays and structure; note what its step takes and returns; nothing is compiled.

        Filters that differ in numbers alone then share compiled code, which takes the arrays as arguments.
        """
        self.filter, self.horizon = filter, filter.horizon
        self.received, self.given = filter.received, len(filter.inputs)  # sizes of z and u
        # Of a sender that decides when to send, z is [measured values, numbers of messages lost before each].
        self.sender, self.values = find_deciding_sender(filter), 0
        if sender := self.sender:
            lost_count = sender.trigger.side_information(sender.outputs)
            self.values = filter.received - lost_count
        # The filter in double precision, as its arrays and all that is no array; its initial state.
        with jax.enable_x64(True):
            self.numbers, self._static = split_structure(filter)
            # Put on the device as NumPy arrays, since JAX would compile a program for each shape.
            self._start: PyTree = jax.device_put(jax.tree.map(np.asarray, filter.init()))
        self.state: PyTree = jax.tree.structure(self._start)
        self.layout = {path: part.shape for path, part in split_by_path(self._start).items()}
        self._data = np.zeros(self.received), np.zeros(self.given), np.asarray(0)  # z, u, k: shapes to compile for
        # The structure of a step's estimate, found from an example whose numbers do not count. `modes` is None, or the
        # shape of the modes' probabilities, traced without computing anything.
        with jax.enable_x64(True):
            modes = jax.eval_shape(filter.estimate, self._start).modes
        example = JudgedEstimate(
            mean=np.zeros(()),
            covariance=np.zeros(()),
            claim=filter.claim,
            modes=modes,
            attitude=filter.attitude,
            nis=0.0,
            received=0,
        )
        self.estimate: PyTree = jax.tree.structure(example)
        # If the filter's covariance is true, the NIS (e' S^-1 e of the innovation) is chi-square, with as many degrees
        # of freedom as numbers arrived. By that number, what it exceeds with probability RARE; inf at 0 numbers.
        self.rare = [np.inf, *(float(chi2.isf(RARE, count)) for count in range(1, self.received + 1))]

    def leave_out_refused(
        self, z: Float[np.ndarray, " received"], screened: ScreenedReadings
    ) -> Float[np.ndarray, " received"]:
        """Return a measurement without the readings that were refused.

        A sender that decides when to send sent a refused reading all the same: its absence must not count as silence,
        which would tell something of the value.
        """
        if self.sender is None:
            return np.asarray(screened.values[0])  # of one reading, (1, received)
        return np.asarray(self.sender.trigger.leave_out_refused(z, screened.refused[0] > 0, self.sender.outputs))

    def make_stepper(self) -> NativeFilterStepper | XlaFilterStepper:
        """Return a new stepper of the filter whose state is the initial law (`_start`).

        It uses native code if the native compiler can compile the filter, and else XLA. `_static` is the filter without
        its arrays, and `numbers` are the arrays.
        """
        code = compile_native_step(self._static, self.numbers, self._start, self._data)
        if code is None:
            return XlaFilterStepper(compile_xla_step(self._static), self.numbers, self._start)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(self._start)]
        return NativeFilterStepper(code, [np.asarray(leaf) for leaf in self.numbers], leaves)

    @cached_property
    def identity(self) -> Identity:
        """Return versions, names, numbers and a hash of the step's program, whichever engine runs it."""
        with jax.enable_x64(True):
            text = write_program_text(
                compile_xla_step(self._static).trace(self.numbers, self._start, *self._data).jaxpr
            )
        filter = self.filter
        return {
            **list_versions(),
            "precision": ", ".join(sorted({str(leaf.dtype) for leaf in self.numbers})),
            "filter": type(filter).__name__,
            "states": ", ".join(filter.states),
            "inputs": ", ".join(filter.inputs),
            "numbers received": str(filter.received),
            "numbers": hash_numbers(self.numbers),
            "what is computed": hash_numbers(text),
        }


compile_once = share_by_object(CompiledFilter)  # returns a filter's compiled program, made at the first call
