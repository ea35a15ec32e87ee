"""The system behind the quadratic filter with memory: state, linear estimate and measurement in one, squared."""

import numpy as np

from heliograph.linear.lift import (
    affine,
    check_model,
    initial_moments,
    linear_rows,
    mean_and_spread,
    model_routes,
    refuse_lift,
)
from heliograph.linear.schedule import Gains, Schedule
from heliograph.linear.system import LinearSystem, Steps
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.random_affine.atoms import GainAndNoise, known
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.law import Constant
from heliograph.random_affine.moments.monomials import exponents, symmetric_power
from heliograph.random_affine.moments.push import Tabulated, push, push_known, second_moments
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent


def memory_system(plant: AnyPlant, sensor: AnySensor, channel: Channel, linear: Schedule) -> LinearSystem:
    """Return the square of (x, q, z), with q the estimate of a linear filter: q+ = F q + K z+ + c.

    Measured are z, z z' and z q' of the present step: components of the lifted state, so without noise of their own.
    `linear` is a schedule whose state is an estimate of all of x, as `lmmse` makes one from a system of degree 1.

    Raises:
        ValueError: what `lifted_system` refuses, or a schedule whose state is not an estimate of x.
    """
    check_model(plant, sensor, channel)
    start, horizon = first(plant), linear.horizon
    n, m = len(start.states), int(first(channel).outputs)
    if linear.gains.gain.shape[1:] != (n, m):
        raise fail("linear schedule", f"gains of shape {(n, m)}", f"shape {linear.gains.gain.shape[1:]}")
    total = 2 * n + m
    refuse_lift(2, total, m + n, horizon)
    # (x_0, q_0, 0) is an affine function of x_0.
    beginning = _homogeneous(np.eye(total, n), np.concatenate([np.zeros(n), linear.start, np.zeros(m)]))
    moments = push_known(beginning, 4, initial_moments(start, 4))
    before = second_moments(moments, total + 1, 2)
    mean, spread = mean_and_spread(before)
    received, parts, rounding, stored = _received_products(n, m), [], [], _Recorded()
    for k, route in enumerate(model_routes(plant, sensor, channel, 4, horizon)):
        move, listen = stored.move(route.plant, m), _listen(Gains(*(field[k] for field in linear.gains)))
        wide = stored.widen(route.measurement, n)
        # E[(x, q, z)+^2 | (x, q, z)^2] = Sym^2(filter) E Sym^2(channel) E Sym^2(plant).
        transition = symmetric_power(listen, 2) @ wide[0] @ move.moments(2).matrix
        moments = push_known(listen, 4, wide[1] @ push(move, 4, moments))
        after = second_moments(moments, total + 1, 2)
        # Cov(w) = E[Y+ Y+'] - M E[Y Y'] M'.
        process = after - transition @ before @ transition.T
        nothing = np.zeros(len(received)), np.zeros((len(received), len(received)))
        parts.append((*affine(transition), process[:-1, :-1], received, *nothing))
        rounding.append(np.finfo(float).eps * np.diag(after)[:-1])
        before = after
    steps = Steps(*map(np.array, zip(*parts, strict=True)))
    return LinearSystem(steps, mean, spread, linear_rows(total, 2, n), rounding)


def _homogeneous(matrix: Float[np.ndarray, "m n"], offset: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m+1 n+1"]:
    return np.block([[matrix, offset[:, None]], [np.zeros((1, matrix.shape[1])), np.ones((1, 1))]])


def _listen(g: Gains) -> np.ndarray:
    """(x+, q, z+) -> (x+, F q + K z+ + c, z+), homogeneous."""
    n, m = g.gain.shape
    after = np.eye(2 * n + m)
    after[n : 2 * n, n : 2 * n], after[n : 2 * n, 2 * n :] = g.transition, g.gain
    return _homogeneous(after, np.concatenate([np.zeros(n), g.offset, np.zeros(m)]))


class _Recorded:
    """Cache of the noise's moments and those of the route to z, recomputed only where the model changes."""

    def __init__(self) -> None:
        self.noise: AbstractNoise | None = None
        self.joint: AbstractNoise | None = None
        self.route: AbstractRandomAffine | None = None
        self.wide: tuple[np.ndarray, np.ndarray] = np.zeros((0, 0)), np.zeros((0, 0))

    def move(self, plant: GainAndNoise, m: int) -> GainAndNoise:
        """(x, q, z) -> (x+, q)."""
        n = plant.inputs
        if self.joint is None or plant.noise is not self.noise:
            still = Gaussian(np.zeros((n, n)))
            self.noise, self.joint = plant.noise, Tabulated(Independent([plant.noise, still]), 4)
        matrix = np.zeros((2 * n, 2 * n + m))
        matrix[:n, :n], matrix[n:, n : 2 * n] = plant.matrix, np.eye(n)
        return GainAndNoise(Constant(1.0), matrix, self.joint)

    def widen(self, route: AbstractRandomAffine, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Moments of order 2 and 4 of (x+, q) -> (x+, q, z+)."""
        if route is not self.route:
            wide = Stack([known(np.eye(2 * n)), Series([known(np.eye(n, 2 * n)), route])])
            self.route, self.wide = route, (np.asarray(wide.moments(2).matrix), np.asarray(wide.moments(4).matrix))
        return self.wide


def _received_products(n: int, m: int) -> np.ndarray:
    """Rows that read (monomials of z up to degree 2, z_i q_j) off the square of (x, q, z)."""
    total = 2 * n + m
    places = {powers: i for i, powers in enumerate(exponents(total + 1, 2))}
    expected = [(*(0,) * (2 * n), *powers) for powers in exponents(m + 1, 2)[:-1]]
    for i in range(m):
        for j in range(n):
            expected.append(tuple(int(v in (n + j, 2 * n + i)) for v in range(total + 1)))
    rows = np.zeros((len(expected), len(places) - 1))
    for row, powers in zip(rows, expected, strict=True):
        row[places[powers]] = 1.0
    return rows
