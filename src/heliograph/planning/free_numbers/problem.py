"""Error and powers of a network as functions of its free numbers, and their derivatives.

The gradient of the error is the adjoint's at fixed gains (`mode_riccati`), pulled back by JAX through the moments of
channels and through the powers. What JAX compiles is shared by all designs of the same network.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from inspect import signature
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.learning.parametric_network import Description, describe
from heliograph.model.over_time import first
from heliograph.numerics.check import InputError, array, fail, instance, items, table
from heliograph.numerics.module import are_same
from heliograph.numerics.types import Array, Float
from heliograph.planning.error_objective import Criterion, Error
from heliograph.planning.free_numbers.mode_riccati import ModeSolution, ModeSystem, lagrangian, solve_riccati
from heliograph.planning.free_numbers.reception_by_mode import (
    check_time_variation,
    list_sources,
    list_transmitters,
    make_mode_system,
    means_are_known,
)
from heliograph.planning.plant_moments import check_stable
from heliograph.planning.sequential_quadratic_programming import DescentProblem, Evaluation
from heliograph.planning.transmitters import require_plain_senders
from heliograph.simulation.network import Network

Build = Callable[..., Network]
Vector = Float[np.ndarray, "x"]

YOUNG = "young"  # the scalars in the bound of an uncertain mean gain


class FreeNumber(NamedTuple):
    """A free number or array of them: its start, and its least and largest values, of its shape."""

    start: np.ndarray
    low: np.ndarray
    high: np.ndarray


def young_scalars(steps: int) -> FreeNumber:
    """Return the scalar b of Young's inequality as a free number for each step, or as one for a steady bound.

    It starts at 0.1 and stays between 1e-6 and 1e3. Beyond these, the bound's factor 1 + b or 1 + 1 / b is over a
    thousand.
    """
    shape = () if steps == 1 else (steps,)
    return FreeNumber(start=np.full(shape, 0.1), low=np.full(shape, 1e-6), high=np.full(shape, 1e3))


class FreeNumbers(NamedTuple):
    """All free numbers as one vector."""

    by_name: dict[str, FreeNumber]

    @property
    def start(self) -> Vector:
        """Values of all free numbers at which a search starts."""
        return np.concatenate([number.start.ravel() for number in self.by_name.values()])

    @property
    def low(self) -> Vector:
        """Least values of all free numbers."""
        return np.concatenate([number.low.ravel() for number in self.by_name.values()])

    @property
    def high(self) -> Vector:
        """Largest values of all free numbers."""
        return np.concatenate([number.high.ravel() for number in self.by_name.values()])

    def split_by_name(self, x: Array) -> dict[str, Any]:
        """Return {name: number in its shape} from the vector x of all free numbers, which stand one after another.

        JAX may trace x.
        """
        by_name, begin = {}, 0
        for name, number in self.by_name.items():
            by_name[name] = x[begin : begin + number.start.size].reshape(number.start.shape)
            begin += number.start.size
        return by_name

    def draw_start(self, draws: np.random.Generator) -> Vector:
        """Return a random start (numbers,) for a further descent.

        A number whose range has two ends is drawn between them. Another one is its first start times a random factor,
        cut to the end that it has.
        """
        has_two_ends = np.isfinite(self.low) & np.isfinite(self.high)
        between_ends = draws.uniform(np.where(has_two_ends, self.low, 0.0), np.where(has_two_ends, self.high, 1.0))
        factor = np.exp(draws.normal(size=len(self.low)))
        about_first_start = np.clip(self.start * factor, self.low, self.high)
        return np.where(has_two_ends, between_ends, about_first_start)


def make_free_numbers(free: object) -> FreeNumbers:
    """Return the free numbers of {name: (start, low, high)}; a start may be an array, ends numbers or of its shape.

    Raises:
        ValueError: nothing free, ends that do not enclose the start.
    """
    numbers = {}
    for name, value in table("free", free, "(start, low, high)").items():
        parts = items(f"free number {name!r}", value, "(start, low, high)")
        if len(parts) != 3:
            raise fail(f"free number {name!r}", "(start, low, high)", f"{len(parts)} numbers")
        start = array(f"start of {name!r}", parts[0], (None,) * np.ndim(parts[0]))
        low, high = (_read_range_end(name, end, start.shape) for end in parts[1:])
        if not np.all((low <= start) & (start <= high)):
            raise fail(f"free number {name!r}", "a start between its ends", f"{parts[0]} of {parts[1]} to {parts[2]}")
        numbers[name] = FreeNumber(start, low, high)
    if YOUNG in numbers:
        raise fail("free", f"names other than {YOUNG!r}, which stands for a scalar of the bound", YOUNG)
    if not numbers:
        raise fail("free", "at least one number (name: (start, low, high))", "none: nothing is free")
    return FreeNumbers(numbers)


def _read_range_end(name: str, end: object, shape: tuple[int, ...]) -> np.ndarray:
    """Return an end of the range of the number `name`, broadcast to its start's `shape`; it may be infinite."""
    try:
        value = np.broadcast_to(np.asarray(end, dtype=float), shape)
    except (TypeError, ValueError):
        raise fail(f"end of {name!r}", f"a number, or numbers of shape {shape}", repr(end)) from None
    if np.any(np.isnan(value)):
        raise fail(f"end of {name!r}", "numbers", "nan")
    return value


