"""Any numbers of a network chosen for its steady error: amplifications, weights, places, whatever it is a function of.

The network is a function of them. Its gradient is the adjoint's at fixed gains (`modes_told`), pulled back by JAX
through the moments of channels and through the powers; a sequential quadratic programme does the rest.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import Bounds, NonlinearConstraint, minimize, nnls

from heliograph.numerics.check import array, fail, instance, items, table
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, Float
from heliograph.planning.measuring import means_are_known, measured, transmitters_of
from heliograph.planning.modes_told import Measured, Settled, settled, touched
from heliograph.simulation.network import Network

Build = Callable[..., Network]
Vector = Float[np.ndarray, "x"]

ITERATIONS, FINE = 300, 1e-13
AT = 1e-7  # relative: how near a limit is one that is reached
YOUNG = "young"  # the scalar in the bound of an uncertain mean gain


class Number(NamedTuple):
    """A free number or array of them: its start, and its least and largest values, of its shape."""

    start: np.ndarray
    low: np.ndarray
    high: np.ndarray


SCALAR = Number(np.array(0.1), np.array(1e-6), np.array(1e3))


class Numbers(NamedTuple):
    """All free numbers as one vector."""

    each: dict[str, Number]

    @property
    def start(self) -> Vector:
        """Where a search begins."""
        return np.concatenate([one.start.ravel() for one in self.each.values()])

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """The least and the largest."""
        low, high = (
            [part.ravel() for part in parts]
            for parts in zip(*((n.low, n.high) for n in self.each.values()), strict=True)
        )
        return np.concatenate(low), np.concatenate(high)

    def named(self, x: Array) -> dict[str, Any]:
        """The numbers by name, each in its shape."""
        result, begin = {}, 0
        for name, one in self.each.items():
            result[name] = x[begin : begin + one.start.size].reshape(one.start.shape)
            begin += one.start.size
        return result

    def drawn(self, draws: np.random.Generator) -> Vector:
        """Another start: anywhere between the ends, or where there are none by a factor about the first."""
        low, high = self.ends
        between = np.isfinite(low) & np.isfinite(high)
        within = draws.uniform(np.where(between, low, 0.0), np.where(between, high, 1.0))
        return np.where(between, within, np.clip(self.start * np.exp(draws.normal(size=len(low))), low, high))


def as_numbers(free: object) -> Numbers:
    """{name: (start, low, high)}; the start may be an array, and the ends numbers or arrays of its shape.

    Raises:
        ValueError: nothing free, ends that do not enclose the start.
    """
    found = {}
    for name, given in table("free", free, "(start, low, high)").items():
        parts = items(f"free number {name!r}", given, "(start, low, high)")
        if len(parts) != 3:
            raise fail(f"free number {name!r}", "(start, low, high)", f"{len(parts)} numbers")
        start = array(f"start of {name!r}", parts[0], (None,) * np.ndim(parts[0]))
        low, high = (np.broadcast_to(np.asarray(end, dtype=float), start.shape) for end in parts[1:])
        if not np.all((low <= start) & (start <= high)):
            raise fail(f"free number {name!r}", "a start between its ends", f"{parts[0]} of {parts[1]} to {parts[2]}")
        found[name] = Number(start, low, high)
    if YOUNG in found:
        raise fail("free", f"names other than {YOUNG!r}, which stands for a scalar of the bound", YOUNG)
    if not found:
        raise fail("free", "at least one number (name: (start, low, high))", "none: nothing is free")
    return Numbers(found)


class Slopes(NamedTuple):
    """Derivatives of the error, and of each transmitter's power."""

    error: Float[Array, "x"]
    powers: Float[Array, "hops x"]


