"""Marks for numbers that are known to be present, so that tests for NaN in them are decided at compile time.

Then a filter's treatment of missing components costs nothing where none is ever missing, and what depends on data only
through such tests is the same in all runs.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import JaxprEqn, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Shaped

from straightline.lowering import RULES, Lowering

_present: Any = Primitive("present")


def present(x: Shaped[jax.Array | np.ndarray, "*shape"]) -> Shaped[jax.Array, "*shape"]:
    """Return the same numbers, marked as never NaN.

    Where native code is made, `jnp.isnan` of them is known to be false. A branch for missing numbers (NaN) then costs
    nothing. XLA ignores the mark.

    Args:
        x: numbers that are never NaN, as the caller knows.
    """
    marked: jax.Array = _present.bind(jnp.asarray(x))
    return marked


def _mark_present(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Note in the graph that the argument's nodes (numbers that it loads or computes) are never NaN; return them."""
    lowering.graph.never_nan.update(inputs[0].ravel().tolist())
    return inputs


def _batch_present(arrays: Sequence[jax.Array], axes: Sequence[int]) -> tuple[jax.Array, int]:
    """Mark the numbers of a batch under `vmap`; return them with the number of the mapped axis, which is unchanged."""
    return present(arrays[0]), axes[0]


RULES["present"] = _mark_present
_present.def_impl(lambda x: x)
_present.def_abstract_eval(lambda x: x)
ad.primitive_jvps[_present] = lambda primals, tangents: (present(*primals), *tangents)
batching.primitive_batchers[_present] = _batch_present
mlir.register_lowering(_present, lambda context, x: [x])
