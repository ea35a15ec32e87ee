"""Sensors whose function, matrix or noise depends on inputs u: h(x, u), C(u), R(u); and what those without refuse."""

import inspect
from collections.abc import Callable
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.plant import NoiseFunction, check_shape
from heliograph.numerics.check import array, error_text, fail, function, name_list, names
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import as_real, trace_shape
from heliograph.numerics.types import ArrayLike, Names
from heliograph.random_affine.noises.noise import as_noise, count_components


class MeasureUnderInputs(Module):
    """The function x -> h(x, u) of a sensor under known inputs u; `function` is h."""

    function: Callable[..., ArrayLike]
    u: jax.Array

    def __call__(self, x: jax.Array) -> ArrayLike:
        """Return h(x, u)."""
        return self.function(x, self.u)


class NoiseOfInputs(Module):
    """Covariance of a sensor's noise as a function of inputs; whatever takes it for a law is refused in one line.

    Args:
        function: Cov v of u.
        inputs: names of the inputs.
        outputs: number of outputs.
    """

    function: NoiseFunction
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: int = eqx.field(static=True)

    def given(self, u: jax.Array) -> jax.Array:
        """Return the covariance (outputs, outputs) under u; a number stands for that variance of each."""
        value = as_real(self.function(u))
        return value * jnp.eye(self.outputs) if value.ndim == 0 else value

    def _refuse(self) -> Any:
        """Raise ValueError: what reads the mean or covariance needs a constant law, and this one depends on inputs."""
        expected = "a constant one, as what is computed before data needs"
        raise fail("sensor noise", expected, f"one of {list(self.inputs)}")

    covariance = mean = columns = dimension = property(_refuse)


def read_input_names(inputs: Names) -> tuple[str, ...]:
    """Return the names of a sensor's inputs as a tuple; raise ValueError for one that stands twice, or no names."""
    return names("inputs of a sensor", inputs, len(name_list("inputs of a sensor", inputs)), "u")


def count_matrix_rows(matrix: object, inputs: tuple[str, ...]) -> int:
    """Return the number of rows of a sensor's matrix, which is an array or a function of the inputs u.

    A function is traced with as many inputs as it has names; raise ValueError if it returns no matrix.
    """
    if not callable(matrix):
        return int(array("sensor matrix", cast(ArrayLike, matrix), ("outputs", "states")).shape[-2])
    try:
        shape = trace_shape("sensor matrix(u)", matrix, np.ones(len(inputs)))
    except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise fail("sensor matrix(u)", "a function in operations of jax.numpy", error_text(error)) from error
    if len(shape) != 2:
        raise fail("sensor matrix(u)", "shape (outputs, states)", f"shape {shape}")
    return shape[0]


def read_noise_of_inputs(
    noise: Any, outputs: Names | None, rows: int | None, inputs: tuple[str, ...]
) -> tuple[tuple[str, ...], Any]:
    """Return the names of the outputs, and the noise: a law, or a covariance that depends on inputs.

    Args:
        noise: a law, a covariance, a variance, or a function of the inputs that returns a covariance. A function is
            tried once, with all inputs 1, to check the shape of what it returns.
        outputs: names of the outputs; y, or y0, y1, ... for None.
        rows: number of rows of the sensor's matrix; None for a sensor without one.
        inputs: names of the inputs on which the noise may depend.
    """
    # The number of outputs comes from the sensor's matrix, else from their names, else from the noise, else it is 1.
    components_of_noise = None if callable(noise) else count_components(noise)
    names_given = None if outputs is None else name_list("sensor outputs", outputs)
    if rows:
        count = rows
    elif names_given is not None:
        count = len(names_given)
    else:
        count = components_of_noise or 1
    named = names("sensor outputs", outputs, count, "y")
    if not callable(noise):
        return named, as_noise("sensor noise", noise, count)
    law = NoiseOfInputs(noise, inputs, count)
    check_shape("sensor noise covariance(u)", law.given, (np.ones(len(inputs)),), (count, count))
    return named, law


def read_function_of_state_alone(measure: object) -> Callable[[jax.Array], ArrayLike]:
    """Return a sensor's function h(x); raise ValueError if it cannot be called with the state x alone.

    Functions of (x, u) need names for their inputs, with which the user would have got another check.
    """
    checked: Callable[[jax.Array], ArrayLike] = function("measure of a sensor", measure, "x")
    try:
        signature = inspect.signature(checked)
    except ValueError:  # a function not written in Python has no signature to check
        return checked
    try:
        signature.bind(None)
    except TypeError:
        expected = "a function of x alone, or inputs=[...], the names of those that a function of (x, u) takes"
        raise fail("measure of a sensor", expected, f"one of {signature}") from None
    return checked


def require_constant(name: str, value: object) -> Any:
    """Return a sensor's matrix or noise, the `value`, as it is; raise ValueError if it is a function.

    A function needs named inputs of the sensor, and here it has none. `name` is what it is called in the error.
    """
    if callable(value):
        expected = "a constant, or inputs=[...], the names of those of the plant that a function takes"
        raise fail(name, expected, "a function")
    return value
