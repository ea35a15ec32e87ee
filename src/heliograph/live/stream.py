"""One filter on live data: push a measurement, read the estimate."""

from functools import lru_cache
from typing import Any
from weakref import WeakValueDictionary

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, given, measured
from heliograph.filters.plausibility import INPUT, in_words, why_inputs
from heliograph.live.identity import Identity, check_same, short_name, versions
from heliograph.live.mould import Mould, cast
from heliograph.live.snapshot import packed, unpacked
from heliograph.model.estimate import Estimate
from heliograph.model.limits import LimitsLike, limits_of
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

    `limits` and `invalid` as of a `Node`: numbers beyond them count as not arrived, and `dropped` counts them by
    component. What would spoil the state is refused (`push`).

    Raises:
        ValueError: no filter, limits that are none.
    """

    def __init__(self, filter_: AbstractFilter, limits: LimitsLike = None, invalid: ArrayLike = ()):
        if not isinstance(filter_, AbstractFilter):
            raise fail("stream", "a filter", type(filter_).__name__)
        self.filter = filter_
        self.limits = limits_of(filter_.received, limits, invalid)
        self.dropped = np.zeros(filter_.received, dtype=np.int64)
        self.steps = 0
        self._placed = _place(filter_)
        self._state = self._placed.start

    def push(self, measurement: ArrayLike, inputs: ArrayLike = ()) -> Estimate:
        """Advance one step: `inputs` led to this `measurement` (NaN where a component did not arrive).

        Raises:
            ValueError: a measurement or inputs that are not the filter's, infinite values, an input that is NaN, a
                step past the end of what varies over time, what is implausible; the state stays as it was.
        """
        placed, k = self._placed, self.steps
        z, u = np.asarray(measured(self.filter, measurement)), np.asarray(given(self.filter, inputs))
        outside = None if self.limits is None else self.limits.outside(z)
        z = z if outside is None else np.where(outside, np.nan, z)
        if placed.horizon is not None and k >= placed.horizon:
            raise fail("step", f"one of the {placed.horizon} that the filter covers, counted from 0", k)
        with jax.enable_x64(True):
            state, told, judged = placed.run(placed.numbers, self._state, z, u, np.asarray(k))
        if (said := np.asarray(judged))[2] > 0 or said[3] > 0:
            self._refuse(said, z, u)
        self._state, self.steps = state, k + 1
        self.dropped += 0 if outside is None else outside
        result: Estimate = placed.estimate.unflatten([np.asarray(leaf) for leaf in told])
        return result

    def _refuse(self, said: np.ndarray, z: np.ndarray, u: np.ndarray) -> None:
        """Refuse what is implausible: inputs without which the prediction would keep its digits, or the measurement."""
        distance, _, reason, _ = said.tolist()
        if len(u) and why_inputs(said[None]):
            nothing = np.full(len(z), np.nan), np.zeros(len(u)), np.asarray(self.steps)
            with jax.enable_x64(True):
                *_, judged = self._placed.run(self._placed.numbers, self._state, *nothing)
            if not why_inputs(np.asarray(judged)[None]):
                raise fail(f"inputs of step {self.steps}", "plausible ones", f"{u.tolist()}: {INPUT}")
        if reason > 0:
            why = in_words(reason, distance)
            raise fail(f"measurement of step {self.steps}", "a plausible one", f"{z.tolist()}: {why}")

    def save(self) -> bytes:
        """State and steps, for `restore`: after it, the same pushes give the same bits."""
        leaves = {f"state.{i}": leaf for i, leaf in enumerate(jax.tree.leaves(to_numpy(self._state)))}
        head = {"steps": self.steps, "dropped": self.dropped.tolist(), "of": self._placed.identity()}
        return packed(head, leaves)

    @classmethod
    def restore(
        cls, filter_: AbstractFilter, data: bytes, limits: LimitsLike = None, invalid: ArrayLike = ()
    ) -> "Stream":
        """The stream that was saved, of the same filter; `limits` and `invalid` from here on.

        Raises:
            ValueError: bytes that `save` did not return; the state of another filter, version or precision.
        """
        new, (head, arrays) = cls(filter_, limits, invalid), unpacked(data)
        check_same("snapshot", new._placed.identity(), head.get("of", {}))
        new.steps, new.dropped = int(head["steps"]), np.array(head["dropped"], dtype=np.int64)
        leaves, structure = jax.tree.flatten(new._state)
        with jax.enable_x64(True):
            new._state = jax.tree.unflatten(structure, [jnp.array(arrays[f"state.{i}"]) for i in range(len(leaves))])
        return new

    def __getstate__(self) -> dict[str, object]:
        """Filter, steps and state, in double precision wherever it is read: what is compiled is no part of it."""
        kept = {name: value for name, value in vars(self).items() if name != "_placed"}
        return kept | {"_state": to_numpy(self._state)}

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
    ) -> tuple[PyTree, list[jax.Array], jax.Array]:
        item: AbstractFilter = mould.filled(numbers)
        after, estimate, judgement = item.step_judged(state, z, u, k)
        return after, jax.tree.leaves(estimate), jnp.stack(judgement)

    return jax.jit(step, compiler_options=understood())
