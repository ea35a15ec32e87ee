"""One step of a filter as a function of C: from state, measurement and inputs to the state after, and to flags."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.model.checks.inputs import do_inputs_spoil
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.types import PyTree
from straightline import Unsupported, to_c

Real = Literal["double", "float"]
ROUNDING: dict[Real, float] = {"double": 1e-9, "float": 1e-4}  # of an expectation after many steps
RESERVED = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
))  # fmt: skip
ADDED = frozenset(("step", "estimate_mean", "estimate_covariance", "z", "u"))  # names beside the filter's state


class Member(NamedTuple):
    """An array in the state of the step: its name, and its numbers before the first step."""

    name: str
    start: np.ndarray


class StepProgram(NamedTuple):
    """A step: `compute` is its function of C, from `members`, z, u and step, and `initial` that of the first state.

    The results of `compute` are those of `members`, whether the estimate would lose its digits, so that the step must
    not be used, and whether the inputs are none. `mean` and `covariance` name the members that hold the estimate, which
    may be the filter's own; the others come last. `counts`: whether the step's number is part of the state.
    """

    filter: AbstractFilter
    members: list[Member]
    read: list[Member]
    compute: Any
    initial: Any
    mean: str
    covariance: str
    counts: bool


def write_step_program(filter: AbstractFilter, real: Real, prefix: str) -> StepProgram:
    """Write `step` of a filter as a function of C, for numbers of this type.

    A measurement that differs from what was expected by less than `ROUNDING` of itself is used, however small its
    deviations are: after many steps its expectation is rounded by as much (and below 1e-33 has few digits).

    Raises:
        ValueError: random numbers, or operations that are not supported; with the operation and its place.
    """
    state = filter.init()
    leaves, tree = jax.tree.flatten(state)
    z, u, k = np.zeros(filter.received), np.zeros(len(filter.inputs)), np.asarray(0)
    rounding, precision = ROUNDING[real], np.float64 if real == "double" else np.float32

    @jax.jit
    def step(leaves: list[jax.Array], z: jax.Array, u: jax.Array, k: jax.Array) -> list[jax.Array]:
        after, estimate, judgement, innovation = filter.judge_step(jax.tree.unflatten(tree, leaves), z, u, k)
        # Each component by itself, which is cheap: larger than expected, and beyond the bound of its own deviations.
        # Of a filter whose innovation is of part of z, such as a neighbour's measurement, every far one counts.
        far, differs = Judgement.find_far(innovation), jnp.abs(innovation.value)
        if differs.shape == z.shape:
            larger = jnp.abs(z) > jnp.abs(z - innovation.value)
            far &= larger & (differs > rounding * jnp.maximum(jnp.abs(z), 1e-33))
        implausible = jnp.any(far) | (judgement.input > 0)
        spoilt = do_inputs_spoil(filter, filter.inputs, u, k, precision)
        return [*jax.tree.leaves(after), estimate.mean, estimate.covariance, implausible, spoilt]

    examples = leaves, z, u, k
    named = [Member(name, np.asarray(leaf)) for name, leaf in zip(name_arrays(state), leaves, strict=True)]
    estimate = filter.estimate(state)
    named += [Member("estimate_mean", np.asarray(estimate.mean))]
    named += [Member("estimate_covariance", np.asarray(estimate.covariance))]
    try:
        symmetric = _find_symmetric(step, examples)
        whole = _write_step(step, examples, symmetric, prefix, real)
        # The estimate is a member of its own only if it is no array of the state.
        kept = list(range(len(leaves)))
        places = [_place(n, whole, named) for n in (len(leaves), len(leaves) + 1)]
        kept += [n for n in places if n >= len(leaves)]
        members = [named[n] for n in kept]

        def chosen(*arguments: Any) -> list[jax.Array]:
            results = step(*arguments)
            return [results[n] for n in [*kept, -2, -1]]

        names = [*(m.name for m in named[: len(leaves)]), "z", "u", "step"]
        results = [*(f"next_{m.name}" for m in members), "implausible", "spoilt"]
        compute = _write_step(chosen, examples, symmetric, prefix, real, (names, results))
        starts = [m.start for m in members]
        initial = to_c(
            lambda: starts, name=f"{prefix}_initial", single=real == "float", names=((), [m.name for m in members])
        )
    except Unsupported as error:
        raise no_c(error.operation, error.where) from None
    mean, covariance = (named[n].name for n in places)
    counts = compute.arguments[-1].used or filter.horizon is not None
    return StepProgram(filter, members, named[: len(leaves)], compute, initial, mean, covariance, counts)


def _place(number: int, code: Any, named: Sequence[Member]) -> int:
    """Return the first result that has the numbers of this one, before the first step too."""
    same = [n for n in range(number) if code.results[n].same == code.results[number].same]
    start = named[number].start
    return next((n for n in same if np.array_equal(named[n].start, start, equal_nan=True)), number)


def _write_step(
    step: Callable[..., Any],
    examples: tuple[Any, ...],
    symmetric: set[int],
    prefix: str,
    real: Real,
    names: tuple[Sequence[str], Sequence[str]] = ((), ()),
) -> Any:
    """Write a step as C; all but the measurement, of which components may be missing, is finite."""
    count = len(examples[0])
    finite = {*range(count), count + 1, count + 2}
    return to_c(
        step,
        *examples,
        name=f"{prefix}_compute",
        single=real == "float",
        names=names,
        finite=finite,
        symmetric=symmetric,
    )


def _find_symmetric(step: Callable[..., Any], examples: tuple[Any, ...]) -> set[int]:
    """Return which arrays of the state are always symmetric, of which one triangle is read.

    By induction: symmetric at the start, and after a step from symmetric ones. Assume all, drop those that are not.
    """
    symmetric = {n for n, leaf in enumerate(map(np.asarray, examples[0])) if _is_symmetric(leaf)}
    while True:
        results = _write_step(step, examples, symmetric, "step", "double").results if symmetric else []
        lost = {n for n in symmetric if not results[n].symmetric}
        if not lost:
            return symmetric
        symmetric -= lost


def no_c(operation: str, where: str) -> InputError:
    """Return an error, in one line, about an operation that cannot be exported."""
    return fail("export", "operations that C has", f"{operation} at {where}")


def name_arrays(state: PyTree) -> list[str]:
    """Return names in C for the arrays of a state, from their field names; the Gaussian that it holds has no name."""
    names: list[str] = []
    for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]:
        parts = [str(getattr(k, "name", getattr(k, "key", getattr(k, "idx", "")))) for k in path]
        own = "_".join(part for part in parts if part != "gaussian")
        text = "".join(c if c.isalnum() and c.isascii() else "_" for c in own)
        text = f"state_{text}".rstrip("_") if not text or not text[0].isalpha() else text
        while text in RESERVED | ADDED or text in names:
            text += "_"
        names.append(text)
    return names


def _is_symmetric(value: np.ndarray) -> bool:
    return value.ndim == 2 and len(value) > 1 and np.array_equal(value, value.T)
