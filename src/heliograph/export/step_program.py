"""One step of a filter as functions of C: from state, measurement and inputs to the state after, and to flags."""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.export.received_numbers import keep_all
from heliograph.export.step_parts import PartOfStep, Refusal, make_parts_of_step
from heliograph.factors.factored_gaussian import Gaussian, from_covariance
from heliograph.factors.high_low_mean_gaussian import SplitMeanGaussian, centred_from_covariance
from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import InputError, fail
from heliograph.numerics.types import PyTree
from straightline import Unsupported, to_c

Real = Literal["double", "float"]
# What `straightline.to_c` returns: name and text (`definition`) of a function of C, what it reads (`arguments`) and
# writes (`results`), and how often it has each operation.
CFunction: TypeAlias = Any
RESERVED = frozenset((
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else", "enum", "extern", "float",
    "for", "goto", "if", "inline", "int", "long", "register", "restrict", "return", "short", "signed", "sizeof",
    "static", "struct", "switch", "typedef", "union", "unsigned", "void", "volatile", "while",
))  # fmt: skip
ADDED = frozenset(("step", "estimate_mean", "estimate_covariance", "z", "u"))  # names beside the filter's state
SAME = 1e-6  # deviations to which a covariance's factors give it back


class StateMember(NamedTuple):
    """An array in the state of the step: its name, and its numbers before the first step."""

    name: str
    start: np.ndarray


class StepProgram(NamedTuple):
    """A step as functions of C.

    Args:
        filter: the filter.
        members: arrays of the state in C: those of the filter's state, then mean and covariance of the estimate, unless
            these are arrays of the state themselves.
        read: the members that a step reads: those of the filter's state.
        parts: the whole step, or prediction and correction.
        computes: their functions in C, from `read`, the data and the step's number to `members` and what is beside.
        initial: the function in C that makes the first state.
        start_at: the one that makes the state of a mean and a covariance; None of a state that is more than these.
        mean: name of the member that holds the estimate's mean.
        covariance: name of the member that holds its covariance.
        counts: whether the step's number is part of the state.
    """

    filter: AbstractFilter
    members: list[StateMember]
    read: list[StateMember]
    parts: list[PartOfStep]
    computes: list[CFunction]
    initial: CFunction
    start_at: CFunction | None
    mean: str
    covariance: str
    counts: bool

    @property
    def operations(self) -> dict[str, int]:
        """Return how often each operation, such as "mul", is in the functions of a step; in a loop it counts once."""
        counts = [code.operations for code in self.computes]
        return {op: sum(count.get(op, 0) for count in counts) for every in counts for op in every}


def lower_step_to_c_functions(
    filter: AbstractFilter,
    real: Real,
    prefix: str,
    apart: bool = False,
    size: bool = False,
    leave_out: Refusal = keep_all,
) -> StepProgram:
    """Lower one step of a filter from JAX to functions of C; return them with the arrays of the state that they move.

    `_lower_part_to_c` translates a part; `_find_same_result` returns the first array of the state that always equals a
    given one. `_find_symmetric_arrays` says of which arrays one triangle is enough.

    Args:
        filter: the filter.
        real: type of numbers in C.
        prefix: of the functions' names.
        apart: whether prediction and correction are two functions; else they are one.
        size: whether loops stay loops; then it is traced within `write_short_programs`.
        leave_out: puts NaN in z in place of numbers that are refused for their value; by default none is.

    Raises:
        ValueError: random numbers, or operations that are not supported; with the operation and its place.
    """
    state = filter.init()
    read, of_estimate = _make_state_members(state, filter.estimate(state))
    candidates, parts = [*read, *of_estimate], make_parts_of_step(filter, real, apart, leave_out)
    try:
        symmetric = _find_symmetric_arrays(parts)
        # Mean and covariance of the estimate become members of their own only where no array of the state has the same
        # numbers after every part. So all are written once to see which results are the same; `holders` are the
        # numbers of the two candidates that hold mean and covariance.
        with_all = [_lower_part_to_c(part, symmetric, prefix, real, size) for part in parts]
        numbers = range(len(read), len(candidates))
        holders = [_find_same_result(n, with_all, candidates) for n in numbers]
        kept = [*range(len(read)), *(n for n in holders if n >= len(read))]
        members = [candidates[n] for n in kept]
        computes = [_lower_part_to_c(part, symmetric, prefix, real, size, kept, (read, members)) for part in parts]
        names, starts = [m.name for m in members], [m.start for m in members]
        initial = to_c(lambda: starts, name=f"{prefix}_initial", single=real == "float", names=((), names))
        # A state that is nothing but a mean and a covariance can be set to others.
        can_be_set = isinstance(state, Gaussian | SplitMeanGaussian) and apart
        start_at = _lower_start_to_c(filter, kept, names, prefix, real) if can_be_set else None
    except Unsupported as error:
        raise make_unsupported_error(error.operation, error.where) from None
    mean, covariance = (candidates[n].name for n in holders)
    # The number of the step is the last argument of each part.
    uses_step_number = any(code.arguments[-1].used for code in computes)
    return StepProgram(
        filter=filter,
        members=members,
        read=read,
        parts=parts,
        computes=computes,
        initial=initial,
        start_at=start_at,
        mean=mean,
        covariance=covariance,
        counts=uses_step_number or filter.horizon is not None,
    )