def read_free_numbers(build: Build, free: object) -> tuple[Build, FreeNumbers]:
    """Return a function that builds a network from its free numbers by name, and these numbers.

    `free`: {name: (start, low, high)}, the arguments of `build`. If it is None, `build` marks its free numbers by
    `hg.free`; the result is then a function that puts values in the place of the marks.

    Raises:
        ValueError: arguments of the function that are not the free numbers, marks that are no intervals.
    """
    names = list(table("free", free, "(start, low, high)")) if free is not None else []
    try:
        signature(build).bind(**dict.fromkeys(names))
    except TypeError as error:
        raise fail("free", "the arguments of the function, (start, low, high) by name", str(error)) from None
    if free is not None:
        return build, make_free_numbers(free)
    description = describe(build)
    marks = {}
    for mark in description.parameters.every:
        if mark.domain.kind != "interval":
            raise fail(f"free number {mark.name!r}", "one between two limits", f"a {mark.domain.kind}")
        ends = (np.full(mark.start.shape, end) for end in (mark.domain.low, mark.domain.high))
        marks[mark.name] = FreeNumber(np.asarray(mark.start), *ends)
    return partial(_build_by_name, description), FreeNumbers(marks)


def _build_by_name(description: Description, **values: object) -> Network:
    """Return the network of a description with these values in place of its marks."""
    return description.at(values)


UNTRACEABLE = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError
PROGRAMS = 16  # networks whose programs are cached
LEAST_UNIT = 1e-12  # of a number whose range and start are less
INSIDE = 1e-9  # of the way from an end to the start


class ErrorAndPowerSlopes(NamedTuple):
    """Derivatives by the free numbers x: of the error, and of what each transmitter sends at each step."""

    error: Float[np.ndarray, "x"]
    powers: Float[np.ndarray, "time hops x"]


