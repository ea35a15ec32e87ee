"""Models that vary over time: the marker `OverTime`, whose leading axis is time, and `at`, the model of one step."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import fields
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from heliograph.numerics.check import fail, show_value
from heliograph.numerics.check import items as as_items
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import align_memories_over_time

T = TypeVar("T")


@readable
class OverTime(Module):
    """Values whose leading axis is time; an unmarked array never varies, whatever its shape.

    `values` is an array (time, ...) or any model object stacked over time; build the latter with `over_time`.
    """

    values: PyTree

    def __init__(self, values: object):
        """Hold an array, or a model of arrays, whose leading axes are all time and have one length."""
        self.values = jax.tree.map(_convert_leaf, values)
        lengths = {leaf.shape[0] if leaf.ndim else None for leaf in _list_arrays(self.values)}  # None of a number
        if len(lengths) != 1 or None in lengths:
            raise fail("OverTime", "arrays that share one leading time axis", f"lengths {sorted(map(str, lengths))}")

    @property
    def steps(self) -> int:
        """Number of time steps covered."""
        return int(_list_arrays(self.values)[0].shape[0])


def _convert_leaf(leaf: object) -> object:
    """Return a leaf of a model: numbers and lists as arrays of doubles, anything else as it is."""
    return np.asarray(leaf, dtype=np.float64) if isinstance(leaf, int | float | list) else leaf


def _list_arrays(tree: object) -> list[PyTree]:
    """Return the arrays among the leaves of a model object."""
    return [leaf for leaf in jax.tree.leaves(tree) if eqx.is_array(leaf)]


def stack(models: Sequence[T], name: str = "stack") -> T:
    """Stack model objects of one structure into one object whose arrays have a new leading axis.

    Everything that is no array must be the same in all of them, and is kept.

    Args:
        models: the objects.
        name: what they are called in an error.

    Raises:
        ValueError: objects of different structures, or arrays of different shapes.
    """
    leaves_and_structures = [jax.tree.flatten(model) for model in models]
    if len({_describe_structure(leaves, structure) for leaves, structure in leaves_and_structures}) != 1:
        raise fail(name, "objects of one structure and one set of shapes", _describe_difference(models))
    leaf_of_models = zip(*(leaves for leaves, _ in leaves_and_structures), strict=True)
    # Leaves that are not arrays are the same in all models.
    stacked = [_stack_leaves(*leaves) if eqx.is_array(leaves[0]) else leaves[0] for leaves in leaf_of_models]
    _leaves, structure = leaves_and_structures[0]
    stacked_model: T = jax.tree.unflatten(structure, stacked)
    return stacked_model


def _describe_difference(models: Sequence[object]) -> str:
    """Return in words the first part in which one of several models has another structure than the first model.

    Such as "law: Constant of number 0, Rayleigh of number 3".
    """
    i = next(i for i, model in enumerate(models) if not have_same_structure(model, models[0]))
    a, b, path = models[0], models[i], list[str]()
    # Go down into the first part that differs, as long as both are modules of one class.
    while type(a) is type(b) and isinstance(a, Module):
        differing = [f.name for f in fields(a) if not have_same_structure(getattr(a, f.name), getattr(b, f.name))]
        if not differing:
            break
        a, b = getattr(a, differing[0]), getattr(b, differing[0])
        path.append(differing[0])
    part = f"{'.'.join(path)}: " if path else ""
    return f"{part}{_name_structure(a)} of number 0, {_name_structure(b)} of number {i}"


def _name_structure(part: Any) -> str:
    """Return the shape of an array, the class of a model, or anything else as it is."""
    if eqx.is_array(part):
        return f"shape {np.shape(part)}"
    return type(part).__name__ if isinstance(part, Module) else show_value(part)


def structure_key(model: object) -> Hashable:
    """Return a key that is equal for model objects which differ in nothing but the values of their arrays."""
    return _describe_structure(*jax.tree.flatten(model))


def _describe_structure(leaves: Sequence[Any], tree: Hashable) -> Hashable:
    """Return a hashable key of a flattened model: its tree, the shapes of its arrays, and its other leaves."""
    return tree, tuple(("array", leaf.shape) if eqx.is_array(leaf) else leaf for leaf in leaves)


def have_same_structure(a: object, b: object) -> bool:
    """Return whether two model objects differ in nothing but the values of their arrays."""
    return structure_key(a) == structure_key(b)


def _stack_leaves(*leaves: PyTree) -> object:
    """Return arrays of one shape stacked along a new first axis: a NumPy array, or JAX's if one of them is JAX's."""
    if any(isinstance(leaf, jax.Array) for leaf in leaves):
        return jnp.stack(leaves)
    return np.stack(leaves)


def over_time(items: Sequence[object]) -> OverTime:
    """Return one model object per time step (a channel, a plant, ...) as a single object that varies in time.

    Memories of channels that have no name become one memory over time, whose transition may differ from step to step.

    Args:
        items: objects of one structure, one for each step.

    Raises:
        ValueError: no items, or items that differ in structure.
    """
    items = as_items("over_time", items, "objects, one for each step")
    if not items:
        raise fail("over_time", "at least one item", "none")
    return OverTime(stack(align_memories_over_time(items), "over_time"))


def at(tree: PyTree, k: int | np.integer | Int[np.ndarray | Array, ""]) -> PyTree:
    """Return a model as it is at step k: every `OverTime` inside is replaced by its k-th values.

    Args:
        tree: a plant, a sensor, a channel or any tree of arrays. NumPy arrays stay NumPy arrays unless k is traced.
        k: the step, from 0. Shape ().
    """

    def read(leaf: object) -> PyTree:
        """Return the k-th values of an `OverTime` in the tree, any other leaf as it is."""
        if not isinstance(leaf, OverTime):
            return leaf
        # Only arrays have an axis of steps. Everything else is the same at all steps.
        values, rest = eqx.partition(leaf.values, eqx.is_array)
        return eqx.combine(jax.tree.map(lambda v: _take_entry(v, k), values), rest)

    return jax.tree.map(read, tree, is_leaf=lambda leaf: isinstance(leaf, OverTime))


def _take_entry(values: PyTree, k: PyTree) -> object:
    """Return the entry k of an array along its first axis, also for a k that JAX traces."""
    if isinstance(k, jax.Array):
        return jax.lax.dynamic_index_in_dim(jnp.asarray(values), k, keepdims=False, allow_negative_indices=False)
    return values[k, ...]  # with the dots, an entry of one number is still an array


def steps_covered(tree: object) -> int | None:
    """Return the smallest number of steps that the time-varying parts of a model have, or None if nothing varies.

    Args:
        tree: a plant, a sensor, a channel or any tree of arrays.
    """
    leaves = jax.tree.leaves(tree, is_leaf=lambda leaf: isinstance(leaf, OverTime))
    steps = [leaf.steps for leaf in leaves if isinstance(leaf, OverTime)]
    return min(steps) if steps else None


def unstack(model: object) -> list[PyTree]:
    """Return a list with the object of each step of an `OverTime`, or with the object alone if it does not vary."""
    return [at(model, i) for i in range(model.steps)] if isinstance(model, OverTime) else [model]


def vary_over_steps(steps: Sequence[T], *models: object) -> T | OverTime:
    """Return an object for each step as one that varies over time; the first alone where none of the models varies."""
    return steps[0] if steps_covered(models) is None else over_time(steps)


def list_models_by_step(model: PyTree, count: int) -> list[PyTree]:
    """List the objects of the first `count` steps, the same one at each where it does not vary."""
    return unstack(model)[:count] if isinstance(model, OverTime) else [model] * count


def stack_over_time(model: PyTree) -> PyTree:
    """Return the object inside an `OverTime`, whose arrays have a first axis of time; any other object as it is."""
    return model.values if isinstance(model, OverTime) else model


def at_each_step(function: Callable[..., object], *items: object) -> PyTree:
    """Return function(*items); if some item is an `OverTime`, an `OverTime` of the function's result at each step.

    Steps are as many as all varying items cover. So a function of constant models serves models that vary.
    """
    steps = steps_covered(items)
    return function(*items) if steps is None else over_time([function(*at(items, k)) for k in range(steps)])


def first(model: object) -> PyTree:
    """Return a plant, sensor or channel at its first step."""
    return at(model, 0) if isinstance(model, OverTime) else model
