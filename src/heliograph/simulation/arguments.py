"""Arguments of a run, checked: its key, its inputs, its precision, and the measurements."""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.checks.plant_inputs import check_inputs
from heliograph.numerics.check import array, check_columns, check_seed, fail, rank, show_value
from heliograph.numerics.random_keys import seed_key
from heliograph.numerics.types import ArrayLike
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node, ReceivingNode

Precision = TypeAliasType("Precision", Literal["float64", "float32"])  # of the numbers that a run computes


def make_run_key(key: object) -> jax.Array:
    """Return the JAX random key of a run from a seed, or the key itself; raise ValueError for anything else.

    A seed is a whole number; draws of a run are made from its key, the step and names alone.
    """
    if isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key) and key.shape == ():
        return key
    if isinstance(key, jax.Array | np.ndarray):
        raise fail("key", "a seed, or one key of jax.random.key", f"an array of {key.dtype} of shape {key.shape}")
    return seed_key(check_seed("key", key))


def read_plant_inputs(network: Network, inputs: ArrayLike | None, horizon: int) -> np.ndarray:
    """Return the plant's inputs, checked, as an array (horizon, inputs); None will do for a plant without inputs.

    Row k is what acts on the plant in the step that leads to measurement k. Columns of a table with names must have the
    names of the inputs, in their order; values must be allowed by plant, nodes and fusions, such as a time step above
    0.
    """
    count = len(network.inputs)
    if inputs is None and count:
        raise fail("inputs", f"an array ({horizon}, {count}) of {list(network.inputs)}", "none")
    check_columns("inputs", inputs, network.inputs)
    u: np.ndarray = np.zeros((horizon, 0)) if inputs is None else array("inputs", inputs, (horizon, count))
    check_inputs(network.inputs, u, (network.plant, network.nodes, network.fused))
    return u


def check_precision(precision: object) -> None:
    """Raise ValueError unless `precision` is the name of a precision of a run, one of the words of its type."""
    precisions = get_args(Precision.__value__)
    if not isinstance(precision, str) or precision not in precisions:
        raise fail("precision", f"one of {', '.join(precisions)}", show_value(precision))


def read_measurements(name: str, value: ArrayLike, steps: int, node: Node | ReceivingNode) -> np.ndarray:
    """Return a node's measurements (steps, received), NaN where nothing arrived.

    (steps,) is accepted for one component. A table whose columns have the components' names must have their order too.
    """
    title, received = f"measurements of node {name!r}", node.received
    check_columns(title, value, node.received_names)
    has_one_axis = received == 1 and rank(title, value) == 1
    shape = (steps,) if has_one_axis else (steps, received)
    values: np.ndarray = array(title, value, shape, missing=True)  # checked to have this shape, NaN allowed
    return values.reshape(steps, received)