def _make_state_members(state: PyTree, estimate: Estimate) -> tuple[list[StateMember], list[StateMember]]:
    """Return members of the state in C: the arrays of the filter's state, and the estimate's mean and covariance.

    Each is a name and its numbers before the first step.
    """
    named_arrays = zip(name_state_arrays(state), jax.tree.leaves(state), strict=True)
    of_state = [StateMember(name, np.asarray(array)) for name, array in named_arrays]
    of_estimate = [
        StateMember("estimate_mean", np.asarray(estimate.mean)),
        StateMember("estimate_covariance", np.asarray(estimate.covariance)),
    ]
    return of_state, of_estimate


def _find_same_result(number: int, parts: Sequence[CFunction], named: Sequence[StateMember]) -> int:
    """Return the number of the first array of the state that always equals array `number`, or `number` itself.

    Two arrays are always equal if they are so at the start (`named`) and after each of the `parts`: results[n].same is
    the same number for all results of a part that equal each other.
    """
    same = [n for n in range(number) if all(code.results[n].same == code.results[number].same for code in parts)]
    start = named[number].start
    return next((n for n in same if np.array_equal(named[n].start, start, equal_nan=True)), number)


def _lower_part_to_c(
    part: PartOfStep,
    symmetric: set[int],
    prefix: str,
    real: Real,
    size: bool = False,
    kept: Sequence[int] | None = None,
    names: tuple[Sequence[StateMember], Sequence[StateMember]] = ((), ()),
) -> CFunction:
    """Lower a part of a step from JAX to a function of C and return that; all arguments but the measurement are finite.

    Args:
        part: the part, a function of the state's arrays, the data and the step's number. Its results are in this order
            the state's arrays, the estimate's mean and covariance, and what it has beside these, such as flags.
        symmetric: which arrays of the state are symmetric.
        prefix: of its name.
        real: type of its numbers.
        size: whether it is to be small, in loops.
        kept: which arrays of state and estimate are results; all by default.
        names: the members that are read, and those that are results; used where `kept` is given.
    """
    state_count = len(part.examples[0])
    first_other = state_count + 2  # number of the first result behind mean and covariance

    def choose_results(*arguments: Any) -> list[jax.Array]:
        """Return the results that are kept, then those beside state and estimate."""
        results = part.function(*arguments)
        return results if kept is None else [*(results[n] for n in kept), *results[first_other:]]

    array_names: tuple[list[str], list[str]] = ([], [])  # of arguments, and of results: by default those of `to_c`
    if kept is not None:
        read, members = ([m.name for m in some] for some in names)
        array_names = [*read, *part.data, "step"], [*(f"next_{name}" for name in members), *part.other_results]
    # Arguments that are finite, by number: arrays of the state, data but z (NaN: did not arrive), the step's number.
    finite_data = [state_count + n for n, name in enumerate(part.data) if name != "z"]
    step_number = state_count + len(part.data)
    return to_c(
        choose_results,
        *part.examples,
        name=f"{prefix}_compute" if part.name == "step" else f"{prefix}_compute_{part.name}",
        single=real == "float",
        names=array_names,
        finite={*range(state_count), *finite_data, step_number},
        symmetric=symmetric,
        short=size,
    )