@dataclass(frozen=True, eq=False)
class TracedNetwork:
    """A function of numbers that returns a network, the error of it, and what the function returned at the start.

    Equal ones share their programs. A function may read numbers that live outside of it; that these have changed is
    seen by what it returns.
    """

    build: Build
    numbers: FreeNumbers
    error: Error
    young: bool
    start: Network

    def __eq__(self, other: object) -> bool:
        """Return whether the other network leads to the same programs: equal builder, network and shapes of arrays."""
        if not isinstance(other, TracedNetwork):
            return False
        mine = self.build, self.start, self._list_array_shapes()
        theirs = other.build, other.start, other._list_array_shapes()
        return are_same(mine, theirs)

    def __hash__(self) -> int:
        """Return the hash of the arrays' shapes, in which equal networks agree."""
        return hash(self._list_array_shapes())

    def _list_array_shapes(self) -> tuple[object, ...]:
        """Return what decides the shapes of the compiled program's arrays: it is compiled anew if this changes.

        It is the shape of each free number, the number of steps, whether these repeat for ever (no horizon), and
        whether a scalar of Young's inequality for each step is among the numbers (`young`).
        """
        shapes = tuple((name, number.start.shape) for name, number in self.numbers.by_name.items())
        return shapes, self.error.steps, self.error.horizon is None, self.young

    def make_system(self, x: Array) -> ModeSystem:
        """Return the system of the best linear filter if the free numbers have the values x (numbers,).

        JAX traces x to differentiate. A function that needs the value of a number (UNTRACEABLE) is refused. If a scalar
        of Young's inequality is one of the numbers (`self.young`), it bounds the error, and is not passed to the
        network.

        Raises:
            ValueError: a function that JAX cannot trace.
        """
        values = self.numbers.split_by_name(jnp.asarray(x))
        young = values.pop(YOUNG) if self.young else None
        try:
            network = self.build(**values)
        except UNTRACEABLE as error:
            expected = "operations of jax.numpy on its numbers, and no choice by their values"
            raise fail("network of free numbers", expected, type(error).__name__) from None
        return make_mode_system(network, self.error, young)

    def differentiate_by_numbers(self, x: Array, solution: ModeSolution) -> ErrorAndPowerSlopes:
        """Return the derivatives of error and powers by the free numbers x (numbers,).

        The error's derivative is that of the Lagrangian with the solution's covariances X, gains K and adjoint L held
        fixed. Derivatives by the system's arrays come first; JAX pulls all of them back to x at once.
        """
        system, pull_back = jax.vjp(self.make_system, jnp.asarray(x))
        # Derivatives by the system's arrays, each in the form of a system: of the error, then of each single power.
        of_error, count = jax.grad(lagrangian)(system, solution), system.powers.size
        one_for_each = jnp.eye(count).reshape(count, *system.powers.shape)
        of_powers = jax.tree.map(lambda leaf: jnp.zeros((count, *leaf.shape)), system)._replace(powers=one_for_each)
        cotangents = jax.tree.map(lambda error, powers: jnp.concatenate([error[None], powers]), of_error, of_powers)
        (slopes,) = jax.vmap(pull_back)(cotangents)  # by the numbers, (1 + powers, numbers)
        return ErrorAndPowerSlopes(error=slopes[0], powers=slopes[1:].reshape(*system.powers.shape, len(x)))


@lru_cache(PROGRAMS)
def compile_programs(
    network: TracedNetwork,
) -> tuple[Callable[[Array], ModeSystem], Callable[[Array, ModeSolution], ErrorAndPowerSlopes]]:
    """Return the compiled programs of a network's system and of its derivatives; equal networks share them.

    The last PROGRAMS of them are kept.
    """
    return compile_on_call(network.make_system), compile_on_call(network.differentiate_by_numbers)


class EvaluatedPoint(NamedTuple):
    """System, its solution and derivatives at a vector of numbers; the error is smoothed where it is an eigenvalue."""

    system: ModeSystem
    solution: ModeSolution
    slopes: ErrorAndPowerSlopes
    criterion: Criterion

    @property
    def covariances(self) -> Float[np.ndarray, "time n n"]:
        """Error covariances after each step."""
        return np.asarray(self.solution.parts.sum(axis=1))

    @property
    def error(self) -> float:
        """Return the number that the search minimises: the error, or if it is an eigenvalue its smoothed form."""
        return self.criterion.smooth(self.covariances).value

    @property
    def powers(self) -> Float[np.ndarray, "time hops"]:
        """Powers that the transmitters send."""
        return np.asarray(self.system.powers)


