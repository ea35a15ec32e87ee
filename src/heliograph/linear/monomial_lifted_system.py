"""A linear model lifted to monomials: powers of the state and of the measurement, and modes, as one linear system."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from heliograph.linear.lifted_map import EPS, LiftedMap, make_linear_rows, mean_and_covariance, split_homogeneous
from heliograph.linear.plant_and_measurement_maps import (
    PlantAndMeasurementMaps,
    check_model,
    make_plant_and_measurement_maps,
)
from heliograph.linear.system import LinearSystem, Steps, repeat_last_step
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, check_horizon, fail
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.monomials import (
    MEMORY_LIMIT_ENTRIES,
    count_monomials,
    list_exponents,
    position,
)
from heliograph.random_affine.moments.pushed_moments import products_of_monomials, push_moments, push_through_known_map
from heliograph.random_affine.noises.noise import Gaussian, noise_moment_vector

Moments = Float[np.ndarray, " monomials"]  # of (x, 1), all of one order


def check_finite_moments(moments: Moments, k: int, order: int) -> None:
    """Raise ValueError where moments of the state after step k, up to degree `order`, are no finite numbers."""
    if not np.all(np.isfinite(moments)):
        got = f"ones beyond doubles at step {k + 1}: use a shorter horizon, or units in which the state is smaller"
        raise fail(f"moments of the state up to order {order}", "finite ones at every step", got)


class SteadyMomentTest:
    """Test for steady moments of x up to `order` under x+ = A x + noise with one law for all time, to rounding.

    Changes from step to step shrink by the spectral radius r of A, so all later changes sum up to at most the present
    one over 1 - r. Moments are steady once this is below EPS of their own size: a change of at most EPS (1 - r) size.
    The size of a moment is the product of E[x_i^2]^(1/2) over its factors x_i.
    """

    def __init__(self, matrix: Float[np.ndarray, "n n"], order: int, varies: bool):
        """Set the tolerance EPS (1 - r) for A = `matrix`; if it `varies` or r >= 1, moments are never steady."""
        decay = 1 - spectral_radius(matrix)
        self._tolerance = -1.0 if varies or decay <= 0 else EPS * decay
        # Moments are E of all products of `order` factors of (x, 1). E[x_i^2] has x_i twice, and the 1 order - 2 times.
        n = len(matrix)
        index_of_moment = position(n + 1, order)
        self._powers = np.array(list_exponents(n + 1, order))[:, :n]  # exponents of x in each moment
        exponents_of_squares = [(*(2 * int(i == j) for j in range(n)), order - 2) for i in range(n)]
        self._squares = [index_of_moment[exponents] for exponents in exponents_of_squares]  # where E[x_i^2] stand
        self._last: Moments | None = None  # the moments of the call before

    def is_steady(self, moments: Moments) -> bool:
        """Return whether the moments equal those of the previous call up to rounding; False at the first call."""
        before, self._last = self._last, moments
        if before is None or self._tolerance < 0:
            return False
        # The size of a moment E[prod_i x_i^power_i] is prod_i (E x_i^2)^(power_i / 2).
        deviations = np.sqrt(np.abs(moments[self._squares]))
        scale = np.prod(deviations**self._powers, axis=1)
        return bool(np.all(np.abs(moments - before) <= self._tolerance * scale))


def lift_modes(
    plants: Sequence[GainAndNoise],
    measurements: Sequence[JointModes],
    degree: int,
    moments: Float[np.ndarray, " monomials"],
    projection: Float[np.ndarray, "n L"],
) -> LinearSystem:
    """Return the system of Y 1{mode} for every mode, Y = (monomials of x up to `degree`, 1), that measures those of z.

    Args:
        plants: map x -> x+ of each step.
        measurements: map x+ -> z of each step, with its modes.
        degree: of the monomials.
        moments: E[monomials of (x_0, 1)] of order 2 `degree`.
        projection: matrix that reads x off Y.

    E[Y+ 1{j}] = sum_i Pi_ij M Y 1{i} and E[Z | Y, modes] = sum_j K_j Y 1{j}, with E[Y+ | Y] = M Y by the plant and
    E[Z | Y] = K_j Y by the measurement in mode j. Noises, with B = E[Y Y'] and x the Kronecker product:
    Cov(w) = sum_i p_i (diag(Pi_i) - Pi_i' Pi_i) x M B M' + diag(p+) x (B+ - M B M'),
    Cov(v) = sum_j p_j (E[Z Z' | j] - K_j B+ K_j').
    """
    n, modes = plants[0].inputs, len(measurements[0].initial)
    # p and Pi of the next step. The modes of the first step have the initial law, and their chain has not moved yet.
    law, chain = np.asarray(measurements[0].initial), np.eye(modes)
    second = products_of_monomials(moments, n + 1, degree)  # B
    mean = np.kron(law, second[:, -1])
    start = np.kron(np.diag(law), second) - np.outer(mean, mean)
    # Matrices of each distinct measurement and plant once.
    distinct = {id(measurement): measurement for measurement in measurements}
    varies = len(distinct) > 1
    lifts_by_id = {i: [LiftedMap(m, degree, varies) for m in measurement.maps] for i, measurement in distinct.items()}
    distinct_plants = {id(plant): plant for plant in plants}
    matrix_by_id = {i: np.asarray(plant.moments(degree).matrix) for i, plant in distinct_plants.items()}  # M
    # If nothing varies and moments and law are steady, all later steps equal the last one, to rounding. Step 0, in
    # which the chain does not move, is no such step.
    steady = SteadyMomentTest(np.asarray(plants[0].matrix), 2 * degree, varies or len(matrix_by_id) > 1)
    steps, roundings, last_law = list[Steps](), list[tuple[np.ndarray, np.ndarray]](), law
    for k, (plant, measurement) in enumerate(zip(plants, measurements, strict=True)):
        if steady.is_steady(moments) and np.array_equal(law, last_law) and k > 1:
            break
        last_law = law
        with np.errstate(over="ignore", invalid="ignore"):  # the caller refuses what overflows
            moments = np.asarray(push_moments(plant, 2 * degree, moments))
        check_finite_moments(moments, k, 2 * degree)
        next_second = products_of_monomials(moments, n + 1, degree)
        matrix, lifts = matrix_by_id[id(plant)], lifts_by_id[id(measurement)]  # M, and the maps y -> z by mode
        process, law = _compute_noise_and_next_law(law, chain, matrix @ second @ matrix.T, next_second)
        noise, rounding_of_noise = _average_noise(law, lifts, moments)
        # K_1, K_2, ... side by side, without their last row, that of the constant 1 among the monomials of z.
        output = np.concatenate([lift.matrix for lift in lifts], axis=1)[:-1]
        no_drift, no_offset = np.zeros(len(mean)), np.zeros(len(output))
        steps.append(Steps(np.kron(chain.T, matrix), no_drift, process, output, no_offset, noise))
        roundings.append((EPS * np.kron(law, np.diag(next_second)), rounding_of_noise))
        second, chain = next_second, np.asarray(measurement.transition)
    over_time = Steps(*(repeat_last_step(values, len(plants)) for values in zip(*steps, strict=True)))
    process_rounding, received_rounding = (repeat_last_step(x, len(plants)) for x in zip(*roundings, strict=True))
    whole = np.tile(projection, (1, modes))  # x is the sum over the modes of x 1{mode}
    return LinearSystem(over_time, mean, start, whole, rounding=process_rounding, received_rounding=received_rounding)


def _compute_noise_and_next_law(
    law: Float[np.ndarray, " modes"],
    chain: Float[np.ndarray, "modes modes"],
    moved: Float[np.ndarray, "L L"],
    second: Float[Array, "L L"],
) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, " modes"]]:
    """Return Cov(w) of a step of the stacked vectors Y 1{mode j} (modes x L numbers), and the modes' law p+ after it.

    Y has the monomials of x, and M is the mean map, E[Y+ | Y] = M Y. The random next mode and the plant's noise add
    Cov(w) = sum_i p_i (diag(Pi_i) - Pi_i' Pi_i) x M B M' + diag(p+) x (B+ - M B M'), x the Kronecker product. `law` is
    p before the step, and `chain` Pi[i, j] = P(next mode j | mode i). `moved` is M B M' with B = E[Y Y'] before the
    step, and `second` is B+ = E[Y+ Y+'].
    """
    # (j, l): sum_i p_i Pi_ij (delta_jl - Pi_il), the mean covariance of the next mode's flags given the mode before.
    minus_chain = np.eye(len(law))[None] - chain[:, None, :]
    flag_covariance = np.einsum("i,ij,ijl->jl", law, chain, minus_chain)
    next_law = _keep_if_unchanged(law, law @ chain)
    return np.kron(flag_covariance, moved) + np.kron(np.diag(next_law), second - moved), next_law


def _average_noise(
    law: Float[np.ndarray, " modes"], lifts: "Sequence[LiftedMap]", moments: Moments
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m"]]:
    """Return the mean noise covariance over the modes, sum_j p_j E[Cov(Z | y, j)], and the rounding of its diagonal.

    `law` holds the modes' probabilities p_j, `lifts` each mode's map to monomials Z of z, `moments` those of y.
    """
    covariances, roundings = zip(*(lift.mean_conditional_covariance(moments) for lift in lifts), strict=True)
    return np.tensordot(law, covariances, axes=1), np.abs(law) @ np.array(roundings)


def _keep_if_unchanged(
    law: Float[np.ndarray, " modes"], after: Float[np.ndarray, " modes"]
) -> Float[np.ndarray, " modes"]:
    """Return the law `after` a step, or the law before it if both agree to rounding (4 EPS, relative).

    So a steady law stays the same numbers, and a test for equality finds it.
    """
    return law if np.allclose(law, after, rtol=4 * EPS, atol=0) else after


HIGHEST = 31  # degree: C(62, 31) is below 2^63


def lifted_system(plant: AnyPlant, sensor: AnySensor, channel: Channel, degree: int, horizon: int) -> LinearSystem:
    """Return the system of Y = monomials of x up to `degree`, measured by Z = monomials of z up to `degree`.

    E[Y+ | Y] = A Y + a and E[Z | Y+] = C Y+ + c are exact: they follow from moments of the plant and of sensor and
    channel. Cov(w) = E[Y+ Y+'] - M E[Y Y'] M' and Cov(v) = E[Z Z'] - K E[Y+ Y+'] K', where Y and Z end with the
    constant 1, M = [A, a; 0, 1] and K = [C, c; 0, 1]. Both noises have mean zero given the state's whole past, so the
    best linear filter of this system is the best filter of x that is a polynomial of this degree in each z_k. Every
    monomial appears once (the half-vectorised square); x is read off as the monomials of degree 1.

    Args:
        plant: linear plant without inputs.
        sensor: linear sensor.
        channel: its channel; behind links with memory the monomials are states for each of their modes
            (`lift_modes`).
        degree: 1 gives the best linear filter, 2 the quadratic one.
        horizon: number of steps.

    Raises:
        ValueError: a plant or sensor that is not linear, a plant with inputs or with noise that depends on them, parts
            that do not fit, a lift of more than the stated memory.
    Source: quadratic filtering with dynamical bias, equations (11) to (13) and Lemmas 3 and 4, as repaired.
    """
    check_model(plant, sensor, channel)
    plant_0 = first(plant)
    n, m = len(plant_0.states), int(first(channel).outputs)
    refuse_lift(degree, n, m, horizon)
    routes = make_plant_and_measurement_maps(plant, sensor, channel, 2 * degree, horizon)
    moments = initial_monomial_moments(plant_0, 2 * degree)
    assumed = AssumedModel(plant, sensor, channel, order=2 * degree)
    if first(channel).remembers:
        return with_assumed(_lift_chain(routes, degree, moments, n, m), assumed)
    # Start of the lifted state: E Y_0 and Cov Y_0.
    second = products_of_monomials(moments, n + 1, degree)
    mean, covariance = mean_and_covariance(second)
    measurement_varies = isinstance(sensor, OverTime) or isinstance(channel, OverTime)
    lifted = _lift_steps(routes, degree, moments, isinstance(plant, OverTime), measurement_varies)
    system = LinearSystem(
        lifted.steps,
        mean=mean,
        covariance=covariance,
        projection=make_linear_rows(n, degree),
        rounding=lifted.process_rounding,
        received_rounding=lifted.received_rounding,
        start_rounding=EPS * np.diag(second)[:-1],
    )
    return with_assumed(system, assumed)


def _lift_chain(
    routes: Sequence[PlantAndMeasurementMaps], degree: int, moments: Float[np.ndarray, "M"], n: int, m: int
) -> LinearSystem:
    """Return the linear system of a channel with memory, whose state is the monomials times the flag of each mode.

    A flag is 1 in its mode of the channel and 0 in all others.

    Args:
        routes: the maps of each step, x -> x+ (plant) and x+ -> z (measurement).
        degree: largest degree of the monomials.
        moments: moments of x_0 up to twice the degree.
        n: number of states.
        m: number of outputs.
    """
    distinct = {id(r.measurement): r.measurement for r in routes}  # steps share one object where nothing varies
    modes_by_id = {i: joint_modes(measurement, order=degree) for i, measurement in distinct.items()}
    refuse_lift(degree, n, m, len(routes), modes=max(len(modes.initial) for modes in modes_by_id.values()))
    # The state vector Y ends with the constant 1, on which x does not depend: its column is 0.
    projection = np.pad(make_linear_rows(n, degree), ((0, 0), (0, 1)))
    modes_by_step = [modes_by_id[id(r.measurement)] for r in routes]
    return lift_modes([r.plant for r in routes], modes_by_step, degree, moments, projection)


class _LiftedSteps(NamedTuple):
    """Steps of a system of monomials, and the rounding errors of its noises' variances over time.

    process_rounding: of Cov(w), (time, monomials of x). received_rounding: of Cov(v), (time, monomials of z).
    """

    steps: Steps
    process_rounding: Float[np.ndarray, "time N"]
    received_rounding: Float[np.ndarray, "time m"]


def _lift_steps(
    routes: Sequence[PlantAndMeasurementMaps],
    degree: int,
    moments: Float[np.ndarray, "M"],
    plant_varies: bool,
    measurement_varies: bool,
) -> _LiftedSteps:
    """Lift each step to monomials; return the steps, and the rounding errors of both noises' variances over time.

    The lifted state has all monomials of x up to the degree: X+ = F X + f + w, Z = H X+ + h + v. The covariances of its
    noises depend on the moments of x before any data, so these are followed too. Once they are steady, all later steps
    equal the last, to rounding.

    Args:
        routes: the maps of each step, x -> x+ and x+ -> z.
        degree: largest degree of the monomials.
        moments: moments of x_0 up to twice the degree (M,).
        plant_varies: whether the plant differs between steps.
        measurement_varies: whether the sensor or the channel does.
    """
    steps, roundings = list[Steps](), list[tuple[np.ndarray, np.ndarray]]()
    steady = SteadyMomentTest(np.asarray(routes[0].plant.matrix), 2 * degree, plant_varies or measurement_varies)
    last: PlantAndMeasurementMaps | None = None
    for k, route in enumerate(routes):
        if steady.is_steady(moments):
            break
        # A map that equals the last step's is lifted once.
        if last is None or not _are_identical(route.plant, last.plant):
            plant_lift = LiftedMap(route.plant, degree, plant_varies)
        if last is None or not _are_identical(route.measurement, last.measurement):
            measurement_lift = LiftedMap(route.measurement, degree, measurement_varies)
        last = route
        # Cov(w) from the moments before the step; then the moments after it, and Cov(v) from those.
        process, rounding_of_process = plant_lift.mean_conditional_covariance(moments)
        moments = plant_lift.push_moments(moments)
        check_finite_moments(moments, k, 2 * degree)
        noise, rounding_of_noise = measurement_lift.mean_conditional_covariance(moments)
        transition, drift = split_homogeneous(plant_lift.matrix)  # F and f of [[F, f], [0, 1]]
        output, offset = split_homogeneous(measurement_lift.matrix)  # H and h
        steps.append(Steps(transition, drift, process, output, offset, noise))
        roundings.append((rounding_of_process, rounding_of_noise))
    over_time = Steps(*(repeat_last_step(values, len(routes)) for values in zip(*steps, strict=True)))
    process_rounding, received_rounding = (repeat_last_step(x, len(routes)) for x in zip(*roundings, strict=True))
    return _LiftedSteps(over_time, process_rounding, received_rounding)


def _are_identical(left: AbstractRandomAffine, right: AbstractRandomAffine) -> bool:
    """Return whether two models, or two of their steps, are one object or have equal numbers."""
    return left is right or bool(eqx.tree_equal(left, right))


def initial_monomial_moments(plant: LinearPlant, order: int) -> Float[np.ndarray, "monomials"]:
    """Return E of all monomials of (x_0, 1) of a given order, products of so many factors, under the law of x_0.

    It is the law that the plant holds, or else a Gaussian one.
    """
    law = plant.deviation if plant.deviation is not None else Gaussian(plant.initial_covariance)
    # x_0 = (initial mean - the law's mean) + a draw of the law, as a homogeneous matrix.
    shift = np.eye(len(plant.states) + 1)
    shift[:-1, -1] = plant.initial_mean - law.mean
    return np.asarray(push_through_known_map(shift, order, noise_moment_vector(law, order)))


def refuse_lift(degree: int, states: int, outputs: int, horizon: int, modes: int = 1) -> None:
    """Raise ValueError for a horizon or degree below 1 or a lifted system of more than MEMORY_LIMIT_ENTRIES numbers."""
    check_horizon(horizon)
    if check_count("degree of the lift", degree) > HIGHEST:
        got = f"{degree}: binomials of twice the degree are no numbers of 64 bits"
        raise fail("degree of the lift", f"at most {HIGHEST}", got)
    n, m = count_monomials(states + 1, degree), count_monomials(outputs + 1, degree)  # the constant 1 among them
    # At each step A and Cov(w), of n modes rows and columns; C; and Cov(v).
    entries = horizon * (2 * (n * modes) ** 2 + n * modes * m + m * m)
    of_modes = f" in {modes} modes" if modes > 1 else ""
    if entries > MEMORY_LIMIT_ENTRIES:
        got = (
            f"{entries:,} ({n - 1} monomials of {states} states{of_modes} and {m - 1} of {outputs} outputs, "
            f"{horizon} steps); use a lower degree, a shorter horizon, or fewer states or outputs"
        )
        raise fail(f"lift of degree {degree}", f"at most {MEMORY_LIMIT_ENTRIES:,} entries", got)
