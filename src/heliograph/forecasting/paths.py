"""Paths into the future: drawn from the last estimate of one filter, through the plant with its noises."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.forecasting.forecast import Target, check_covered, target_of
from heliograph.forecasting.horizons import Horizons, Inputs, ahead_of, check_ahead
from heliograph.forecasting.origins import origin_of
from heliograph.model.origin import HasOrigin
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import wrap_angles
from heliograph.numerics.check import check_count, check_seed, fail
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.manifold import Manifold
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array

DRAWS = 10_000


@readable
class Paths(NamedTuple):
    """Possible futures of one filter's plant, all equally likely given what has arrived.

    Args:
        steps: how far each time is: in steps, or in the unit of time where the plant has an input dt.
        time: of each, on the clock of the data.
        states: names of the states.
        outputs: names of the sensor's outputs, none of a filter that does not say which sensor it is for.
        x: states (draws, times, n).
        y: what the sensor would measure (draws, times, m).
    """

    steps: np.ndarray
    time: np.ndarray
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    x: np.ndarray
    y: np.ndarray


def draw_paths(
    source: HasOrigin,
    horizons: Horizons,
    inputs: Inputs = None,
    draws: int = DRAWS,
    seed: int = 0,
    node: str | None = None,
    filter: str | None = None,
) -> Paths:
    """Draw paths of states and outputs: the last state from its estimate, then the plant with its noises.

    Args:
        source: what one can forecast from, as `hg.forecast` takes it.
        horizons: a number of steps, or a list of how far ahead, as of `hg.forecast`.
        inputs: what the plant will get, as of `hg.forecast`; none by default.
        draws: number of paths; 10,000 by default.
        seed: of the random numbers; 0 by default.
        node: whose filter, "fused" for a fused estimate; by default the only one.
        filter: name of the filter; by default the only one.

    Raises:
        ValueError: what `hg.forecast` refuses; several filters and no name; a filter that does not say what its plant
            is, or that claims no covariance; an unknown start (`hg.diffuse`) of which not all has been heard.
    """
    origin = origin_of(source)
    target = target_of(origin, node, filter)
    ahead = ahead_of(origin, target.outlook.filter.inputs, horizons, inputs)
    check_covered(target.outlook.filter, origin.step, len(ahead.u))
    check_ahead(target.outlook.filter.inputs, ahead, target.outlook.filter, origin.step)
    plant, sensor = target.outlook.plant, target.outlook.sensor
    if plant is None:
        raise fail("paths", "a filter that says what its plant is", type(target.outlook.filter).__name__)
    count, key = check_count("draws", draws), jax.random.key(check_seed("seed", seed))
    start = _draw_starts(target, count, np.random.default_rng(seed))
    x, y = _draw_from_starts(plant, sensor, start, ahead.u, jax.random.split(key, count), np.asarray(origin.step))
    outputs = () if sensor is None else tuple(first(sensor).outputs)
    states = target.outlook.filter.states
    return Paths(ahead.steps, ahead.time, states, outputs, np.asarray(x)[:, ahead.rows], np.asarray(y)[:, ahead.rows])


def _draw_starts(target: Target, draws: int, generator: np.random.Generator) -> np.ndarray:
    """Draw states (draws, n) from the last estimate: a part of its mixture by its weight, then from its Gaussian."""
    filter = target.outlook.filter
    if filter.claim == "none":
        raise fail("paths", "a filter that claims a covariance", f"{type(filter).__name__}, which claims none")
    weights, means, covariances = (np.asarray(part) for part in target.outlook.moments(target.state))
    if not np.isfinite(covariances).all():
        raise fail("paths", "a state that is known", "one of which not all has been heard yet (hg.diffuse)")
    part = generator.choice(len(weights), size=draws, p=weights / weights.sum())
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    changes = np.einsum("dij,dj->di", roots[part], generator.normal(size=(draws, means.shape[1])))
    drawn: np.ndarray = Manifold((), filter.attitude).settle(means[part], means[part] + changes)
    return drawn


@compile_in_float64
def _draw_from_starts(
    plant: AnyPlant, sensor: AnySensor | None, start: Array, u: Array, keys: jax.Array, step: Array
) -> tuple[jax.Array, jax.Array]:
    """Return the states and outputs of each path (draws, rows, ...)."""

    def of_path(x: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw one path from x: what plant and sensor do over the steps of u, with the draws of this key."""

        def move(x: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
            u_k, k = row
            moving, measuring = jax.random.split(jax.random.fold_in(key, k))
            now = at(plant, k)
            x = now.plus(now.transition(x, u_k), now.sample_noise(moving, u_k))
            if sensor is None:
                return x, (x, jnp.zeros(0))
            eye = at(sensor, k).under(now.inputs, u_k)
            return x, (x, wrap_angles(eye.measure(x) + eye.noise.sample(measuring), eye.angles))

        path: tuple[jax.Array, jax.Array] = jax.lax.scan(
            move, x, (jnp.asarray(u), jnp.asarray(step) + jnp.arange(len(u)))
        )[1]
        return path

    paths: tuple[jax.Array, jax.Array] = jax.vmap(of_path)(jnp.asarray(start), keys)
    return paths
