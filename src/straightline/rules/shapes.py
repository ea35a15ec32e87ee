"""Rules of operations that move entries: they rearrange references and make no nodes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import JaxprEqn

from straightline.graph import Graph
from straightline.lowering import RULES, Lowering, Rule, arrange_nodes, result_shape
from straightline.nodes import Node, Unsupported
from straightline.rules.elementwise import select
from straightline.size_limits import FEW


def _make_rearranging_rule(function: Callable[[np.ndarray, Any, tuple[int, ...]], np.ndarray]) -> Rule:
    """Return the rule of an operation that only moves the nodes of one array.

    function(array, parameters, shape) returns the moved nodes, where `shape` is that of the result.
    """

    def rule(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Return the nodes of the array as `function` rearranges them."""
        return [function(inputs[0], equation.params, result_shape(equation))]

    return rule


def _broadcast_in_dim(x: np.ndarray, params: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of nodes broadcast to a shape: its axis k becomes axis broadcast_dimensions[k] of the result."""
    placed = [1] * len(shape)
    for size, axis in zip(x.shape, params["broadcast_dimensions"], strict=True):
        placed[axis] = size
    return np.broadcast_to(x.reshape(placed), shape)


def _slice(x: np.ndarray, params: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return the entries of JAX's `slice`: along each axis from its start up to its limit, by its step."""
    steps = params["strides"] or (1,) * x.ndim
    return x[tuple(map(slice, params["start_indices"], params["limit_indices"], steps))]


def _split(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return the parts of an array (of nodes) along the operation's axis, of the operation's sizes."""
    ends = np.cumsum(equation.params["sizes"])[:-1]
    return np.split(inputs[0], ends, axis=equation.params["axis"])


def _concatenate(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return arrays (of nodes) one after another along the operation's axis, as one array."""
    return [np.concatenate(inputs, axis=equation.params["dimension"])]


def _stack(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return arrays (of nodes) of one shape stacked along a new axis."""
    return [np.stack(inputs, axis=equation.params["axis"])]


def _unstack(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return an array (of nodes) as its parts along the operation's axis, one for each index, without that axis."""
    rows = np.moveaxis(inputs[0], equation.params["axis"], 0)
    return [rows[i : i + 1].reshape(rows.shape[1:]) for i in range(len(rows))]


def _lower_pad(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Return x surrounded by a filling, as JAX's `pad` does; negative padding cuts entries of x off.

    x is an array of nodes (the program's scalar operations), and the filling is one node. `padding_config` has for each
    axis how many entries come before and after x, and how many between two neighbours.
    """
    x, filling = inputs
    padded = np.empty(result_shape(equation), dtype=object)
    padded[...] = filling[()]
    # Find for each axis which entries stay, and where they go. There are `low` positions before the first entry, and
    # `inner` between neighbours.
    sources, targets = [], []
    for size, length, (low, _high, inner) in zip(x.shape, padded.shape, equation.params["padding_config"], strict=True):
        positions = low + np.arange(size) * (1 + inner)
        stays = (positions >= 0) & (positions < length)
        sources.append(np.flatnonzero(stays))
        targets.append(positions[stays])
    padded[np.ix_(*targets)] = x[np.ix_(*sources)]
    return [padded]


def _iota(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[Any]:
    """Return a constant array that counts 0, 1, 2, ... along one axis and does not change along the others."""
    shape, axis = result_shape(equation), equation.params["dimension"]
    numbers = np.arange(shape[axis]).astype(equation.params["dtype"])
    along_axis = numbers.reshape([-1 if d == axis else 1 for d in range(len(shape))])
    return [lowering.make_known_array(np.broadcast_to(along_axis, shape))]


def _make_empty_array(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[Any]:
    """Return an array of zeros for JAX's `empty`, whose entries may be anything: a loop will fill them."""
    return [lowering.make_known_array(np.zeros(result_shape(equation), equation.params["dtype"]))]


def select_array(graph: Graph, which: Node, cases: list[np.ndarray]) -> np.ndarray:
    """Return the array among `cases` whose number is `which`: the first if `which` < 0, the last if it is too large.

    It is a chain of selections.
    """
    # Go from the last case backward: if `which` is at most a case's number, the case replaces those after it.
    selected = cases[-1]
    for number, case in reversed(list(enumerate(cases[:-1]))):
        is_up_to_here = graph.node("le", "bool", which, graph.constant(number, which.type))
        pairs = zip(case.ravel().tolist(), selected.ravel().tolist(), strict=True)
        selected = arrange_nodes([select(graph, is_up_to_here, a, b) for a, b in pairs], case.shape)
    return selected


def _lower_dynamic_update_slice(lowering: Lowering, equation: JaxprEqn, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """Lower `dynamic_update_slice`: return x with `update` written at its starts, one for each axis.

    A start that depends on data may have at most FEW values: the result is selected among those of all.
    """
    x, update, starts = inputs[0], inputs[1], [lowering.get_only_node(s) for s in inputs[2:]]
    for axis, start in enumerate(starts):
        last_start = x.shape[axis] - update.shape[axis]
        if last_start and start.op != "constant":  # several starts, of which data decide
            if last_start >= FEW:
                raise Unsupported(f"one of {last_start + 1} places that data decide")
            other_starts = [s if a != axis else None for a, s in enumerate(starts)]
            cases = [_update_at(lowering, x, update, other_starts, first) for first in range(last_start + 1)]
            return [select_array(lowering.graph, start, cases)]
    return [_update_at(lowering, x, update, starts, 0)]


def _update_at(
    lowering: Lowering, x: np.ndarray, update: np.ndarray, starts: Sequence[Node | None], here: int
) -> np.ndarray:
    """Return x with `update` put at these starts, one for each axis; along the one whose start is None, at `here`.

    Along any other axis a start must be known, or the update as long as x, so that there is one start.
    """
    ranges = []
    for size, length, start in zip(update.shape, x.shape, starts, strict=True):
        has_one_start = length == size
        if start is not None and start.op != "constant" and not has_one_start:
            raise Unsupported("two places that data decide")
        first = here if start is None else 0 if has_one_start else int(start.value)
        first = min(max(first, 0), length - size)  # moved inside, as in JAX
        ranges.append(slice(first, first + size))
    updated = x.copy()
    updated[tuple(ranges)] = update
    return updated


RULES |= {
    "broadcast_in_dim": _make_rearranging_rule(_broadcast_in_dim),
    "reshape": _make_rearranging_rule(lambda x, params, shape: x.reshape(shape)),
    "squeeze": _make_rearranging_rule(lambda x, params, shape: x.reshape(shape)),
    "expand_dims": _make_rearranging_rule(lambda x, params, shape: x.reshape(shape)),
    "transpose": _make_rearranging_rule(lambda x, params, shape: np.transpose(x, params["permutation"])),
    "rev": _make_rearranging_rule(lambda x, params, shape: np.flip(x, params["dimensions"])),
    "tile": _make_rearranging_rule(lambda x, params, shape: np.tile(x, params["reps"])),
    "slice": _make_rearranging_rule(_slice), "split": _split, "concatenate": _concatenate, "stack": _stack,
    "unstack": _unstack, "pad": _lower_pad,
    "iota": _iota, "empty": _make_empty_array, "empty2": _make_empty_array,
    "dynamic_update_slice": _lower_dynamic_update_slice,
}  # fmt: skip
