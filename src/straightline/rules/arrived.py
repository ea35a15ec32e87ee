"""Marks for numbers that are known to be present, so that tests for NaN in them are decided at compile time.

Then a filter's treatment of missing components costs nothing where none is ever missing, and what depends on data only
through such tests is the same in all runs.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import JaxprEqn, Primitive
from jax.interpreters import batching, mlir

from straightline.lowering import RULES, Lowering

_arrived: Any = Primitive("arrived")


def arrived(x: jax.Array) -> jax.Array:
    """Return the same numbers, marked by the caller as never NaN in place of a missing one."""
    marked: jax.Array = _arrived.bind(x)
    return marked


def _rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    lowering.graph.numbers.update(inputs[0].ravel().tolist())
    return inputs


def _mapped(arrays: Sequence[jax.Array], axes: Sequence[int]) -> tuple[jax.Array, int]:
    return arrived(arrays[0]), axes[0]


RULES["arrived"] = _rule
_arrived.def_impl(lambda x: x)
_arrived.def_abstract_eval(lambda x: x)
batching.primitive_batchers[_arrived] = _mapped
mlir.register_lowering(_arrived, lambda context, x: [x])
