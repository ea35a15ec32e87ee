"""Moments at every row ahead of a filter's state, of one plant or of many side by side, by compiled code."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code, compute_once
from heliograph.forecasting.mixture_moments import Moments
from heliograph.forecasting.multistep_prediction import MultistepPredictor
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import PyTree

PLANTS_AT_ONCE = 128  # plants side by side under XLA


def predict_moments(
    predictor: MultistepPredictor, state: PyTree, u: np.ndarray, step: int | np.ndarray
) -> tuple[Moments | None, ...]:
    """Return the moments, at each row ahead, of the plant's states, the sensor's outputs and the received numbers.

    They are those of mixtures of K Gaussians: weights (rows, K), means (rows, K, size), covariances
    (rows, K, size, size). Outputs and received numbers are None where the filter does not predict them.

    Args:
        predictor: predicts the filter's state, and reads the moments from it.
        state: the filter's state after the last row of data.
        u: inputs of the rows ahead (rows, inputs).
        step: number of the first row ahead.
    """
    arguments = predictor, state, np.asarray(u, dtype=float), np.asarray(step)
    # Native code computes `_predict_moments` if it supports the filter's operations; else JAX's compiler XLA does.
    moments: tuple[Moments | None, ...] = compute_once(function=_predict_moments, by_xla=_by_xla, arguments=arguments)
    return moments


def predict_moments_of_each(
    predictor: MultistepPredictor, state: PyTree, u: np.ndarray, step: int | np.ndarray
) -> tuple[Moments | None, ...]:
    """Return what `predict_moments` returns, for several plants at once: (plants, rows, K, ...).

    `state`, `u` and `step` have a leading axis over the plants.
    """
    arguments = jax.tree.map(np.asarray, (state, np.asarray(u, dtype=float), step))
    with jax.enable_x64(True):
        choice = choose_code(_predict_moments, (predictor, *arguments), differs_by_run=[False, True, True, True])
        if choice.code is not None:
            found: tuple[Moments | None, ...] = choice.results()
            return found
        # By XLA in blocks of one size, so that it compiles once. The last block is filled up with the last plant.
        count = len(u)
        plants_of_blocks = [
            np.minimum(np.arange(i, i + PLANTS_AT_ONCE), count - 1) for i in range(0, count, PLANTS_AT_ONCE)
        ]
        blocks = [
            to_numpy(_each_by_xla(predictor, *jax.tree.map(lambda leaf, plants=plants: leaf[plants], arguments)))
            for plants in plants_of_blocks
        ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[:count], *blocks)  # type: ignore[no-any-return]


def _predict_moments(predictor: MultistepPredictor, state: PyTree, u: jax.Array, step: jax.Array) -> PyTree:
    """Return the moments of states, outputs and received numbers at each row ahead (rows, K, ...).

    The arguments are those of `predict_moments`; this is the function that is compiled.
    """

    def predict_row(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """Return the filter's state predicted over a row (u, k), and the moments there."""
        return predictor.predict_step(state, *row)

    rows = jnp.asarray(u), jnp.asarray(step) + jnp.arange(len(u))
    _, moments = jax.lax.scan(predict_row, jax.tree.map(jnp.asarray, state), rows)
    return moments


def _predict_moments_of_each(predictor: MultistepPredictor, states: PyTree, u: jax.Array, steps: jax.Array) -> PyTree:
    """Return the moments of each step ahead for several plants, whose states, inputs and steps have a leading axis."""
    return jax.vmap(lambda *plant: _predict_moments(predictor, *plant))(states, u, steps)


_by_xla, _each_by_xla = quickly_compiled(_predict_moments), quickly_compiled(_predict_moments_of_each)
