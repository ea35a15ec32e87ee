"""One filter on live data: push a measurement, read the estimate."""

from functools import lru_cache
from typing import Any
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, given, measured
from heliograph.live.identity import Identity, check_same, short_name, versions
from heliograph.live.mould import Mould, cast
from heliograph.live.snapshot import packed, unpacked
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail
from heliograph.numerics.compiler import understood
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, PyTree


@readable
class Stream:
    """Feed a filter one sample at a time; it holds the filter's state and the step counter.

    The numbers are those of `run` over the same data, up to rounding: the compiler orders and joins the operations of a
    step as the program around it allows.

    Raises:
        ValueError: no filter.
    """

    def __init__(self, filter_: AbstractFilter):
        if not isinstance(filter_, AbstractFilter):
            raise fail("stream", "a filter", type(filter_).__name__)
        self.filter = filter_
        self.steps = 0
        self._placed = _place(filter_)
        self._state = self._placed.start

    def push(self, measurement: ArrayLike, inputs: ArrayLike = ()) -> Estimate:
        """Advance one step: `inputs` led to this `measurement` (NaN where a component did not arrive).

        Raises:
            ValueError: a measurement or inputs that are not the filter's, infinite values, an input that is NaN, a
                step past the end of what varies over time; the state stays as it was.
        """
        placed, k = self._placed, self.steps
        z, u = measured(self.filter, measurement), given(self.filter, inputs)
        if placed.horizon is not None and k >= placed.horizon:
            raise fail("step", f"one of the {placed.horizon} that the filter covers, counted from 0", k)
        with jax.enable_x64(True):
            self._state, told = placed.run(placed.numbers, self._state, z, u, np.asarray(k))
        self.steps += 1
        result: Estimate = placed.estimate.unflatten([np.asarray(leaf) for leaf in told])
        return result

    def save(self) -> bytes:
        """State and steps, for `restore`: after it, the same pushes give the same bits."""
        leaves = {f"state.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(to_numpy(self._state)))}
        return packed({"steps": self.steps, "of": self._placed.identity()}, leaves)

    @classmethod
    def restore(cls, filter_: AbstractFilter, data: bytes) -> "Stream":
        """The stream that was saved, of the same filter.

        Raises:
            ValueError: bytes that `save` did not return; the state of another filter, version or precision.
        """
        new, (head, arrays) = cls(filter_), unpacked(data)
        check_same("snapshot", new._placed.identity(), head.get("of", {}))
        new.steps = int(head["steps"])
        leaves, structure = jax.tree.flatten(new._state)
        with jax.enable_x64(True):
            new._state = jax.tree.unflatten(structure, [jnp.array(arrays[f"state.{i}"]) for i in range(len(leaves))])
        return new

    def __getstate__(self) -> dict[str, object]:
        """Filter, steps and state, in double precision wherever it is read: what is compiled is no part of it."""
        return {"filter": self.filter, "steps": self.steps, "_state": to_numpy(self._state)}

    def __setstate__(self, kept: dict[str, object]) -> None:
        vars(self).update(kept)
        self._placed = _place(self.filter)


class _Placed:
    """A filter compiled, its numbers where the program finds them: what all streams of the filter share."""

    def __init__(self, filter_: AbstractFilter):
        self.filter, self.horizon = filter_, filter_.horizon
        with jax.enable_x64(True):
            self.numbers, mould = cast(filter_)
            self.run = _program(mould)
            self.start: PyTree = jax.tree.map(jnp.asarray, filter_.init())
        self._like = np.zeros(filter_.received), np.zeros(len(filter_.inputs)), np.asarray(0)
        self.estimate: PyTree = jax.tree.structure(Estimate(np.zeros(()), np.zeros(()), filter_.claim))

    def identity(self) -> Identity:
        """Versions, names, numbers, and what a step computes, which counts for functions."""
        with jax.enable_x64(True):
            text = self.run.lower(self.numbers, self.start, *self._like).as_text()
        item = self.filter
        return {
            **versions(),
            "precision": ", ".join(sorted({str(leaf.dtype) for leaf in self.numbers})),
            "filter": type(item).__name__,
            "states": ", ".join(item.states),
            "inputs": ", ".join(item.inputs),
            "numbers heard": str(item.received),
            "numbers": short_name(self.numbers),
            "what is computed": short_name(text),
        }


_SHARED: WeakValueDictionary[int, _Placed] = WeakValueDictionary()  # by the id of a filter, which its entry keeps


def _place(filter_: AbstractFilter) -> _Placed:
    found = _SHARED.get(id(filter_))
    if found is None:
        found = _SHARED[id(filter_)] = _Placed(filter_)
    return found


@lru_cache
def _program(mould: Mould) -> Any:
    """One step of every filter that differs in numbers alone."""

    def step(
        numbers: list[jax.Array], state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array
    ) -> tuple[PyTree, list[jax.Array]]:
        item: AbstractFilter = mould.filled(numbers)
        after, estimate = item.step(state, z, u, k)
        return after, jax.tree.leaves(estimate)

    return jax.jit(step, compiler_options=understood())
