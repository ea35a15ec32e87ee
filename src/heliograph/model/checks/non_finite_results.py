"""Which function of a filter's model (f, Q, h, R) returned NaN or infinity, and for which arguments, in words."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.checks.plant_inputs import yield_models_of_class, yield_plants
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import at
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.types import Float, PyTree


def describe_non_finite_function(filter: PyTree, before: Estimate, u: Float[np.ndarray, " inputs"], step: int) -> str:
    """Return in words which function of a filter's model returned no finite number, and for what; "" if none did.

    The functions are tried at the mean before the step and one deviation from it in each state, as filters do.

    Args:
        filter: the filter, whose plants and sensors are tried.
        before: its estimate before the step.
        u: the inputs of the step (inputs,).
        step: number of the step.
    """
    given = f", u = {u.tolist()}" if len(u) else ""
    with jax.enable_x64(True):
        for x in _yield_trial_states(before):
            # Each plant that takes such a state: is f(x, u) finite?
            states = [x]
            for plant in (at(part, step) for part in yield_plants(filter)):
                if _plant_fits(plant, x, u):
                    states.append(np.asarray(plant.transition(jnp.asarray(x), jnp.asarray(u))))
                    if not np.isfinite(states[-1]).all():
                        return f"transition(x, u) returned {states[-1].tolist()} for x = {x.tolist()}{given}"
            # Sensors at x and at the predicted states, as they measure after the step.
            for sensor in (at(part, step) for part in yield_models_of_class(filter, AbstractSensor)):
                for state in states:
                    y = _measure(sensor, state)
                    if not np.isfinite(y).all():
                        return f"measure(x) of the sensor returned {y.tolist()} for x = {state.tolist()}"
    return ""


def _yield_trial_states(before: Estimate) -> Iterator[Float[np.ndarray, " n"]]:
    """Yield states at which to try a model's functions: the mean, and one standard deviation from it to each side.

    One state is moved at a time; those without a finite, positive variance stay at the mean.
    """
    mean = np.asarray(before.mean)
    variances = np.diag(np.asarray(before.covariance))
    yield mean
    for i in np.flatnonzero(np.isfinite(variances) & (variances > 0)):
        for sign in (1.0, -1.0):
            yield mean + sign * np.sqrt(variances[i]) * np.eye(len(mean))[i]


def _plant_fits(plant: AbstractPlant, x: np.ndarray, u: np.ndarray) -> bool:
    """Return whether a plant has as many states as x and as many inputs as u."""
    return len(plant.states) == len(x) and len(plant.inputs) == len(u)


def _measure(sensor: AbstractSensor, x: np.ndarray) -> np.ndarray:
    """Return what the sensor measures of a state x, h(x), or an empty array if it takes states of another length."""
    try:
        return np.asarray(sensor.measure(jnp.asarray(x)))
    except (TypeError, ValueError, IndexError):
        return np.zeros(0)
