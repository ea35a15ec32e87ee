"""H-infinity filter: gains designed for a level, run on any plant and sensor."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.h_infinity.design import HInfinityDesign
from heliograph.h_infinity.error_system import GrowthSystem
from heliograph.model.assumed.assumed_model import WITHOUT_ATTITUDE
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, steps_covered
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor, check_sensor, refuse_angles
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Float

ROUNDING = 1e-9  # relative difference of two transitions that are the same, written in other ways


class PendingCorrection(NamedTuple):
    """Last estimate (n,), and the correction (n,) by which the last measurement will change the next one."""

    mean: Float[jax.Array, " n"]
    correction: Float[jax.Array, " n"]


class HInfinityFilter(AbstractSizedFilter):
    """H-infinity filter in predictor form, xhat+ = f(xhat, u) + K (z - E[G] h(xhat)).

    An estimate at step k uses the measurements before step k. There is no covariance to claim: the guarantee is a ratio
    of energies over the horizon. A component that did not arrive counts as if it equalled its expectation. At the first
    step there is no correction, and the estimate is f of the initial one.

    Args:
        plant: the plant, n states.
        sensor: its sensor.
        gains: K (n, received) at each step.
        expected_gain: E[G] at each step.
        initial_mean: initial estimate (n,).
        claim: "none".
        states: names of the plant's states.
        inputs: names of the plant's inputs.
        received: length of z.
    """

    plant: AnyPlant
    sensor: AnySensor
    gains: OverTime
    expected_gain: OverTime
    initial_mean: np.ndarray

    @in_float64
    def init(self) -> PendingCorrection:
        """Return the state before the first step: the initial estimate (n,), and a pending correction of 0."""
        mean = jnp.asarray(self.initial_mean)
        return PendingCorrection(mean, jnp.zeros_like(mean))

    @predicts
    def predict(self, state: PendingCorrection, u: ArrayLike = (), k: Step = 0) -> PendingCorrection:
        """Return xhat+ = f(xhat, u) + the correction that the last measurement made; no correction is pending then."""
        mean = at(self.plant, k).transition(state.mean, jnp.asarray(u)) + state.correction
        return PendingCorrection(mean, jnp.zeros_like(mean))

    @corrects
    def correct(self, state: PendingCorrection, z: ArrayLike, k: Step = 0) -> tuple[PendingCorrection, Innovation]:
        """Return the state with the correction of the next estimate by z, and the innovation.

        This is a filter in predictor form: z changes the next estimate, and the present one stays. The correction is
        the gain of step k times (z - mean gain h(xhat)). A number that did not arrive (NaN) adds nothing.
        """
        value = jnp.asarray(z) - at(self.expected_gain, k) @ at(self.sensor, k).measure(state.mean)
        correction = at(self.gains, k) @ jnp.where(jnp.isnan(value), 0.0, value)
        # The filter has no covariance, so the likelihood is unknown (NaN). If nothing arrives, its logarithm is 0.
        log_likelihood = jnp.where(jnp.any(~jnp.isnan(value)), jnp.nan, 0.0)
        no_covariance = jnp.full((len(value), len(value)), jnp.nan)
        return PendingCorrection(state.mean, correction), Innovation(value, no_covariance, log_likelihood)

    @estimates
    def estimate(self, state: PendingCorrection) -> Estimate:
        """Return the filter's estimate of the state: its mean, with NaN as covariance, since none is claimed."""
        n = state.mean.shape[0]
        return Estimate(state.mean, jnp.full((n, n), jnp.nan), self.claim)


def h_infinity_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    system: GrowthSystem,
    design: HInfinityDesign,
    initial_mean: Float[ArrayLike, " n"] | None = None,
) -> HInfinityFilter:
    """Return the H-infinity filter with designed gains, over the steps of the system.

    Args:
        plant: the plant, n states, whose transition must be the system's A x + f(x): into row k + 1 that of its step k,
            so that a plant that varies is an `OverTime` of the system's matrices behind any first one.
        sensor: its sensor, without angles, the system's C x + h(x) of the same step.
        system: the error system, with the moments of the channel that the filter assumes (`growth_system`).
        design: a feasible design of gains (`recursive_design`).
        initial_mean: initial estimate (n,); the plant's initial mean by default.

    Claim: "none" for a covariance; `certify_level` checks the level that it does guarantee.

    Raises:
        ValueError: a design that is not feasible, or a plant, sensor and system that do not fit: by their sizes, or, of
            models without inputs, by a change of one state that the growth constants do not allow, or by a value at 0.

    Source: H-infinity fusion over amplify-and-forward relays, equation (6).
    """
    instance("system", system, GrowthSystem, "a GrowthSystem, as growth_system makes it")
    instance("design", design, HInfinityDesign, "a design, as recursive_design makes it")
    # An infeasible design guarantees nothing.
    if not design.feasible:
        smallest = "" if design.smallest_level is None else f"; the smallest level found is {design.smallest_level:.6g}"
        raise fail("design", "one that is feasible", f"{design.status} at level {design.level:g}{smallest}")
    _check_sizes(plant, sensor, system, design)
    _check_models(plant, sensor, system)
    plant_0, outputs = first(plant), system.output.shape[1]
    shape = (system.states,)
    mean = plant_0.initial_mean if initial_mean is None else array("filter's initial mean", initial_mean, shape)
    # E[G], by which the filter predicts z; the other columns of the channel's mean belong to its own disturbances.
    expected_gain = np.array([link.mean[:, :outputs] for link in system.channel])
    return HInfinityFilter(
        plant=plant,
        sensor=sensor,
        gains=OverTime(design.gains),
        expected_gain=OverTime(expected_gain),
        initial_mean=mean,
        **make_sizes("none", plant_0, system.received),
    )