class FreeNumberProblem:
    """A network that is a function of numbers, as a descent needs it; the last point is cached."""

    def __init__(self, build: Build, numbers: FreeNumbers, error: Error):
        """Build the network at the starts of its free numbers, and compile its programs.

        If a mean gain is uncertain, the scalar of Young's inequality, which bounds the error, becomes one more free
        number, and `young` is True. `build` takes the free numbers as keyword arguments.
        """
        self.build, self.numbers, self.error, self.young = build, numbers, error, False
        network = self.network(numbers.start)
        check_time_variation(network, error)
        sources = list_sources(network).items()
        if not all(means_are_known(name, first(source.channel)) for name, source in sources):
            self.young, self.numbers = True, FreeNumbers(numbers.by_name | {YOUNG: young_scalars(error.steps)})
        self.names, self.criterion = list_transmitters(network), error.criterion(network.states)
        self._system, self._slopes = compile_programs(TracedNetwork(build, self.numbers, error, self.young, network))
        self._last: dict[tuple[bytes, int | None], EvaluatedPoint] = {}

    def network(self, x: Vector) -> Network:
        """Return the network at the free numbers x.

        The scalar named YOUNG (of Young's inequality, in a bound of the error) is no argument of the network.
        """
        values = {
            name: float(value) if np.ndim(value) == 0 else value
            for name, value in self.numbers.split_by_name(x).items()
            if name != YOUNG
        }
        with jax.enable_x64(True):
            network = instance("network of free numbers", self.build(**values), Network, "a Network")
        require_plain_senders("a design", network.nodes)
        return network

    def check_ends(self) -> None:
        """Raise ValueError if no network exists with a number near an end of its range, the others at their starts.

        An end itself need not be possible, such as a noise of variance zero. INSIDE: the distance from the end, as a
        share of the way to the start.
        """
        starts = {name: number.start for name, number in self.numbers.by_name.items()}
        for name, (start, low, high) in self.numbers.by_name.items():
            for end in (low, high):
                end_or_start = np.where(np.isfinite(end), end, start)
                near_end = end_or_start + INSIDE * (start - end_or_start)
                values = {**starts, name: near_end}
                try:
                    self.network(np.concatenate([value.ravel() for value in values.values()]))
                except InputError as error:
                    what = f"{' '.join(str(end).split())}, where: {error}"
                    raise fail(f"ends of {name!r}", "numbers between which there is a network", what) from None

    def solve_at(self, x: Vector, criterion: Criterion | None = None) -> EvaluatedPoint:
        """Return system, solution and derivatives at x, for a criterion (that of the problem unless given).

        Args:
            x: values of all free numbers, as one vector.
            criterion: the criterion, such as one that is smoothed more.

        Raises:
            ValueError: an error that grows without limit, powers that do.
        """
        criterion = self.criterion if criterion is None else criterion
        # Only the last point is kept: a search asks for its error, then for its slopes.
        key = x.tobytes(), criterion.sharpness
        if key not in self._last:
            system = ModeSystem(*(None if v is None else np.asarray(v) for v in self._system(np.asarray(x))))
            if system.start is None:
                # With Young's scalar b the system holds sqrt(1 + b) A; the plant itself has to be stable.
                scale = np.sqrt(1 + np.ravel(self.numbers.split_by_name(x)[YOUNG])[0]) if self.young else 1.0
                check_stable(system.transition[0] / scale)
            solution = solve_riccati(system, criterion)
            slopes = ErrorAndPowerSlopes(*(np.asarray(slope) for slope in self._slopes(np.asarray(x), solution)))
            self._last = {key: EvaluatedPoint(system, solution, slopes, criterion)}
        return self._last[key]

    def evaluate(self, x: Vector, sharpness: int | None) -> Evaluation | None:
        """Return the error, the powers and their derivatives, or None if error or powers grow without limit.

        Args:
            x: values of all free numbers, as one vector.
            sharpness: q in tr(S^q)^(1/q), which stands for the largest eigenvalue; None for the trace.
        """
        try:
            point = self.solve_at(x, self.criterion._replace(sharpness=sharpness))
        except ValueError:
            return None
        return Evaluation(
            error=point.error,
            error_slope=point.slopes.error,
            powers=point.powers.ravel(),
            power_slope=point.slopes.powers.reshape(-1, len(x)),
        )

    def descent_problem(self) -> DescentProblem:
        """Return the problem of a descent, in units of the numbers' ranges, or of their starts if a range is infinite.

        No unit is below LEAST_UNIT.
        """
        low, high = self.numbers.low, self.numbers.high
        width = high - low
        unit = np.maximum(np.where(np.isfinite(width), width, np.abs(self.numbers.start)), LEAST_UNIT)
        return DescentProblem(
            low=low,
            high=high,
            unit=unit,
            sharpnesses=[criterion.sharpness for criterion in self.criterion.list_from_smoothest()],
            evaluate=self.evaluate,
            restore=lambda x: x,  # powers depend on x in any way, so that only a descent leads back within their limits
        )