class Problem:
    """Error and powers of a network by the numbers that it is a function of, each point computed once."""

    def __init__(self, build: Build, numbers: Numbers, weight_of: Callable[[tuple[str, ...]], np.ndarray]):
        self.build, self.numbers, self.young = build, numbers, False
        network = self.network(numbers.start)
        if not means_are_known(network):
            self.young, self.numbers = True, Numbers(numbers.each | {YOUNG: SCALAR})
        self.names, self.weight = transmitters_of(network), weight_of(network.states)
        self._measured = compiled(self._measure)
        self._slopes = compiled(self._differentiate)
        self._last: tuple[bytes, Measured, Settled, Slopes] | None = None

    def network(self, x: Vector) -> Network:
        """The network at these numbers."""
        named = self.numbers.named(x).items()
        values = {name: float(v) if np.ndim(v) == 0 else v for name, v in named if name != YOUNG}
        with jax.enable_x64(True):
            return instance("network of free numbers", self.build(**values), Network, "a Network")

    def _measure(self, x: Array) -> Measured:
        values = self.numbers.named(jnp.asarray(x))
        young = values.pop(YOUNG) if self.young else jnp.zeros(())
        return measured(self.build(**values), young)

    def _differentiate(self, x: Array, fixed: Settled) -> Slopes:
        error = jax.grad(lambda free: touched(self._measure(free), fixed))(jnp.asarray(x))
        return Slopes(error, jax.jacrev(lambda free: self._measure(free).powers)(jnp.asarray(x)))

    def at(self, x: Vector) -> tuple[Measured, Settled, Slopes]:
        """Everything at a point."""
        if self._last is None or self._last[0] != x.tobytes():
            known = Measured(*(np.asarray(part) for part in self._measured(np.asarray(x))))
            fixed = settled(known, self.weight)
            slopes = Slopes(*(np.asarray(part) for part in self._slopes(np.asarray(x), fixed)))
            self._last = x.tobytes(), known, fixed, slopes
        return self._last[1:]

    def covariance(self, x: Vector) -> Float[np.ndarray, "n n"]:
        """The error's covariance."""
        return np.asarray(self.at(x)[1].parts.sum(axis=0))

    def error(self, x: Vector) -> float:
        """<W, P>."""
        return float(np.sum(self.weight * self.covariance(x)))

    def powers(self, x: Vector) -> Float[np.ndarray, "hops"]:
        """What each transmitter sends."""
        return np.asarray(self.at(x)[0].powers)


class Ended(NamedTuple):
    """Where a descent ended, what it made small, and how far Lagrange's conditions are from holding, relatively."""

    x: Vector
    value: float
    residual: float


def descend_numbers(
    problem: Problem, start: Vector, rows: Float[np.ndarray, "limits hops"], most: Vector, wanted: float | None
) -> Ended:
    """The least error with rows @ powers <= most, or the least total power with an error no larger than wanted."""
    low, high = problem.numbers.ends
    unit = np.maximum(np.where(np.isfinite(high - low), high - low, np.abs(start)), 1e-12)
    scale = problem.error(start) if wanted is None else max(float(problem.powers(start).sum()), 1e-12)

    def value(z: np.ndarray) -> tuple[float, np.ndarray]:
        m, _, slopes = problem.at(z * unit)
        if wanted is None:
            return problem.error(z * unit) / scale, slopes.error * unit / scale
        return float(m.powers.sum()) / scale, slopes.powers.sum(axis=0) * unit / scale

    def room(z: np.ndarray) -> np.ndarray:
        left = 1 - rows @ problem.powers(z * unit) / most
        return left if wanted is None else np.append(left, 1 - problem.error(z * unit) / wanted)

    def slope(z: np.ndarray) -> np.ndarray:
        slopes = problem.at(z * unit)[2]
        own = -(rows @ slopes.powers) / most[:, None] * unit
        return own if wanted is None else np.vstack([own, -slopes.error * unit / wanted])

    constraints = [NonlinearConstraint(room, 0.0, np.inf, slope)] if len(rows) or wanted is not None else []
    result = minimize(value, start / unit, jac=True, method="SLSQP", bounds=Bounds(low / unit, high / unit),
                      constraints=constraints, options={"ftol": FINE, "maxiter": ITERATIONS})  # fmt: skip
    z = np.clip(result.x, low / unit, high / unit)
    if np.any(room(z) < -AT):
        return Ended(z * unit, np.inf, np.inf)
    now, gradient = value(z)
    sides, x = np.eye(len(z)), z * unit
    normals = [*slope(z)[room(z) < AT], *sides[x <= low + AT * unit], *-sides[x >= high - AT * unit]]
    left = nnls(np.array(normals).T, gradient)[1] if normals else float(np.linalg.norm(gradient))
    return Ended(z * unit, now * scale, left / max(float(np.linalg.norm(gradient)), 1e-12))