def _check_sizes(plant: AnyPlant, sensor: AnySensor, system: GrowthSystem, design: HInfinityDesign) -> None:
    """Raise ValueError unless plant, sensor, system and design fit each other, without attitudes and angles.

    WITHOUT_ATTITUDE are the words of the error message for a plant with attitudes.
    """
    plant_0 = instance("plant", first(plant), AbstractPlant, "a plant")
    if plant_0.attitude:
        raise fail("plant of an H-infinity filter", WITHOUT_ATTITUDE, list(plant_0.attitude))
    n, outputs = len(plant_0.states), system.output.shape[1]
    if n != system.states or design.gains.shape != (system.steps, n, system.received):
        raise fail("system", f"{n} states and gains {design.gains.shape}", f"{system.states} states")
    check_sensor(first(sensor), n)
    refuse_angles("H-infinity filter", plant, sensor)
    if len(first(sensor).outputs) != outputs:
        raise fail("sensor", f"the system's {outputs} outputs", len(first(sensor).outputs))


def _check_models(plant: AnyPlant, sensor: AnySensor, system: GrowthSystem) -> None:
    """Raise ValueError if plant or sensor is seen not to be the system's: no level holds of another one.

    By x = 0 and each unit vector x: |f(x) - f(0) - A x| <= a |x| and f(0) = 0 of the plant's transition into row k + 1,
    the system's A and a of step k, and likewise of what is measured in row k. Models with inputs, which are not known,
    are passed over.
    """
    if first(plant).inputs or first(sensor).inputs:
        return
    rows = min(system.steps, steps_covered((plant, sensor)) or system.steps)  # that plant and sensor cover

    def get_transition(plant_of_step: AbstractPlant) -> Callable[[jax.Array], jax.Array]:
        """Return the transition f(x) of a plant without inputs."""
        return lambda x: plant_of_step.transition(x, jnp.zeros(0))

    changes_of_plant = _list_changes(plant, get_transition, system.states)
    changes_of_sensor = _list_changes(sensor, lambda sensor_of_step: sensor_of_step.measure, system.states)
    for k in range(rows):
        if k + 1 < rows:
            expected = f"A x + f(x) of the system's step {k}, which leads to it"
            found = changes_of_plant(k + 1)
            _compare(f"plant in row {k + 1}", expected, found, system.transition[k], system.growth.error[k])
        expected = f"C x + h(x) of the system's step {k}"
        found = changes_of_sensor(k)
        _compare(f"sensor in row {k}", expected, found, system.output[k], system.output_growth.error[k])


def _list_changes(
    model: AnyPlant | AnySensor, choose: Callable[[Any], Callable[[jax.Array], jax.Array]], n: int
) -> Callable[[int], Float[np.ndarray, "_ points"]]:
    """Return a function of a step that gives f(0) of the model, and f(x) - f(0) at all unit vectors x, as columns.

    `choose`: from the model of a step its function f. `n`: number of states.
    """

    def compute(k: int) -> Float[np.ndarray, "_ points"]:
        """Return f(0), and f(x) - f(0) at the unit vectors x, as columns, for the function f of step k."""
        f = choose(at(model, k))
        with jax.enable_x64(True):
            at_zero = f(jnp.zeros(n))
            return np.asarray(jnp.stack([at_zero, *(jax.vmap(f)(jnp.eye(n)) - at_zero)], axis=1))

    if isinstance(model, OverTime):
        return compute
    same = compute(0)  # of a model that does not vary
    return lambda k: same


def _compare(
    name: str, expected: str, found: Float[np.ndarray, "_ points"], matrix: Float[np.ndarray, "_ n"], growth: float
) -> None:
    """Raise ValueError if a change of one state by 1 differs from the matrix's by more than the growth constant allows.

    A value at 0 is refused too: behind a random gain it makes an error without any disturbance. ROUNDING: the
    difference, relative to the change, that counts as rounding.

    Args:
        name: what is compared, in the error message.
        expected: what it should be, in the error message.
        found: f(0), and f(x) - f(0) at the unit vectors x, as columns.
        matrix: A of the system, whose columns are A x at the unit vectors.
        growth: a of |f(x) - f(y) - A (x - y)| <= a |x - y|.
    """
    at_zero, changes = found[:, 0], found[:, 1:]  # as of `_list_changes`
    if np.linalg.norm(at_zero) > ROUNDING * max(1.0, float(np.linalg.norm(matrix))):
        raise fail(name, f"{expected}, which is 0 at x = 0 (take a constant off)", at_zero.tolist())
    difference = np.linalg.norm(changes - matrix, axis=0)
    allowed = float(growth) * (1 + ROUNDING) + ROUNDING * np.linalg.norm(matrix, axis=0)
    if np.any(difference > allowed):
        i = int(np.argmax(difference - allowed))
        got = f"{difference[i]:.3g} from it where state {i} changes by 1, the growth constant being {float(growth):.3g}"
        raise fail(name, expected, got)
