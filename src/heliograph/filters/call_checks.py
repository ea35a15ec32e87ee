"""Calls of a filter by a user: refuse a state that is none of the filter, and inputs that its plant cannot take."""

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

import jax
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.model.checks.plant_inputs import check_inputs, do_inputs_spoil
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, PyTree

R = TypeVar("R")


def call_with_state(filter: Any, state: PyTree, function: Callable[..., R], *data: PyTree) -> R:
    """Call `function(filter, state, *data)`; if it fails since `state` is no state of the filter, say so.

    Raises:
        ValueError: a state of another form than the filter's.
    """
    try:
        return function(filter, state, *data)
    except (AttributeError, IndexError, TypeError, ValueError):
        # Only a user's own call names the state; calls inside a trace pass the error on.
        if is_traced(state) or _describe_structure(state) == _describe_structure(filter.init()):
            raise
        raise fail("state", "one of the filter's, as its init() returns", show_value(state)) from None


def call_with_inputs(filter: Any, state: PyTree, function: Callable[..., R], *data: PyTree) -> R:
    """Call `function(filter, state, *data)`, whose last data are u and k, and raise if the plant cannot take u.

    u is tested in the same compiled call. Inside a trace u has no value, and is not tested: the caller that traces must
    test it.

    Raises:
        ValueError: a state of another form than the filter's; an input u for which a noise covariance is no covariance
            or a matrix is not finite.
    """
    if not filter.inputs or is_traced(filter, state, *data):
        return call_with_state(filter, state, function, *data)
    result, is_invalid = call_with_state(filter, state, _wrap_with_input_test(function), *data)
    *_, u, k = data
    if is_invalid:
        check_inputs(filter.inputs, np.asarray(u)[None], filter, int(k))
    return cast(R, result)


@cache
def _wrap_with_input_test(function: Callable[..., R]) -> Callable[..., tuple[R, Array]]:
    """Return a compiled function that returns the function's result and whether the inputs spoil the step.

    Inputs spoil a step if the plant's functions of them are not finite, or give no covariance. There is one compiled
    function for each `function`, which the cache keeps.
    """

    @compile_on_call
    def call(filter: Any, state: PyTree, *data: PyTree) -> tuple[R, Array]:
        """Return the function's result, and whether the input u makes the plant's functions at step k invalid."""
        *_, u, k = data
        return function(filter, state, *data), do_inputs_spoil(filter, filter.inputs, u, k)

    return call


def _describe_structure(state: PyTree) -> PyTree:
    """Return the pytree structure of a state and the shapes of its arrays, by which two states are compared."""
    return jax.tree.structure(state), [np.shape(leaf) for leaf in jax.tree.leaves(state)]
