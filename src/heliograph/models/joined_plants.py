"""Plants side by side as one, and a time series as the sum of its components."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.plant import AbstractPlant, JointNoise, LinearPlant, OfInputs, Plant, matrix_of, split_inputs
from heliograph.model.sensor import LinearSensor
from heliograph.model.unknown_start import DiffuseStart, UnknownStart
from heliograph.models.series import Component
from heliograph.numerics.check import array, fail, instance, items
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import block_diagonal, library
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent, NoiseLike


class SideBySide(Module):
    """Transition of several plants, each with its own part of the state and its own inputs.

    Args:
        plants: the plants.
        places: of each plant's inputs among all.
    """

    plants: tuple[AbstractPlant, ...]
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the state after a step."""
        parts, start = [], 0
        for plant, own in zip(self.plants, split_inputs(u, self.places), strict=True):
            parts.append(plant.transition(x[start : start + len(plant.states)], own))
            start += len(plant.states)
        return jnp.concatenate(parts)


class MatrixSideBySide(SideBySide):
    """The block-diagonal matrix of linear plants."""

    def __call__(self, u: jax.Array) -> jax.Array:  # type: ignore[override]
        """Return A (n, n)."""
        plants: list[Any] = list(self.plants)  # linear ones
        pairs = zip(plants, split_inputs(u, self.places), strict=True)
        return jnp.asarray(block_diagonal([jnp.asarray(plant.transition_matrix(own)) for plant, own in pairs]))


class InputsSideBySide(SideBySide):
    """The input matrices of linear plants, one above the other."""

    def __call__(self, u: jax.Array) -> jax.Array:  # type: ignore[override]
        """Return B (n, inputs)."""
        rows, plants = [], list[Any](self.plants)  # linear ones
        for plant, own, at in zip(plants, split_inputs(u, self.places), self.places, strict=True):
            matrix = jnp.asarray(matrix_of(plant.input_matrix, own))
            rows.append(jnp.zeros((len(plant.states), len(u))).at[:, np.array(at, int)].set(matrix))
        return jnp.concatenate(rows)


def join(plants: "Sequence[AbstractPlant]") -> LinearPlant | Plant:
    """Return plants side by side as one: states and inputs keep their names, units and angles.

    They start independently and are driven by independent noises. An input of one name, such as "dt", is one input of
    all that have it. The result is linear where all are.

    Args:
        plants: plants that do not vary over time, no state of one named as another's.

    Raises:
        ValueError: no plants, one that varies over time, a state that two have.
    """
    # Plants whose states all have different names.
    parts = [
        instance("plant to join", plant, AbstractPlant, "a plant that does not vary")
        for plant in items("plants", plants, "plants")
    ]
    if not parts:
        raise fail("plants", "at least one", "none")
    states = [name for plant in parts for name in plant.states]
    doubled = sorted({str(name) for name in states if states.count(name) > 1})
    if doubled:
        raise fail("states of joined plants", "each name once (components and axes take another name)", doubled)
    # All inputs, each once, and where among them those of each plant are.
    inputs = list(dict.fromkeys(name for plant in parts for name in plant.inputs))
    places = tuple(tuple(inputs.index(name) for name in plant.inputs) for plant in parts)
    # Laws of the initial state, and of the noises: one law, or a function of the inputs where some noise is one.
    center, start = _join_starts(parts)
    noises = [plant.noise for plant in parts if isinstance(plant.noise, AbstractNoise)]
    noise = Independent(noises) if len(noises) == len(parts) else JointNoise(tuple(parts), places)
    circular = [name for plant in parts for name in plant.circular]
    attitude = [name for plant in parts for name in plant.attitude]
    limits = tuple(pair for plant in parts for pair in plant.limits)
    if not all(isinstance(plant, LinearPlant) for plant in parts):
        move = SideBySide(tuple(parts), places)
        return Plant(move, noise, center, start, states, inputs, circular=circular, attitude=attitude, limits=limits)
    matrix, input_matrix = _join_matrices(parts, places, len(inputs))
    return LinearPlant(matrix, noise, center, start, input_matrix, states, inputs, circular=circular, limits=limits)


