"""Error and powers of a network as functions of its free numbers, and their derivatives.

The gradient of the error is the adjoint's at fixed gains (`mode_riccati`), pulled back by JAX through the moments of
channels and through the powers. What JAX compiles is shared by all designs of the same network.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.check import InputError, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.module import same
from heliograph.numerics.types import Array, Float
from heliograph.planning.descent import Evaluation, Problem
from heliograph.planning.error import Criterion, Error
from heliograph.planning.moments import check_stable
from heliograph.planning.numbers.free_numbers import YOUNG, Build, Numbers, Vector, young_scalars
from heliograph.planning.numbers.mode_riccati import ModeSolution, ModeSystem, lagrangian, solve_riccati
from heliograph.planning.numbers.reception import check_time, means_are_known, mode_system, sources_of, transmitters_of
from heliograph.simulation.network import Network

UNTRACEABLE = jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError
PROGRAMS = 16  # networks whose programs are cached
INSIDE = 1e-9  # of the way from an end to the start


class Slopes(NamedTuple):
    """Derivatives of the error, and of what each transmitter sends at each step."""

    error: Float[np.ndarray, "x"]
    powers: Float[np.ndarray, "time hops x"]


@dataclass(frozen=True, eq=False)
class TracedNetwork:
    """A function of numbers that returns a network, the error of it, and what the function returned at the start.

    Equal ones share their programs. A function may read numbers that live outside of it; that these have changed is
    seen by what it returns.
    """

    build: Build
    numbers: Numbers
    error: Error
    young: bool
    start: Network

    def __eq__(self, other: object) -> bool:
        return isinstance(other, TracedNetwork) and same(
            (self.build, self.start, self._shape()), (other.build, other.start, other._shape())
        )

    def __hash__(self) -> int:
        return hash(self._shape())

    def _shape(self) -> tuple[object, ...]:
        shapes = tuple((name, number.start.shape) for name, number in self.numbers.by_name.items())
        return shapes, self.error.steps, self.error.horizon is None, self.young

    def system(self, x: Array) -> ModeSystem:
        """System of the best linear filter at these numbers."""
        values = self.numbers.named(jnp.asarray(x))
        young = values.pop(YOUNG) if self.young else None
        try:
            network = self.build(**values)
        except UNTRACEABLE as error:
            expected = "operations of jax.numpy on its numbers, and no choice by their values"
            raise fail("network of free numbers", expected, type(error).__name__) from None
        return mode_system(network, self.error, young)

    def slopes(self, x: Array, solution: ModeSolution) -> Slopes:
        """Derivatives there, at fixed gains."""
        m, pull = jax.vjp(self.system, jnp.asarray(x))
        # Cotangents: of the error through everything, and of each power alone.
        of_error, size = jax.grad(lagrangian)(m, solution), m.powers.size
        unit = jnp.eye(size).reshape(size, *m.powers.shape)
        of_powers = jax.tree.map(lambda part: jnp.zeros((size, *part.shape)), m)._replace(powers=unit)
        cotangents = jax.tree.map(lambda error, rest: jnp.concatenate([error[None], rest]), of_error, of_powers)
        slopes = jax.vmap(pull)(cotangents)[0]
        return Slopes(slopes[0], slopes[1:].reshape(*m.powers.shape, len(x)))


@lru_cache(PROGRAMS)
def programs(network: TracedNetwork) -> tuple[Callable[[Array], ModeSystem], Callable[[Array, ModeSolution], Slopes]]:
    """Compiled programs of the system and of the derivatives."""
    return compiled(network.system), compiled(network.slopes)


class Point(NamedTuple):
    """Everything at a vector of numbers; the error smoothed where it is an eigenvalue."""

    system: ModeSystem
    solution: ModeSolution
    slopes: Slopes
    criterion: Criterion

    @property
    def covariances(self) -> Float[np.ndarray, "time n n"]:
        """Error covariances after each step."""
        return np.asarray(self.solution.parts.sum(axis=1))

    @property
    def error(self) -> float:
        """Error as it is made small."""
        return self.criterion.smooth(self.covariances)[0]

    @property
    def powers(self) -> Float[np.ndarray, "time hops"]:
        """Powers that the transmitters send."""
        return np.asarray(self.system.powers)


class NumberProblem:
    """A network that is a function of numbers, as a descent needs it; the last point is cached."""

    def __init__(self, build: Build, numbers: Numbers, error: Error):
        self.build, self.numbers, self.error, self.young = build, numbers, error, False
        network = self.network(numbers.start)
        check_time(network, error)
        sources = sources_of(network).items()
        if not all(means_are_known(name, first(source.channel)) for name, source in sources):
            self.young, self.numbers = True, Numbers(numbers.by_name | {YOUNG: young_scalars(error.steps)})
        self.names, self.criterion = transmitters_of(network), error.criterion(network.states)
        self._system, self._slopes = programs(TracedNetwork(build, self.numbers, error, self.young, network))
        self._last: dict[tuple[bytes, int | None], Point] = {}

    def network(self, x: Vector) -> Network:
        """Network at these numbers."""
        named = self.numbers.named(x).items()
        values = {name: float(v) if np.ndim(v) == 0 else v for name, v in named if name != YOUNG}
        with jax.enable_x64(True):
            return instance("network of free numbers", self.build(**values), Network, "a Network")

    def check_ends(self) -> None:
        """Raise ValueError where a number near an end of its range, the others at their starts, makes no network.

        An end itself may be one that is never reached, as a noise of variance zero.
        """
        starts = {name: number.start for name, number in self.numbers.by_name.items()}
        for name, (start, low, high) in self.numbers.by_name.items():
            for end in (low, high):
                near = np.where(np.isfinite(end), end, start)
                near = near + INSIDE * (start - near)
                values = {other: near if other == name else begin for other, begin in starts.items()}
                try:
                    self.network(np.concatenate([part.ravel() for part in values.values()]))
                except InputError as error:
                    what = f"{' '.join(str(end).split())}, where: {error}"
                    raise fail(f"ends of {name!r}", "numbers between which there is a network", what) from None

    def at(self, x: Vector, criterion: Criterion | None = None) -> Point:
        """Everything at a point, of an eigenvalue as sharp as the criterion has it.

        Raises:
            ValueError: an error that grows without limit, powers that do.
        """
        sharp = self.criterion if criterion is None else criterion
        key = x.tobytes(), sharp.sharpness
        if key not in self._last:
            system = ModeSystem(*(None if part is None else np.asarray(part) for part in self._system(np.asarray(x))))
            if system.start is None:
                scale = np.sqrt(1 + np.ravel(self.numbers.named(x)[YOUNG])[0]) if self.young else 1.0
                check_stable(system.transition[0] / scale)
            solution = solve_riccati(system, sharp)
            slopes = Slopes(*(np.asarray(part) for part in self._slopes(np.asarray(x), solution)))
            self._last = {key: Point(system, solution, slopes, sharp)}
        return self._last[key]

    def evaluate(self, x: Vector, sharpness: int | None) -> Evaluation | None:
        """Error, powers and derivatives; None where the error or the powers grow without limit."""
        try:
            now = self.at(x, self.criterion._replace(sharpness=sharpness))
        except ValueError:
            return None
        return Evaluation(now.error, now.slopes.error, now.powers.ravel(), now.slopes.powers.reshape(-1, len(x)))

    def for_descent(self) -> Problem:
        """Problem of a descent, in units of the numbers' ranges, or of their starts where they have none."""
        low, high = self.numbers.low, self.numbers.high
        unit = np.maximum(np.where(np.isfinite(high - low), high - low, np.abs(self.numbers.start)), 1e-12)
        sharpnesses = [criterion.sharpness for criterion in self.criterion.sharper()]
        return Problem(low, high, unit, sharpnesses, self.evaluate, lambda x: x)  # only a descent leads back
