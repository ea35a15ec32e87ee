"""A filter's step as functions of arrays that C can have: whole, or apart as its prediction and its correction."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.export.received_numbers import keep_all
from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.model.checks.plant_inputs import do_inputs_spoil
from heliograph.model.estimate import Innovation
from heliograph.numerics.types import PyTree

Refusal: TypeAlias = Callable[[jax.Array], jax.Array]  # from z to z without the numbers that are refused
ROUNDING = {"double": 1e-9, "float": 1e-4}  # of an expectation after many steps
PRECISION: dict[str, type[np.floating]] = {"double": np.float64, "float": np.float32}


class PartOfStep(NamedTuple):
    """A function of arrays that becomes one of C: the step, its prediction or its correction.

    Args:
        name: "step", "predict" or "correct".
        data: names of the data, "z", "u" or both.
        function: from (arrays of the state, data, number of the step) to arrays of the state, mean, covariance, and
            what is `other_results`.
        examples: arguments that it takes.
        other_results: names of the other results. "implausible": the estimate would lose its digits, and what was
            computed must not be used; "spoilt": an input has too few digits.
    """

    name: str
    data: tuple[str, ...]
    function: Callable[..., list[jax.Array]]
    examples: tuple[Any, ...]
    other_results: tuple[str, ...]


def make_parts_of_step(
    filter: AbstractFilter, real: str, apart: bool, leave_out: Refusal = keep_all
) -> list[PartOfStep]:
    """Return the functions of a filter that are exported to C: its step or, if `apart`, prediction and correction.

    They are functions of JAX on arrays, which JAX traces and from which C is then written. Each is returned with its
    name, the names of its data, example arguments, of which the trace takes shapes and types alone, and the names of
    its results after the state's arrays, the mean and the covariance, in the order in which it returns them.

    Args:
        filter: the filter.
        real: type of numbers in C, "double" or "float", by whose rounding data are judged.
        apart: whether prediction and correction are two functions; else the whole step is one.
        leave_out: puts NaN in z in place of numbers that are refused for their value; by default none is.
    """
    # Examples: the arrays of the state, a measurement z, inputs u and the number k of a step.
    state_arrays, structure = jax.tree.flatten(filter.init())
    z, u, k = np.zeros(filter.received), np.zeros(len(filter.inputs)), np.asarray(0)
    # Flags: data are so far off that the estimate would lose its digits; an input has too few digits itself.
    flags = ("implausible", "spoilt")
    if not apart:
        step = _make_step_function(filter, structure, real, leave_out)
        return [PartOfStep("step", ("z", "u"), step, examples=(state_arrays, z, u, k), other_results=flags)]
    # A robust filter also returns how much of each component it used, its weights: one correction shows whether it
    # does.
    _state, innovation = filter.correct(filter.predict(filter.init(), u, 0), z, 0)
    weights = () if innovation.weight is None else ("weight",)
    of_innovation = ("value", "nis", "arrived", *weights)
    predict = _make_prediction_function(filter, structure, real)
    correct = _make_correction_function(filter, structure, real, leave_out)
    return [
        PartOfStep("predict", ("u",), predict, examples=(state_arrays, u, k), other_results=flags),
        PartOfStep(
            "correct", ("z",), correct, examples=(state_arrays, z, k), other_results=("implausible", *of_innovation)
        ),
    ]


def _make_step_function(
    filter: AbstractFilter, tree: PyTree, real: str, leave_out: Refusal
) -> Callable[..., list[jax.Array]]:
    """Return the function of a whole step on arrays, from which C is written.

    `tree` is the structure of the filter's state, of which C holds the arrays, and `real` the type of numbers in C.
    `leave_out` puts NaN in z in place of numbers that are refused for their value.
    `judge_step` is the filter's step that also judges its data: `judgement.input` is above 0 if the inputs are
    implausible. `is_implausible` compares the innovation with its deviations; `do_inputs_spoil` says whether inputs
    have too few digits.
    """

    @jax.jit
    def step(arrays: list[jax.Array], z: jax.Array, u: jax.Array, k: jax.Array) -> list[jax.Array]:
        """Return the arrays of the state, the estimate and two flags after step k, with measurement z and input u.

        The first flag says that z or u is implausible, the second that u spoils the digits of numbers of type `real`.
        PRECISION maps this type to NumPy's. `tree` is the structure of the state.
        """
        state, z = jax.tree.unflatten(tree, arrays), leave_out(z)
        state_after, estimate, judgement, innovation = filter.judge_step(state, z, u, k)
        are_implausible = is_implausible(filter, innovation, z, real) | (judgement.input > 0)
        spoils_digits = do_inputs_spoil(filter, filter.inputs, u, k, PRECISION[real])
        return [*jax.tree.leaves(state_after), estimate.mean, estimate.covariance, are_implausible, spoils_digits]

    return step


def _make_prediction_function(filter: AbstractFilter, tree: PyTree, real: str) -> Callable[..., list[jax.Array]]:
    """Return the function of the prediction alone on arrays, from which C is written.

    `tree` is the structure of the filter's state, of which C holds the arrays, and `real` the type of numbers in C.
    `judgement.input` is above 0 if the inputs are implausible.
    """

    @jax.jit
    def predict(arrays: list[jax.Array], u: jax.Array, k: jax.Array) -> list[jax.Array]:
        """Return the arrays of the state, the estimate and two flags after the prediction of step k with input u.

        The first flag says that u is implausible, the second that u spoils the digits of numbers of type `real`. `tree`
        is the structure of the state.
        """
        before = jax.tree.unflatten(tree, arrays)
        prior = filter.predict(before, u, k)
        estimates = filter.estimate(before), filter.estimate(prior)
        spoilt = do_inputs_spoil(filter, filter.inputs, u, k, PRECISION[real])
        judgement = Judgement.judge_prediction(filter.claim, (before, prior), estimates, spoilt)
        return [*jax.tree.leaves(prior), estimates[1].mean, estimates[1].covariance, judgement.input > 0, spoilt]

    return predict


def _make_correction_function(
    filter: AbstractFilter, tree: PyTree, real: str, leave_out: Refusal
) -> Callable[..., list[jax.Array]]:
    """Return the function of the correction by a measurement, with its innovation as further results.

    C code is written from this JAX function, so that it takes and returns only arrays.

    Args:
        filter: the filter.
        tree: structure of the filter's state, which the function takes and returns as a list of arrays.
        real: type of numbers in C, "double" or "float"; a measurement is judged by their rounding.
        leave_out: puts NaN in z in place of numbers that are refused for their value.
    """

    @jax.jit
    def correct(arrays: list[jax.Array], z: jax.Array, k: jax.Array) -> list[jax.Array]:
        """Return the arrays of the state, the estimate, a flag, and the innovation of the correction with z in step k.

        The flag says that z is implausible. After it come the innovation, its squared distance, how much arrived, and
        the weights if there are any.
        """
        prior, z = jax.tree.unflatten(tree, arrays), leave_out(z)
        after, innovation = filter.correct(prior, z, k)
        # Estimates before and after z; judged by them are e' S^-1 e of the innovation, and how many numbers arrived.
        expected, estimate = filter.estimate(prior), filter.after_step(after, k)
        judgement = Judgement.judge_correction(
            filter.claim, (prior, after), (expected, estimate), innovation, z, filter.of_atoms, filter.angles_used()
        )
        implausible = is_implausible(filter, innovation, z, real)
        outcome = [implausible, innovation.value, judgement.distance, judgement.arrived]
        weight = [] if innovation.weight is None else [innovation.weight]
        return [*jax.tree.leaves(after), estimate.mean, estimate.covariance, *outcome, *weight]

    return correct


def is_implausible(filter: AbstractFilter, innovation: Innovation, z: jax.Array, real: str) -> jax.Array:
    """Return whether some component of z is larger than expected, and too many of its own deviations off.

    It is also implausible if one of the filter's angles has too many turns for numbers of type `real`. Each component's
    own deviation is used, since the joint distance would cost more. If the innovation is only of a part of z, such as a
    neighbour's measurement, every component that is so far off counts. A relative difference up to ROUNDING does not.
    PRECISION maps `real` to NumPy's type, whose relative rounding is `eps`; ROUNDING is 1e-9 for double and 1e-4 for
    float.
    """
    is_far, difference = Judgement.find_far(innovation), jnp.abs(jnp.asarray(innovation.value))
    if difference.shape == z.shape:
        is_larger_than_expected = jnp.abs(z) > jnp.abs(z - innovation.value)
        is_above_rounding = difference > ROUNDING[real] * jnp.maximum(jnp.abs(z), 1e-33)
        is_far &= is_larger_than_expected & is_above_rounding
        if used := filter.angles_used():
            is_far |= Judgement.find_unreadable(innovation, z, used.received, float(np.finfo(PRECISION[real]).eps))
    return jnp.any(is_far)
