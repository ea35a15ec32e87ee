"""Filters of sensors that depend on inputs: at each step the filter of the sensor that the inputs give."""

from collections.abc import Callable
from typing import NamedTuple, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import (
    AbstractFilter,
    Step,
    corrects,
    make_sizes,
    predicts,
)
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.channel import Channel
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import at, at_each_step, first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, PyTree
from heliograph.random_affine.base import AbstractRandomAffine

F = TypeVar("F", bound=AbstractFilter)
P = ParamSpec("P")


class StateUnderInputs(NamedTuple):
    """State of the base filter, and the inputs of the step that led to it (inputs,)."""

    base: PyTree
    u: jax.Array | np.ndarray


class FilterOfInputs(AbstractWrapper):
    """A filter whose sensor depends on the inputs of each step.

    Given the inputs the sensor varies in a known way, like one that varies over time, so that the covariance is what
    the base filter claims.

    Args:
        base: the filter of the sensor under inputs of 1, which predicts; with another sensor in its place it corrects.
        plant: the plant, whose functions are judged.
        sensor: its sensor.
    """

    base: AbstractFilter
    plant: AnyPlant
    sensor: AnySensor

    def within(self, state: StateUnderInputs) -> PyTree:
        """Return the state of the base filter, without the inputs."""
        return state.base

    @in_float64
    def init(self) -> StateUnderInputs:
        """Return the first state of the base filter, with inputs of 0."""
        return StateUnderInputs(self.base.init(), jnp.zeros(len(self.inputs)))

    @predicts
    def predict(self, state: StateUnderInputs, u: ArrayLike = (), k: Step = 0) -> StateUnderInputs:
        """Predict as the base filter does, and keep the inputs u for the measurement that follows."""
        inputs = jnp.asarray(u)
        return StateUnderInputs(self.base.predict(state.base, inputs, k), inputs)

    @corrects
    def correct(self, state: StateUnderInputs, z: ArrayLike, k: Step = 0) -> tuple[StateUnderInputs, Innovation]:
        """Correct by the filter of the sensor under the inputs of this step."""
        after, innovation = self.make_filter_under(state.u, k).correct(state.base, jnp.asarray(z), k)
        return state._replace(base=after), innovation

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the base filter, with the sensor that the inputs u of this step give."""
        filter = self.make_filter_under(jnp.asarray(step.u), step.k)
        return filter.smoother_step(step.map_states(self.within))

    @property
    def attitude(self) -> Angles:
        """Indices of attitudes among the states, those of the base filter."""
        return self.base.attitude

    def make_filter_under(self, u: Array, k: Step) -> AbstractFilter:
        """Return the inner filter with the sensor that the inputs u (inputs,) give at step k.

        `self.inputs` are the names of the inputs, and the sensor selects those that it needs.
        """
        sensor = at(self.sensor, k).under(self.inputs, u)
        filter: AbstractFilter = eqx.tree_at(lambda filter: filter.sensor, self.base, sensor)
        return filter


def build_filter_of_inputs(
    plant: AnyPlant, sensor: AnySensor, channel: Channel | None, make: Callable[[AnySensor], AbstractFilter]
) -> FilterOfInputs:
    """Build the filter of a plant, of a sensor that depends on the plant's inputs, and of a channel.

    Such a sensor is z = h(x, u) + v, as a rate that a control input sets. `make` builds the filter of a sensor without
    inputs. It is called once, with the sensor under example inputs; at each step the filter made gets the sensor under
    that step's inputs in its place.

    Raises:
        ValueError: inputs that the plant does not have; a link that is late, behind which a measurement is one of
            another step; a filter that keeps more of the sensor than itself.
    """
    start = first(plant)
    # A wrong plant gets the sensor's own input names here, so that `make` refuses it with its own error.
    names = start.inputs if isinstance(start, AbstractPlant) else first(sensor).inputs
    typical = at_each_step(lambda single: single.typical(names), sensor)
    link = first(channel)
    if isinstance(link, AbstractRandomAffine) and link.past:
        first(sensor).refuse_inputs("a filter behind a late link")
    base = make(typical)
    if not hasattr(base, "sensor"):
        first(sensor).refuse_inputs(f"a {type(base).__name__}")
    filter = FilterOfInputs(base=base, plant=plant, sensor=sensor, **make_sizes(base.claim, base, base.received))
    # The assumed model, the models under which the filter's claim holds, has the sensor with its inputs.
    assumed = base.assumed
    return with_assumed(filter, assumed and assumed.replaced(sensor=sensor))
