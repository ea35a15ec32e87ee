"""Filters in other units: every state, output, measurement and input multiplied by a factor of its own."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.gaussian_prediction import OpenLoop
from heliograph.filters.gaussian.sequential_nodes import SequentialFilter
from heliograph.filters.linear.linear import LinearFilter
from heliograph.filters.linear.polynomial import PolynomialFilter
from heliograph.filters.linear.scheduled_gains import LinearSystemFilter
from heliograph.filters.linear.unconditional_mean import UnconditionalMean
from heliograph.filters.modes.additive_links import AdditiveModalFilter
from heliograph.filters.modes.arrival_patterns import ChannelByPattern
from heliograph.filters.modes.channel_by_mode import ChannelByMode
from heliograph.filters.modes.finite_support_filter import AtomCombinations, MixtureFilter
from heliograph.filters.modes.jump_linear_filter import ModalFilter
from heliograph.filters.modes.multiple_model import MultipleModelFilter
from heliograph.filters.modes.side_information import SideInformationFilter
from heliograph.filters.modes.uncertain_chain import UncertainModalFilter
from heliograph.filters.wrappers.fed_back import PredictionFilter
from heliograph.linear.system import LinearSystem, Steps
from heliograph.model.over_time import OverTime, at_each_step, first, stack_over_time
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant, MatrixOfInputs, Plant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor, Sensor
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.moments.monomials import list_exponents
from heliograph.random_affine.moments.second_moment_map import QuadraticMap
from heliograph.random_affine.moments.second_moments import SecondOrder, describe_second_moments
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian
from heliograph.random_affine.noises.shaped_noise import Shaped

Modes = TypeVar("Modes", ChannelByPattern, ChannelByMode)  # a channel at one step, mode by mode

# Filters that hold the plant and the sensor at the ends of a channel.
WithEnds = (
    LinearFilter
    | ModalFilter
    | UncertainModalFilter
    | AdditiveModalFilter
    | SideInformationFilter
    | MultipleModelFilter
)
Ended = TypeVar("Ended", bound=WithEnds)


class FunctionInUnits(Module):
    """A function f of vectors in old units as the function r f(x_1 / a_1, ...) of vectors in new units.

    A number in new units is a factor times that in old ones. result_factors: r, the factors of the result's entries.
    argument_factors: a_1, ..., those of each argument's entries. Functions in all units share one compiled program.
    """

    function: Callable[..., ArrayLike]
    result_factors: np.ndarray
    argument_factors: tuple[np.ndarray, ...]

    def __call__(self, *vectors: jax.Array) -> jax.Array:
        """Return r f(x_1 / a_1, ...): the value in new units of the function f, of vectors x_1, ... in new units.

        A number in new units is its factor times the number in old units: a_1, ... (`argument_factors`) for the entries
        of each vector, r (`result_factors`) for those of the value. f (`self.function`) takes and returns old units.
        """
        in_old_units = (x / factors for x, factors in zip(vectors, self.argument_factors, strict=True))
        return jnp.asarray(self.result_factors) * jnp.asarray(self.function(*in_old_units))


class Units(NamedTuple):
    """Factors of the states, of a sensor's outputs, of the measurement and of the inputs.

    In formulas they are the diagonal matrices S (n,), R (p,), Q (m,) and U (u,).
    """

    states: Float[np.ndarray, " n"]
    outputs: Float[np.ndarray, " p"]
    received: Float[np.ndarray, " m"]
    inputs: Float[np.ndarray, " u"]


def rescale_filter(filter: AbstractFilter, units: Units) -> AbstractFilter:
    """Return the filter of the same model in other units: it estimates S xhat from Q z and U u.

    `filter` estimates xhat from measurements z and inputs u; S, Q and U are the diagonal matrices of the factors of
    states, measurements and inputs in `units`. A test compares both filters: only rounding may make them differ. Each
    kind of filter stores its model in fields of its own, so each case rescales these.

    Raises:
        ValueError: a filter of an unknown kind.
    """
    match filter:
        case GaussianFilter() | OpenLoop():
            return _rescale_gaussian(filter, units)
        case LinearFilter():
            return replace(_rescale_plant_and_sensor(filter, units), channel=_rescale_moments(filter.channel, units))
        case MixtureFilter():
            components = _rescale_combinations(filter.components, units)
            return replace(filter, plant=rescale_plant(filter.plant, units), components=components)
        case PolynomialFilter(inner=LinearSystemFilter()):
            assert isinstance(filter.inner, LinearSystemFilter)
            # A filter of products x x' ...: its monomials are scaled by products of the factors.
            inner = _rescale_system(filter.inner, filter.degree, units)
            return PolynomialFilter(inner, filter.degree, filter.endless, _rescale_centre(filter.centre, units))
        case ModalFilter() | UncertainModalFilter():
            return replace(_rescale_plant_and_sensor(filter, units), channel=_rescale_by_mode(filter.channel, units))
        case AdditiveModalFilter():
            return replace(
                _rescale_plant_and_sensor(filter, units), terms=tuple(_rescale_by_mode(t, units) for t in filter.terms)
            )
        case SideInformationFilter(flagged=False) | MultipleModelFilter():
            return replace(_rescale_plant_and_sensor(filter, units), channel=_rescale_by_mode(filter.channel, units))
        case PredictionFilter():
            return PredictionFilter(_require_gaussian(rescale_filter(filter.base, units)))
        case SequentialFilter():
            return replace(filter, filters=tuple(_require_gaussian(f) for f in _rescale_parts(filter, units)))
        case _:
            raise fail("filter to rescale", "one of the package's that computes covariances", type(filter).__name__)


def _rescale_plant_and_sensor(filter: Ended, units: Units) -> Ended:
    """Return the filter with its plant and its sensor in other units, what is between them as it was."""
    return replace(filter, plant=rescale_plant(filter.plant, units), sensor=rescale_sensor(filter.sensor, units))


def _rescale_gaussian(filter: GaussianFilter | OpenLoop, units: Units) -> GaussianFilter | OpenLoop:
    """Return a Gaussian filter, or a prediction alone, of S x: initial mean S m, covariance S P S."""
    s = units.states
    started = replace(
        filter,
        plant=rescale_plant(filter.plant, units),
        initial_mean=s * filter.initial_mean,
        initial_covariance=np.outer(s, s) * filter.initial_covariance,
    )
    if isinstance(started, OpenLoop):
        return started
    return replace(
        started,
        sensor=rescale_sensor(started.sensor, units),
        channel=_rescale_moments(started.channel, units),
    )


def _require_gaussian(filter: AbstractFilter) -> GaussianFilter:
    """Return the filter, with its type checked: a part of a sequential filter or of a predictor is Gaussian."""
    assert isinstance(filter, GaussianFilter)
    return filter


def _rescale_parts(filter: SequentialFilter, units: Units) -> list[AbstractFilter]:
    """Return the filters of a sequential filter's parts in other units.

    In `units`, the factors of the parts' outputs follow one another, and so do those of their measurements.
    """
    rescaled, output_begin, received_begin = [], 0, 0
    for single in filter.filters:
        output_end = output_begin + len(first(single.sensor).outputs)
        received_end = received_begin + single.received
        outputs, received = units.outputs[output_begin:output_end], units.received[received_begin:received_end]
        rescaled.append(rescale_filter(single, units._replace(outputs=outputs, received=received)))
        output_begin, received_begin = output_end, received_end
    return rescaled


def _rescale_noise(law: AbstractNoise, factors: Float[np.ndarray, " n"]) -> AbstractNoise:
    """Return the law of the noise in other units, S w with S = diag(factors): mean S m, covariance S Q S."""
    if isinstance(law, Gaussian):
        return Gaussian(np.outer(factors, factors) * law.covariance, factors * law.mean)
    return Shaped(np.diag(factors), law)


def rescale_plant(plant: AnyPlant, units: Units) -> AnyPlant:
    """Return the plant, or the plant at each step, in other units: with states S x and inputs U u.

    S and U are the diagonal matrices of the factors of states and inputs in `units`.
    """
    rescaled: AnyPlant = at_each_step(lambda step: _rescale_plant(step, units), plant)
    return rescaled


def _rescale_plant(plant: AbstractPlant, units: Units) -> AbstractPlant:
    """Return the plant whose states and inputs are counted in other units: S f(S^-1 x, U^-1 u) with noise S w.

    f is the transition and w the noise, of covariance S W S; S and U are diagonal, of the factors of states and inputs.
    """
    s, u = units.states, units.inputs
    center, law = _rescale_initial_law(plant, s)
    noise: AbstractNoise | FunctionInUnits
    if isinstance(plant.noise, AbstractNoise):
        noise = _rescale_noise(plant.noise, s)
    else:
        noise = FunctionInUnits(plant.noise, np.outer(s, s), (u,))
    factor = dict(zip(plant.states, s, strict=True))
    limits = {name: (factor[name] * low, factor[name] * high) for name, (low, high) in plant.limits}
    names = plant.states, plant.inputs, plant.circular
    if isinstance(plant, LinearPlant):
        matrix = _rescale_matrix(plant.matrix, s, s, u)
        input_matrix = _rescale_matrix(plant.input_matrix, s, u, u)
        return LinearPlant(matrix, noise, center, law, input_matrix, *names, limits=limits)
    move = FunctionInUnits(plant.transition, s, (s, u))
    return Plant(move, noise, center, law, *names, attitude=plant.attitude, limits=limits)


def _rescale_initial_law(plant: AbstractPlant, s: np.ndarray) -> tuple[np.ndarray, AbstractNoise | np.ndarray]:
    """Return the center, and the law of the deviation from it or its covariance, of the initial state S x_0.

    S is diag(s), s the factors of the states in other units. A plant has a covariance, or a law of the deviation, whose
    mean may not be zero: so the center is the mean of the state less that of the deviation.
    """
    if plant.deviation is None:
        return s * plant.initial_mean, np.outer(s, s) * plant.initial_covariance
    center = plant.initial_mean - plant.deviation.mean
    return s * center, _rescale_noise(plant.deviation, s)


def _rescale_matrix(
    matrix: MatrixOfInputs | ArrayLike, rows: np.ndarray, columns: np.ndarray, inputs: np.ndarray
) -> FunctionInUnits | np.ndarray:
    """Return a plant's matrix A in other units, with the entries r_i A_ij / c_j; a function of the inputs if A is one.

    Args:
        matrix: A.
        rows: factors r of what the matrix returns, such as states.
        columns: factors c of what it multiplies.
        inputs: factors of the inputs, by which new ones are divided before the function is called.
    """
    factor = rows[:, None] / columns
    if isinstance(matrix, MatrixOfInputs):
        return FunctionInUnits(matrix.function, factor, (inputs,))
    return np.asarray(rows[:, None] * matrix / columns)


def rescale_sensor(sensor: AnySensor, units: Units) -> AnySensor:
    """Return the sensor, or the sensor at each step, in other units: it measures R y of states S x.

    R and S are the diagonal matrices of the factors of outputs and states in `units`.
    """
    rescaled: AnySensor = at_each_step(lambda step: _rescale_sensor(step, units), sensor)
    return rescaled


def _rescale_sensor(sensor: AbstractSensor, units: Units) -> AbstractSensor:
    """Return the sensor whose states and outputs are counted in other units: R h(S^-1 x), R V R.

    S and R are the diagonal matrices of the factors of states and outputs in `units`. V is the noise's covariance.
    """
    s, r = units.states, units.outputs
    noise = _rescale_noise(sensor.noise, r)
    if isinstance(sensor, LinearSensor):
        return LinearSensor(r[:, None] * sensor.matrix / s, noise, sensor.outputs, sensor.circular)
    return Sensor(FunctionInUnits(sensor.measure, r, (s,)), noise, sensor.outputs, sensor.circular)


def _rescale_moments(channel: SecondOrder | OverTime, units: Units) -> SecondOrder | OverTime:
    """Return the second moments of a channel z = G y + n in other units, z = Q G R^-1 y + Q n, at each step."""
    rescaled: SecondOrder | OverTime = at_each_step(lambda step: rescale_channel(step, units), channel)
    return rescaled


def rescale_channel(channel: SecondOrder, units: Units) -> SecondOrder:
    """Return the second moments of a channel z = G y + n in other units: of outputs R y and measurements Q z.

    In these units it is z = Q G R^-1 y + Q n, where R and Q are diagonal matrices of the factors in `units`. With
    M = (G, n), the second moment E[M_ia M_jb] of two entries is multiplied by the product of the entries' factors.
    """
    _factors_of_entries, factors_of_pairs = _list_channel_factors(units)

    def scale(moments: QuadraticMap) -> QuadraticMap:
        """Return second moments of M in the other units.

        A moment that is uncertain lies within +- `radius` of `center`, so that both are scaled alike.
        """
        return QuadraticMap(factors_of_pairs * moments.center, factors_of_pairs * moments.radius)

    q = units.received
    mean_gain, mean_offset = q[:, None] * channel.mean_gain / units.outputs, q * channel.offset
    mean = np.concatenate([mean_gain, mean_offset[:, None]], axis=1)
    # The covariance of M, the square of the error of its mean, E[M_ia M_jb], and the covariance of the nominal law;
    # the first three are bounds where the channel's law is uncertain.
    spread, shift, power, nominal = map(scale, (channel.spread, channel.shift, channel.power, channel.nominal))
    return describe_second_moments(mean, spread, shift, power, nominal, channel.uncertain)


def _list_channel_factors(units: Units) -> tuple[Float[np.ndarray, "m p1"], Float[np.ndarray, "m m p1 p1"]]:
    """Return the factors by which a channel z = G y + n changes with the units, of M = (G, n) and of E[M_ia M_jb].

    They are q_i / r_a, entry ia, and q_i q_j / (r_a r_b), entry ijab, with q the factor of each number received, and r
    that of each output y of the sensor, and 1 for the offset n.
    """
    q, r = units.received, np.append(units.outputs, 1.0)
    return q[:, None] / r, (q[:, None] * q)[:, :, None, None] / (r[:, None] * r)


def _rescale_by_mode(channel: Modes | OverTime, units: Units) -> Modes | OverTime:
    """Return the description of a channel z = G y + n by mode in other units: z = Q G R^-1 y + Q n in each."""
    values: Modes = stack_over_time(channel)
    of_mean, of_spread = _list_channel_factors(units)
    noise = WeightedColumns(units.received[:, None] * values.noise.matrix, values.noise.weights)
    gains = of_spread * values.gain_covariance
    scaled: Modes = replace(values, mean=of_mean * values.mean, gain_covariance=gains, noise=noise)
    return OverTime(scaled) if isinstance(channel, OverTime) else scaled


def _rescale_combinations(components: AtomCombinations | OverTime, units: Units) -> AtomCombinations | OverTime:
    """Return the combinations of a filter's atoms with state and measurements in other units.

    A combination takes one value of each discrete gain. It has the probability `weight` and a channel.
    """
    values = stack_over_time(components)
    q = units.received
    scaled = AtomCombinations(
        values.weight,
        q[:, None] * values.gain / units.states,
        q * values.offset,
        WeightedColumns(q[:, None] * values.noise.matrix, values.noise.weights),
        values.mode,
        values.transition,
    )
    return OverTime(scaled) if isinstance(components, OverTime) else scaled


def _rescale_centre(centre: UnconditionalMean | None, units: Units) -> UnconditionalMean | None:
    """Return the mean before data (None if there is none) with state and measurements in other units.

    With the diagonal factors S of states and Q of measurements, the start is S E[x_0], the transition S A S^-1, the
    drift S b, and the matrix by which the mean is received Q M S^-1.
    """
    if centre is None:
        return None
    s = units.states

    def scale(matrix: Array | OverTime, factors: np.ndarray) -> Array | OverTime:
        """Return the product of each element with its factor, at each step."""
        return OverTime(factors * matrix.values) if isinstance(matrix, OverTime) else factors * matrix

    transition, drift = scale(centre.transition, s[:, None] / s), scale(centre.drift, s)
    received = scale(centre.received, units.received[:, None] / s)
    return UnconditionalMean(s * centre.start, transition, drift, received)


def _rescale_system(filter: LinearSystemFilter, degree: int, units: Units) -> LinearSystemFilter:
    """Return the filter of a linear system with state and measurements in other units.

    The system's state has the monomials of the plant's state up to a degree, and its output those of what is received:
    each is multiplied by the product of its factors. With their diagonal matrices Y and Z, the transition A becomes
    Y A Y^-1, the drift Y b, the output matrix Z C Y^-1, and the covariances Y Q Y and Z R Z.
    """
    y, z = _scale_monomials(units.states, degree), _scale_monomials(units.received, degree)
    s = filter.steps.values
    if s.transition.shape[-1] != len(y):  # monomials and 1, mode after mode, behind links that remember
        y = np.tile(np.append(y, 1.0), s.transition.shape[-1] // (len(y) + 1))
    steps = Steps(
        transition=y[:, None] * s.transition / y,
        drift=y * s.drift,
        process=np.outer(y, y) * s.process,
        output=z[:, None] * s.output / y,
        offset=z * s.offset,
        noise=np.outer(z, z) * s.noise,
    )
    projection = units.states[:, None] * filter.projection / y
    system = LinearSystem(steps, y * filter.mean, np.outer(y, y) * filter.covariance, projection)
    return LinearSystemFilter(system, filter.claim, filter.states)


def _scale_monomials(factors: Float[np.ndarray, " n"], degree: int) -> Float[np.ndarray, " N"]:
    """Return the factors (N,) of monomials up to `degree` of numbers with these factors, without the constant 1.

    The monomial x^a y^b of numbers with the factors s and t has the factor s^a t^b.
    """
    # Exponents of all products of `degree` of the numbers (x, 1), a row for each; the last column is that of the 1, and
    # the last row that of the product of ones.
    exponents = np.array(list_exponents(len(factors) + 1, degree))[:-1, :-1]
    return np.asarray(np.prod(factors**exponents, axis=1))
