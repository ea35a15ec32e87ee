"""Independent plants joined to one: the state stacked, x = [x_1; x_2; ...], and matrices block-diagonal."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.diffuse_start import DiffuseStart, UnknownStart
from heliograph.model.plant import (
    AbstractPlant,
    JointNoise,
    LinearPlant,
    MatrixOfInputs,
    Plant,
    matrix_under_inputs,
    split_inputs,
)
from heliograph.numerics.check import fail, instance, items
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import block_diagonal, library
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent


class TransitionSideBySide(Module):
    """Transition of several plants, each with its own part of the state and its own inputs.

    Args:
        plants: the plants, whose states stand one after another in x.
        places: for each plant, the indices of its own inputs among the inputs u of all.
    """

    plants: tuple[AbstractPlant, ...]
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the joint state after a step: each plant moves its own part of x by its own inputs of u."""
        states_after, begin = [], 0
        for plant, own_inputs in zip(self.plants, split_inputs(u, self.places), strict=True):
            end = begin + len(plant.states)
            states_after.append(plant.transition(x[begin:end], own_inputs))
            begin = end
        return jnp.concatenate(states_after)


class MatrixSideBySide(TransitionSideBySide):
    """The block-diagonal matrix A of linear plants side by side, as a function of the inputs u of all."""

    def __call__(self, u: jax.Array) -> jax.Array:  # type: ignore[override]
        """Return A (n, n) of the joint state under the inputs u of all plants, with the plants' own on the diagonal."""
        plants: list[Any] = list(self.plants)  # linear ones
        plants_and_inputs = zip(plants, split_inputs(u, self.places), strict=True)
        matrices = [jnp.asarray(plant.transition_matrix(own_inputs)) for plant, own_inputs in plants_and_inputs]
        return jnp.asarray(block_diagonal(matrices))


class InputsSideBySide(TransitionSideBySide):
    """The input matrix B of linear plants side by side, one plant's rows above the next, as a function of u."""

    def __call__(self, u: jax.Array) -> jax.Array:  # type: ignore[override]
        """Return B (n, inputs) under the inputs u; a plant's rows are zero except in the columns of its own inputs."""
        rows_of_plants = []
        plants: list[Any] = list(self.plants)  # linear ones
        for plant, own_inputs, columns in zip(plants, split_inputs(u, self.places), self.places, strict=True):
            matrix = jnp.asarray(matrix_under_inputs(plant.input_matrix, own_inputs))
            no_inputs = jnp.zeros((len(plant.states), len(u)))
            rows_of_plants.append(no_inputs.at[:, np.array(columns, int)].set(matrix))
        return jnp.concatenate(rows_of_plants)


def join(plants: "Sequence[AbstractPlant]") -> LinearPlant | Plant:
    """Return plants side by side as one: states and inputs keep their names, units and angles.

    They start independently and are driven by independent noises. An input of one name, such as "dt", is one input of
    all that have it. The result is linear if all plants are.

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
    # All inputs, each once, and the indices of each plant's own inputs among them.
    inputs = list(dict.fromkeys(name for plant in parts for name in plant.inputs))
    places = tuple(tuple(inputs.index(name) for name in plant.inputs) for plant in parts)
    # Laws of the initial state (a fixed center and a law of the deviation from it), and of the noises: one law, or, if
    # some noise is a function of the inputs, a function of them.
    center, start = _join_starts(parts)
    noises = [plant.noise for plant in parts if isinstance(plant.noise, AbstractNoise)]
    noise = Independent(noises) if len(noises) == len(parts) else JointNoise(tuple(parts), places)
    circular = [name for plant in parts for name in plant.circular]
    attitude = [name for plant in parts for name in plant.attitude]
    limits = tuple(pair for plant in parts for pair in plant.limits)
    if not all(isinstance(plant, LinearPlant) for plant in parts):
        move = TransitionSideBySide(tuple(parts), places)
        return Plant(move, noise, center, start, states, inputs, circular=circular, attitude=attitude, limits=limits)
    matrix, input_matrix = _join_matrices(parts, places, len(inputs))
    return LinearPlant(matrix, noise, center, start, input_matrix, states, inputs, circular=circular, limits=limits)


def _join_starts(parts: list[Any]) -> tuple[Any, Any]:
    """Return initial mean and initial law of several plants' joint state, as arguments of the joint plant.

    The joint state stacks the states of the plants, `parts`. If all starts are known, x_0 = center + d: the joint law
    is that of the independent deviations d of the plants, and the center is E[x_0] - E[d], since a law may have a mean
    of its own. If the start of some states is unknown (a diffuse prior), the law is a `DiffuseStart`: the names of
    these states, with the block-diagonal covariance of all others.

    Raises:
        ValueError: some start is unknown, and another plant's law of x_0 is not Gaussian.
    """
    covariances = [plant.initial_covariance for plant in parts]
    if not any(isinstance(covariance, UnknownStart) for covariance in covariances):
        laws = [plant.deviation or Gaussian(covariance) for plant, covariance in zip(parts, covariances, strict=True)]
        centers = [plant.initial_mean - law.mean for plant, law in zip(parts, laws, strict=True)]
        return library(*centers).concatenate(centers), Independent(laws)
    # A diffuse prior is Gaussian, so the other plants' laws of x_0 must be Gaussian too: `deviation` holds other laws.
    for plant in parts:
        if plant.deviation is not None:
            expected = "a Gaussian one (a covariance) beside a start that nobody knows"
            raise fail("law of x_0 of a joined plant", expected, type(plant.deviation).__name__)
    # Names of the states that start unknown, and the covariance of each plant's other states.
    unknown_states, known_covariances = list[str](), []
    for plant, covariance in zip(parts, covariances, strict=True):
        if isinstance(covariance, UnknownStart):
            unknown_states += [name for name, unknown in zip(plant.states, covariance.unknown, strict=False) if unknown]
            known_covariances.append(covariance.known)
        else:
            known_covariances.append(covariance)
    means = [plant.initial_mean for plant in parts]
    diffuse_start = DiffuseStart()(unknown_states, block_diagonal(known_covariances))
    return library(*means).concatenate(means), diffuse_start


def _join_matrices(parts: list[Any], places: tuple[tuple[int, ...], ...], count: int) -> tuple[Any, Any]:
    """Return A and B of linear plants side by side, as functions of the inputs if some plant's matrix is one.

    Args:
        parts: the plants, each with its own states and inputs.
        places: for each plant, the indices of its inputs among all inputs.
        count: number of all inputs.
    """
    if any(isinstance(value, MatrixOfInputs) for plant in parts for value in (plant.matrix, plant.input_matrix)):
        plants = tuple(parts)
        return MatrixSideBySide(plants, places), InputsSideBySide(plants, places)
    identity = np.eye(count)  # its rows at a plant's places move the columns of B to those places
    rows = [plant.input_matrix @ identity[list(own)] for plant, own in zip(parts, places, strict=True)]
    return block_diagonal([plant.matrix for plant in parts]), library(*rows).concatenate(rows)