def _lower_start_to_c(filter: AbstractFilter, kept: list[int], names: list[str], prefix: str, real: Real) -> CFunction:
    """Lower to C, and return, the function that makes the members of a state from a mean and a covariance.

    Members are the arrays of the filter's state as a C struct. The last result, `none`, is a flag: the arguments are no
    finite mean, or no covariance. The state keeps factors of the covariance. An indefinite matrix is changed by its
    factoring, so that the product of the factors differs from it: this sets the flag.

    The results have the names of those of a step, `next_` and the member's, since both write the members of a state.
    `to_c` translates a function of JAX for arguments like the examples.

    Args:
        filter: the filter.
        kept: numbers of the members among the arrays of the state, the estimate's mean and its covariance.
        names: names of the members.
        prefix: beginning of the function's name.
        real: C type of its numbers, "float" or "double".
    """
    make_state = centred_from_covariance if isinstance(filter.init(), SplitMeanGaussian) else from_covariance

    @jax.jit
    def start_from_moments(mean: jax.Array, covariance: jax.Array) -> list[jax.Array]:
        """Return the members of the state with a mean and a covariance, and whether these two are invalid.

        `make_state` makes the state, which holds the covariance as factors. An invalid covariance is found by the
        product of its factors, which must agree with it within SAME (1e-6) deviations. `kept` says which arrays of the
        state and estimate are members.
        """
        state = make_state(mean, covariance)
        estimate = filter.estimate(state)
        results = [*jax.tree.leaves(state), estimate.mean, estimate.covariance]
        deviations = jnp.sqrt(jnp.abs(jnp.diagonal(covariance)))
        difference = jnp.abs(jnp.asarray(estimate.covariance) - covariance)  # the factors' product less the matrix
        is_covariance = jnp.all(difference <= SAME * jnp.outer(deviations, deviations))
        is_valid = is_covariance & jnp.all(jnp.isfinite(mean)) & jnp.all(jnp.isfinite(covariance))
        return [*(results[n] for n in kept), ~is_valid]

    n = len(filter.states)
    return to_c(
        start_from_moments,
        np.zeros(n),
        np.eye(n),
        name=f"{prefix}_compute_start",
        single=real == "float",
        names=(["mean", "covariance"], [*(f"next_{name}" for name in names), "none"]),
    )


def _find_symmetric_arrays(parts: Sequence[PartOfStep]) -> set[int]:
    """Return the numbers of the state's arrays that are always symmetric, so that one triangle of each is enough.

    This is an induction. Arrays that are symmetric at the start are assumed to stay so. Those that a part (prediction
    or correction) then makes not symmetric are dropped, and the rest is tried again until none is dropped. `parts`: the
    whole step, or prediction and correction, as functions of JAX with example arguments; `_lower_part_to_c` translates
    one under this assumption, and says of each result whether it is symmetric.
    """
    leaves = parts[0].examples[0]
    symmetric = {n for n, leaf in enumerate(map(np.asarray, leaves)) if _is_symmetric(leaf)}
    while symmetric:
        codes = [_lower_part_to_c(part, symmetric, "step", "double") for part in parts]
        made_otherwise = {n for n in symmetric if not all(code.results[n].symmetric for code in codes)}
        if not made_otherwise:
            break
        symmetric -= made_otherwise
    return symmetric


def make_unsupported_error(operation: str, where: str) -> InputError:
    """Return the error of an operation that C does not have: its name, and the line of code that it comes from."""
    return fail("export", "operations that C has", f"{operation} at {where}")


def name_state_arrays(state: PyTree) -> list[str]:
    """Return names in C for the arrays of a state, from their field names; the field `gaussian` is left out.

    RESERVED has the words of C, ADDED the members that stand beside the state's arrays.
    """
    names: list[str] = []
    for path, _ in jax.tree_util.tree_flatten_with_path(state)[0]:
        # Each key of the path is that of an attribute, of a dictionary, or an index in a sequence.
        keys = [str(getattr(key, "name", getattr(key, "key", getattr(key, "idx", "")))) for key in path]
        joined = "_".join(key for key in keys if key != "gaussian")
        name = "".join(letter if letter.isalnum() and letter.isascii() else "_" for letter in joined)
        if not name or not name[0].isalpha():
            name = f"state_{name}".rstrip("_")
        while name in RESERVED | ADDED or name in names:  # words of C, other members, and earlier names
            name += "_"
        names.append(name)
    return names


def _is_symmetric(value: np.ndarray) -> bool:
    """Return whether an array is a symmetric matrix; a matrix of one row, which has no pairs of entries, is none."""
    return value.ndim == 2 and len(value) > 1 and np.array_equal(value, value.T)
