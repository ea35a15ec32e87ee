"""Numbers of a network that were rounded to single precision before it was made, as JAX makes tables by default."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import InputError
from heliograph.numerics.numpy_or_jax import constants, find_rounded_to_single, is_traced
from heliograph.simulation.node import HasNodes, Node

Traced = tuple[Callable[..., Any], tuple[np.ndarray, ...]]  # a function, and arguments to trace it with


def find_rounded_parts(network: HasNodes) -> dict[tuple[float, float], list[str]]:
    """Return {(number as meant, number as rounded): names of the parts of the network that hold it}.

    Only numbers that were rounded to single precision count, and only the first such number of each model.
    """
    names_by_number: dict[tuple[float, float], list[str]] = {}  # by (number as meant, number as rounded)
    first_rounded: dict[int, tuple[float, float] | None] = {}  # by id of the model, as nodes may share a model
    for name, model, functions in _yield_models_with_calls(network):
        if id(model) not in first_rounded:
            found = map(find_rounded_to_single, _yield_arrays(model, functions))
            first_rounded[id(model)] = next(filter(None, found), None)
        rounded = first_rounded[id(model)]
        if rounded is not None:
            names_by_number.setdefault(rounded, []).append(name)
    return names_by_number


def _yield_models_with_calls(network: HasNodes) -> Iterator[tuple[str, object, list[Traced]]]:
    """Yield (name, model, [(function, arguments)]) for the plant, sensors, channels and what nodes share.

    The functions are those of the model that may hold arrays; they can be called with these arguments.
    """
    plant, x, u = first(network.plant), np.zeros(len(network.states)), np.zeros(len(network.inputs))
    yield "plant", network.plant, [(plant.transition, (x, u)), (plant.noise_covariance, (u,))]
    for name, node in network.nodes.items():
        if isinstance(node, Node):
            functions: list[Traced] = []
            if not isinstance(node.sensor, LinearSensor):
                functions = [(first(node.sensor).typical(network.inputs).measure, (x,))]
            yield f"sensor of {name}", node.sensor, functions
            yield f"channel of {name}", node.channel, []
    if network.common is not None:
        yield "sensor and channel of all nodes", network.common, []
    if network.relays is not None:
        yield "relays", network.relays, []


def _yield_arrays(model: object, functions: list[Traced]) -> Iterator[Any]:
    """Yield the arrays of a model, and those that its functions hold."""
    for leaf in jax.tree.leaves(model):
        if isinstance(leaf, jax.Array | np.ndarray) and not is_traced(leaf):
            yield leaf
    for function, arguments in functions:
        yield from _collect_arrays(function, *arguments)


def _collect_arrays(function: Callable[..., Any], *arguments: np.ndarray) -> list[Any]:
    """Return the arrays that a function of a model holds, found by tracing it with these arguments.

    Such an array, of a user's own Python function, is in no field of the model: in its trace it is a constant. The list
    is empty if the function cannot be traced.
    """
    try:
        arrays, *_ = constants(function, *arguments)
        return [array for array in arrays if not is_traced(array)]
    except (InputError, TypeError, ValueError, IndexError, ArithmeticError, AttributeError):
        return []