def _join_starts(parts: list[Any]) -> tuple[Any, Any]:
    """Return centre and law of the initial state of plants side by side; where some is unknown, of the others.

    Raises:
        ValueError: a law of x_0 that is not Gaussian beside a start that nobody knows.
    """
    spreads = [plant.initial_covariance for plant in parts]
    if not any(isinstance(spread, UnknownStart) for spread in spreads):
        laws = [plant.deviation or Gaussian(spread) for plant, spread in zip(parts, spreads, strict=True)]
        centers = [plant.initial_mean - law.mean for plant, law in zip(parts, laws, strict=True)]
        return library(*centers).concatenate(centers), Independent(laws)
    for plant in parts:
        if plant.deviation is not None:
            expected = "a Gaussian one (a covariance) beside a start that nobody knows"
            raise fail("law of x_0 of a joined plant", expected, type(plant.deviation).__name__)
    names, known = list[str](), []
    for plant, spread in zip(parts, spreads, strict=True):
        unknown = spread.unknown if isinstance(spread, UnknownStart) else ()
        names += [name for name, nobody_knows in zip(plant.states, unknown, strict=False) if nobody_knows]
        known.append(spread.known if isinstance(spread, UnknownStart) else spread)
    means = [plant.initial_mean for plant in parts]
    return library(*means).concatenate(means), DiffuseStart()(names, block_diagonal(known))


def _join_matrices(parts: list[Any], places: tuple[tuple[int, ...], ...], count: int) -> tuple[Any, Any]:
    """Return A and B of linear plants side by side: constants, or functions of the inputs where some part is one."""
    if any(isinstance(value, OfInputs) for plant in parts for value in (plant.matrix, plant.input_matrix)):
        plants = tuple(parts)
        return MatrixSideBySide(plants, places), InputsSideBySide(plants, places)
    pick = np.eye(count)
    rows = [plant.input_matrix @ pick[list(at)] for plant, at in zip(parts, places, strict=True)]
    return block_diagonal([plant.matrix for plant in parts]), library(*rows).concatenate(rows)


class SumOfComponents(Module):
    """The matrix of a sensor that measures a sum of states, some times an input.

    Args:
        weights: of the states (n,).
        places: place of each state's input among the sensor's, None of one that has none.
    """

    weights: Array
    places: tuple[int | None, ...] = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the matrix (1, n)."""
        return jnp.asarray(self.rows(jnp.asarray(u))[None])

    def rows(self, u: Any) -> Any:
        """Return the weights under inputs (..., inputs): (..., n)."""
        xp = library(u) if not isinstance(u, jax.Array) else jnp
        one = xp.ones(u.shape[:-1])
        return xp.stack([one if at is None else u[..., at] for at in self.places], axis=-1) * self.weights


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
        for part, at in zip(self.parts, _places_of_states(self.parts), strict=True):
            every = np.zeros((*(() if u is None else (len(u),)), len(self.plant.states)))
            every[..., at] = part.loading if u is None else _weights_under_inputs(part, names).rows(u)
            found[part.name] = every
        return found


def _places_of_states(parts: Sequence[Component]) -> list[slice]:
    """Return the places of each component's states among all."""
    ends = np.cumsum([0, *(len(part.plant.states) for part in parts)]).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def _weights_under_inputs(part: Component, names: Sequence[str]) -> SumOfComponents:
    """Return the weights of a component's states under inputs of these names."""
    places = tuple(list(names).index(name) for name in part.inputs) if part.inputs else (None,) * len(part.loading)
    return SumOfComponents(part.loading, places)


def structural(components: "Sequence[Component]", noise: NoiseLike = 0.0, output: str | Names = "y") -> Structural:
    """Return the model of a series y = sum of components + v.

    `hg.kalman_filter(model.plant, model.sensor)` filters it, `hg.models.components(result, model.components)` takes its
    estimates apart.

    Args:
        components: of `level`, `trend`, `seasonal`, `cycle`, `arma`, `regression` or own ones, each of another name.
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
    plant = join([part.plant for part in parts])
    assert isinstance(plant, LinearPlant)  # as all of them are
    named = [part.name for part in parts]
    if len(set(named)) < len(named):
        raise fail("components", "each name once", named)
    outputs = [output] if isinstance(output, str) else output
    weights = library(*(part.loading for part in parts)).concatenate([part.loading for part in parts])
    inputs = list(dict.fromkeys(name for part in parts for name in part.inputs))
    places = tuple(at for part in parts for at in _weights_under_inputs(part, inputs).places)
    matrix: Any = SumOfComponents(weights, places) if inputs else weights[None]
    return Structural(plant, LinearSensor(matrix, noise, outputs, inputs=inputs), tuple(parts))
