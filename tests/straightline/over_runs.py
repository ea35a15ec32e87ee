"""A function of one run, compiled and called on arrays of runs."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

import straightline


def over_runs(function: Callable[..., Any], *arrays: Any, shared: Sequence[int] = ()) -> Any:
    """Its results, (run, ...); arrays of these numbers have no axis of runs."""
    trees = [jax.tree.map(np.asarray, a) for a in arrays]
    examples = [a if n in shared else jax.tree.map(lambda x: x[0], a) for n, a in enumerate(trees)]
    return straightline.compile(function, *examples, shared=shared)(*trees)
