"""Structural time series y = sum of components + noise (level, trend, season, cycle, ...) as a plant and a sensor."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.models.joined_plants import join
from heliograph.models.time_series import Component
from heliograph.numerics.check import array, fail, instance, items
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.noises.noise import NoiseLike


class SumOfComponents(Module):
    """The matrix of a sensor that measures a weighted sum of states; weights may be multiplied by inputs.

    Args:
        weights: of the states (n,).
        places: for each state, the index of the input by which its weight is multiplied (as for a coefficient of a
            regression), or None.
    """

    weights: Array
    places: tuple[int | None, ...] = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the sensor's matrix (1, n), the weights of the states under the inputs u (inputs,)."""
        return jnp.asarray(self.rows(jnp.asarray(u))[None])

    def rows(self, u: Any) -> Any:
        """Return the weights of the states (..., n) under inputs u (..., inputs).

        A state's weight is multiplied by the input at its place in `self.places`, as for a coefficient of a regression.
        If the place is None, it is not.
        """
        xp = library(u) if not isinstance(u, jax.Array) else jnp
        one = xp.ones(u.shape[:-1])
        factors = [one if place is None else u[..., place] for place in self.places]
        return xp.stack(factors, axis=-1) * self.weights


@readable
class Structural(Module):
    """A time series as the sum of its components and a noise.

    Args:
        plant: the components' plants side by side.
        sensor: what measures their sum.
        parts: the components.
    """

    plant: LinearPlant
    sensor: LinearSensor
    parts: tuple[Component, ...]

    @property
    def components(self) -> dict[str, Any]:
        """Weights of the states (n,) for each component, by its name, as `hg.models.components` takes them.

        Raises:
            ValueError: a model with a regression, whose weights depend on the inputs: `weights`.
        """
        return self.weights()

    def weights(self, inputs: "Float[ArrayLike, 'steps inputs'] | None" = None) -> dict[str, Any]:
        """Return the weights of the states for each component, by its name; of a regression those of each row.

        Args:
            inputs: of each row (steps, inputs), in the order of the plant's; by default none, of a model without a
                regression.

        Raises:
            ValueError: no inputs for a regression, or another number of them.
        """
        names = self.plant.inputs
        if inputs is None and any(part.inputs for part in self.parts):
            raise fail(
                "components of a model with a regression", "model.weights(inputs), as inputs weigh its states", "none"
            )
        u = None if inputs is None else array("inputs", inputs, ("steps", len(names)))
        found: dict[str, Any] = {}
        # Each component has states of its own; all others get the weight 0.
        for part, at in zip(self.parts, _find_state_places(self.parts), strict=True):
            rows = () if u is None else (len(u),)  # one row of weights, or one for each row of inputs
            weights_of_all = np.zeros((*rows, len(self.plant.states)))
            weights_of_all[..., at] = part.loading if u is None else _make_component_weights(part, names).rows(u)
            found[part.name] = weights_of_all
        return found


def _find_state_places(parts: Sequence[Component]) -> list[slice]:
    """Return where each component's states stand among the states of all, which follow one another."""
    ends = np.cumsum([0, *(len(part.plant.states) for part in parts)]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def _make_component_weights(part: Component, names: Sequence[str]) -> SumOfComponents:
    """Return the weights of a component's states as a function of inputs that have these `names`, in their order.

    Those of a regression are multiplied by its inputs, all others are constant.
    """
    places = tuple(list(names).index(name) for name in part.inputs) if part.inputs else (None,) * len(part.loading)
    return SumOfComponents(part.loading, places)


def structural(components: "Sequence[Component]", noise: NoiseLike = 0.0, output: str | Names = "y") -> Structural:
    """Return the model of a series y = sum of components + v.

    Each component is a plant and the combination of its states that enters y. `hg.kalman_filter(model.plant,
    model.sensor)` filters the model, `hg.models.components(result, model.components)` takes its estimates apart.

    Args:
        components: results of `level`, `trend`, `seasonal`, `cycle`, `arma`, `regression`, or own ones, each of another
            name.
        noise: variance of v, or its law; 0 by default.
        output: name of y, or a mapping of it to its unit; "y" by default.

    Raises:
        ValueError: no components, two of one name or with a state of one name, a noise that is none.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989).
    """
    parts = [
        instance("component", part, Component, "one such as hg.models.level(1.0)")
        for part in items("components", components, "components")
    ]
    # The components' plants side by side.
    plant = join([part.plant for part in parts])
    assert isinstance(plant, LinearPlant)  # as all of them are
    named = [part.name for part in parts]
    if len(set(named)) < len(named):
        raise fail("components", "each name once", named)
    # y = weights @ states; in a regression a state's weight is multiplied by an input (`places` says which).
    outputs = [output] if isinstance(output, str) else output
    weights = library(*(part.loading for part in parts)).concatenate([part.loading for part in parts])
    inputs = list(dict.fromkeys(name for part in parts for name in part.inputs))
    places = tuple(at for part in parts for at in _make_component_weights(part, inputs).places)
    matrix: Any = SumOfComponents(weights, places) if inputs else weights[None]
    return Structural(plant, LinearSensor(matrix, noise, outputs, inputs=inputs), tuple(parts))
