"""Polynomial filters before any data: the system behind the filter with memory, and gains over the linear filter."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from heliograph.linear.lifted_map import make_linear_rows, mean_and_covariance, split_homogeneous
from heliograph.linear.lmmse_recursion import lmmse
from heliograph.linear.monomial_lifted_system import initial_monomial_moments, lifted_system, refuse_lift
from heliograph.linear.plant_and_measurement_maps import check_model, make_plant_and_measurement_maps
from heliograph.linear.system import Gains, LinearSystem, Schedule, Steps, state_moments
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.moments.monomials import list_exponents, symmetric_power
from heliograph.random_affine.moments.pushed_moments import (
    TabulatedNoise,
    products_of_monomials,
    push_moments,
    push_through_known_map,
)
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent
from heliograph.random_affine.series_and_stack import Series, Stack


def quadratic_system_with_linear_estimate(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, linear: Schedule
) -> LinearSystem:
    """Return the linear system of all products up to degree 2 of (x, q, z), q the estimate of a linear filter.

    The best linear filter of this system is the best filter of x that is quadratic in each z and may multiply it by q:
    a quadratic filter with memory of earlier data. `lmmse` gives its gains and its error, before any data. The
    measurement is z, z z' and z q' of the present step: components of its state, so without noise of their own.

    Method: let Y hold all products up to degree 2 of (x, q, z) and the constant 1. A step is a random affine map of
    (x, q, z), so E[Y+ | Y] = M Y, with M from moments of the map up to order 2, and the noise Y+ - M Y is white with
    Cov(w) = E[Y+ Y+'] - M E[Y Y'] M', from moments up to order 4.

    Args:
        plant: linear plant without inputs.
        sensor: linear sensor.
        channel: its channel.
        linear: schedule whose state is an estimate of all of x, as `lmmse` makes one from a system of degree 1.

    Raises:
        ValueError: a schedule of another shape, or what `lifted_system` refuses.
    """
    check_model(plant, sensor, channel)
    plant_0, horizon = first(plant), linear.horizon
    n, m = len(plant_0.states), int(first(channel).outputs)
    if linear.gains.gain.shape[1:] != (n, m):
        raise fail("linear schedule", f"gains of shape {(n, m)}", f"shape {linear.gains.gain.shape[1:]}")
    total = 2 * n + m  # numbers in (x, q, z)
    refuse_lift(2, total, m + n, horizon)
    # At the start (x_0, q_0, 0), with a known q_0, is an affine function of x_0. `moments` are up to order 4, and
    # `second` is E[Y Y'] of the products Y up to degree 2.
    start_map = _affine_matrix(np.eye(total, n), np.concatenate([np.zeros(n), linear.start, np.zeros(m)]))
    moments = push_through_known_map(start_map, 4, initial_monomial_moments(plant_0, 4))
    second = products_of_monomials(moments, total + 1, 2)
    mean, initial = mean_and_covariance(second)
    received = _make_received_products(n, m)  # selects z, z z' and z q' from Y
    cache = _MomentCache()
    steps, rounding = list[Steps](), list[np.ndarray]()
    for k, route in enumerate(make_plant_and_measurement_maps(plant, sensor, channel, 4, horizon)):
        # One step is three maps: (x, q, z) -> (x+, q) by the plant, -> (x+, q, z+) by the measurement, and
        # -> (x+, q+, z+) by the linear filter.
        move = cache.make_move_map(route.plant, m)
        measure_squares, measure_fourth = cache.make_measurement_moments(route.measurement, n)
        update = _make_filter_map(Gains(*(field[k] for field in linear.gains)))
        # E[Y+ | Y] = M Y. M is the product of the maps' mean matrices on products up to degree 2.
        transition = symmetric_power(update, 2) @ measure_squares @ move.moments(2).matrix
        moments = push_through_known_map(update, 4, measure_fourth @ push_moments(move, 4, moments))
        next_second = products_of_monomials(moments, total + 1, 2)
        # Cov(w) = E[Y+ Y+'] - M E[Y Y'] M'.
        process = next_second - transition @ second @ transition.T
        matrix, drift = split_homogeneous(transition)
        no_offset, no_noise = np.zeros(len(received)), np.zeros((len(received), len(received)))
        steps.append(Steps(matrix, drift, process[:-1, :-1], received, no_offset, no_noise))
        rounding.append(np.finfo(float).eps * np.diag(next_second)[:-1])
        second = next_second
    over_time = Steps(*map(np.array, zip(*steps, strict=True)))
    system = LinearSystem(over_time, mean, initial, projection=make_linear_rows(total, 2, n), rounding=rounding)
    return with_assumed(system, AssumedModel(plant, sensor, channel, order=4))


def _affine_matrix(matrix: Float[np.ndarray, "m n"], offset: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m+1 n+1"]:
    """Return the homogeneous matrix [[A, a], [0, 1]] of x -> A x + a, which maps (x, 1) to (A x + a, 1)."""
    return np.block([[matrix, offset[:, None]], [np.zeros((1, matrix.shape[1])), np.ones((1, 1))]])


def _make_filter_map(g: Gains) -> np.ndarray:
    """Return the homogeneous matrix of (x+, q, z+) -> (x+, F q + K z+ + c, z+), one step of the linear filter.

    q (n,) is the filter's estimate, and z+ (m,) the measurement. `g` has F (transition), K (gain) and c (offset).
    """
    n, m = g.gain.shape
    of_q, of_z = slice(n, 2 * n), slice(2 * n, None)
    matrix = np.eye(2 * n + m)
    matrix[of_q, of_q], matrix[of_q, of_z] = g.transition, g.gain
    offset = np.concatenate([np.zeros(n), g.offset, np.zeros(m)])
    return _affine_matrix(matrix, offset)


class _MomentCache:
    """Moments of plant and link for the system of products of (x, q, z), computed again only where the model changes.

    x is the state, q the estimate of a linear filter (n numbers each), and z the measurement (m numbers).
    """

    def __init__(self) -> None:
        """Begin with an empty cache: no table of a plant's noise, and no moments of a measurement."""
        self.last_plant_noise: AbstractNoise | None = None
        self.joint_noise: AbstractNoise | None = None
        self.last_measurement: AbstractRandomAffine | None = None
        self.measurement_moments: tuple[np.ndarray, np.ndarray] = np.zeros((0, 0)), np.zeros((0, 0))

    def make_move_map(self, plant: GainAndNoise, m: int) -> GainAndNoise:
        """Return the map (x, q, z) -> (x+, q) of a plant's step x+ = A x + w: the last z, of m numbers, is dropped.

        q, the estimate of the linear filter, does not change in this part of the step. The noise is (w, 0). Its table
        of moments is stored, and used again as long as the plant's noise is the same object.
        """
        n = plant.inputs
        if self.joint_noise is None or plant.noise is not self.last_plant_noise:
            no_noise = Gaussian(np.zeros((n, n)))
            self.last_plant_noise = plant.noise
            self.joint_noise = TabulatedNoise(Independent([plant.noise, no_noise]), order=4)
        # [[A, 0, 0], [0, I, 0]] of (x, q, z).
        matrix = np.zeros((2 * n, 2 * n + m))
        matrix[:n, :n] = plant.matrix
        matrix[n:, n : 2 * n] = np.eye(n)
        return GainAndNoise(Constant(1.0), matrix, self.joint_noise)

    def make_measurement_moments(self, measurement: AbstractRandomAffine, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the matrices that map the moments of (x+, q) of order 2 and 4 to those of (x+, q, z+).

        `measurement` is the random map from x+ (n numbers) to z+, and q (n numbers) the estimate of the linear filter.
        The matrices of the last measurement are stored, and used again if it is the same object.
        """
        if measurement is not self.last_measurement:
            take_x = known(np.eye(n, 2 * n))  # (x+, q) -> x+
            append_z = Stack([known(np.eye(2 * n)), Series([take_x, measurement])])  # (x+, q) -> (x+, q, z+)
            second, fourth = append_z.moments(2), append_z.moments(4)
            self.last_measurement = measurement
            self.measurement_moments = np.asarray(second.matrix), np.asarray(fourth.matrix)
        return self.measurement_moments


def _make_received_products(n: int, m: int) -> np.ndarray:
    """Return rows, each with one 1, that select z, z z' and z q' among all monomials up to degree 2 of (x, q, z).

    x is the state and q its linear estimate, of n numbers each, and z the measurement, of m numbers. A monomial is
    identified by its exponents of (x, q, z, 1), whose sum is 2.
    """
    total = 2 * n + m
    index_of_monomial = {powers: i for i, powers in enumerate(list_exponents(total + 1, 2))}
    # z and z z': exponents of (z, 1) behind zeros for x and q; the last one, of the constant alone, is left out.
    no_x_and_q = (0,) * (2 * n)
    selected = [(*no_x_and_q, *powers) for powers in list_exponents(m + 1, 2)[:-1]]
    # z_i q_j: exponent 1 of q_j, variable n + j, and of z_i, variable 2 n + i.
    for i in range(m):
        for j in range(n):
            factors = n + j, 2 * n + i
            selected.append(tuple(int(variable in factors) for variable in range(total + 1)))
    rows = np.zeros((len(selected), len(index_of_monomial) - 1))
    for row, powers in zip(rows, selected, strict=True):
        row[index_of_monomial[powers]] = 1.0
    return rows


SYMMETRIC = 1e-10  # standardised third moment below which it is rounding


@readable
@dataclass(frozen=True)
class GainOverLinear:
    """Error covariances of filters by degree, exact before any data, and the skewness that higher degrees exploit.

    Args:
        states: names of the states.
        covariance: error covariance over time (time, n, n) by degree.
        skewness: the largest standardised joint third central moment of (x_k, z_k) over all steps.
        after: first step that counts in `gain`, which leaves out the start.
    """

    states: tuple[str, ...]
    covariance: dict[int, Float[np.ndarray, "time n n"]]
    skewness: float
    after: int

    def gain(self, degree: int) -> Float[np.ndarray, "n"]:
        """Return the share of the linear filter's error variance that this degree removes, for each state."""

        def average_variances(d: int) -> np.ndarray:
            """Return the error variance of each state by the filter of degree d, averaged over the steps that count."""
            variances = np.diagonal(self.covariance[d][self.after :], axis1=1, axis2=2)
            return np.asarray(variances.mean(axis=0))

        return np.asarray(1 - average_variances(degree) / average_variances(1))

    @property
    def symmetric(self) -> bool:
        """True if all third moments vanish; then the quadratic filter is the linear one (a cubic one may still gain).

        Third moments of (x_k, z_k) at one time are enough: x_j given x_i is affine in x_i plus independent noise, so
        the third moments across times are made of them, and centred squares are uncorrelated with all x_k and z_k.
        """
        return self.skewness <= SYMMETRIC


def gain_over_linear(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    horizon: int = 100,
    degrees: Sequence[int] = (2, 3),
    after: int | None = None,
) -> GainOverLinear:
    """Return the error covariances of the best filters of several degrees, to compare with the linear one's.

    A filter of degree d is the best one that is a polynomial of this degree in each measurement. It is linear in the
    monomials of the measurement and of the state, so its covariance follows from the model: no data are simulated.

    Args:
        plant: linear plant without inputs.
        sensor: linear sensor.
        channel: from the sensor to the filter.
        horizon: number of steps, 100 unless given.
        degrees: degrees to compare with 1, each at least 2; (2, 3) unless given.
        after: first step whose error counts in the comparison, a third of the horizon unless given.

    Returns:
        Error covariances (time, n, n) by degree, and the skewness that higher degrees exploit.

    Raises:
        ValueError: what `lifted_system` refuses, no degree above 1, `after` outside the horizon.
    """
    check_count("horizon", horizon)
    if not degrees or min(degrees) < 2:
        raise fail("degrees", "at least one, all of 2 or more", list(degrees))
    first_step = horizon // 3 if after is None else after
    if not 0 <= first_step < horizon:
        raise fail("first step that counts", f"one from 0 to {horizon - 1}", first_step)
    # Lifted systems: the monomials of x as states, those of z as measurements. Degree 1 to compare with, 2 for the
    # skewness, the largest standardised third moment of (x, z).
    systems = {d: lifted_system(plant, sensor, channel, d, horizon) for d in sorted({1, 2, *degrees})}
    n, m = len(first(plant).states), int(first(channel).outputs)
    covariances = {d: lmmse(system).gains.covariance for d, system in systems.items()}
    return GainOverLinear(
        states=first(plant).states, covariance=covariances, skewness=skewness(systems[2], n, m), after=first_step
    )


def skewness(square: LinearSystem, states: int, outputs: int) -> float:
    """Return the largest |E (a - Ea)(b - Eb)(c - Ec)| / (sd a sd b sd c) over all steps k.

    Filters of higher degree exploit it: it is 0 for Gaussian x and z. a and b are two components of x_k, or two of z_k,
    and c is any component of either; the third moment follows from the covariance of the product a b with c.

    Args:
        square: the system of degree 2, whose state and measurement are the products of x_k and of z_k up to degree 2.
        states: number of components of x.
        outputs: number of components of z.
    """
    # The index of each product, by the numbers of its factors: (i,) of x_i, (i, j) of x_i x_j.
    x_indices, z_indices = _index_products(states), _index_products(outputs)
    state = state_moments(square)
    largest = 0.0
    for k in range(square.horizon):
        step, covariance = square.step(k), state.covariance[k + 1]
        cross = step.output @ covariance  # Cov(products of z, products of x)
        # Joint covariance and mean of (products of x, products of z), and the indices of x and z themselves in it.
        joint = np.block([[covariance, cross.T], [cross, cross @ step.output.T + step.noise]])
        mean = np.concatenate([state.mean[k + 1], step.output @ state.mean[k + 1] + step.offset])
        first_z = len(covariance)
        linear = [x_indices[(i,)] for i in range(states)] + [first_z + z_indices[(i,)] for i in range(outputs)]
        for indices, start in ((x_indices, 0), (z_indices, first_z)):
            # Indices of the product a b, of a and of b.
            pairs = [
                (start + product, start + indices[(factors[0],)], start + indices[(factors[1],)])
                for factors, product in indices.items()
                if len(factors) == 2
            ]
            largest = max([largest, *(_largest_third_moment(joint, mean, pair, linear) for pair in pairs)])
    return largest


def _largest_third_moment(
    joint: Float[np.ndarray, "N N"], mean: Float[np.ndarray, "N"], pair: tuple[int, int, int], linear: list[int]
) -> float:
    """Return the largest |k3(a, b, c)| / (sd a sd b sd c) over c, of numbers with this joint covariance and mean.

    k3(a, b, c) = Cov(a b, c) - E a Cov(b, c) - E b Cov(a, c), the third central moment; sd is a standard deviation.
    `pair` holds the indices of the product a b, of a and of b among the N numbers, and `linear` those of all c.
    """
    product, a, b = pair
    deviations = np.sqrt(np.diag(joint))
    k3 = joint[product, linear] - mean[a] * joint[b, linear] - mean[b] * joint[a, linear]
    product_of_deviations = deviations[a] * deviations[b] * deviations[linear]
    ratios = np.divide(np.abs(k3), product_of_deviations, out=np.zeros_like(k3), where=product_of_deviations > 0)
    return float(np.max(ratios))


def _index_products(variables: int) -> dict[tuple[int, ...], int]:
    """Return the positions of y_i, by (i,), and of y_i y_j, by (i, j), i <= j, among the monomials up to degree 2.

    y has so many `variables`. The monomials are those of degree 2 in (y, 1): y_i is y_i times 1.
    """
    index = {powers: i for i, powers in enumerate(list_exponents(variables + 1, 2))}
    unit = np.eye(variables + 1, dtype=int)
    indices: dict[tuple[int, ...], int] = {
        (i,): index[tuple(int(v) for v in unit[i] + unit[-1])] for i in range(variables)
    }
    for i, j in combinations_with_replacement(range(variables), 2):
        indices[(i, j)] = index[tuple(int(v) for v in unit[i] + unit[j])]
    return indices
