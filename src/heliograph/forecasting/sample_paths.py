"""Sample paths of the future: drawn from the last estimate of one filter, through the plant with its noises."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.adaptive import AdaptiveFilter
from heliograph.filters.modes.multiple_model import ModalBeliefs, MultipleModelFilter
from heliograph.filters.wrappers.state_limits import LimitedFilter
from heliograph.forecasting.forecast import ForecastTarget, check_steps_covered, find_target
from heliograph.forecasting.horizons import Horizons, Inputs, check_inputs_ahead, find_rows_ahead
from heliograph.forecasting.paths_within_limits import StateLimits, draw_limited_components
from heliograph.forecasting.start_states import find_origin
from heliograph.model.forecast_origin import HasOrigin
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor, transition_over
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.check import check_count, check_seed, fail, scalar
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Bool
from heliograph.random_affine.memories_of_channels import memories

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

    def is_beyond(self, name: str, level: float, above: bool = True) -> Bool[np.ndarray, "draws times"]:
        """Return whether a state or an output is beyond a level, at each time of each path (draws, times).

        Args:
            name: name of the state or output.
            level: the level.
            above: True (default) if beyond means above the level, False if below.

        Raises:
            ValueError: no such state or output, a level that is no number.
        """
        limit = float(scalar("level", level))
        if name in self.states:
            values = self.x[:, :, self.states.index(name)]
        elif name in self.outputs:
            values = self.y[:, :, self.outputs.index(name)]
        else:
            known = dict.fromkeys(self.states + self.outputs)
            raise fail("threshold", f"a state or output: {', '.join(known)}", repr(name))
        return np.asarray(values > limit if above else values < limit)


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

    Where a filter knows limits of the states, paths keep them: the start is drawn given that it lies within them; what
    moves beyond one stays at it, and noise that leads beyond is mirrored there.

    Where plant or sensor have modes, the present mode is drawn from its probabilities, and moves by its chain along the
    path: what a filter merges when it predicts, as `gpb1_filter` does with all modes, is not merged here.

    Args:
        source: what one can forecast from, as `hg.forecast` takes it.
        horizons: a number of steps, or a list of how far ahead, as of `hg.forecast`.
        inputs: what the plant will get, as of `hg.forecast`; none by default.
        draws: number of paths; 10,000 by default.
        seed: of the random numbers; 0 by default.
        node: whose filter, "fused" for a fused estimate; by default the only one.
        filter: name of the filter; by default the only one.

    Returns:
        The paths: states (draws, times, n) and outputs (draws, times, m) at the horizons.

    Raises:
        ValueError: what `hg.forecast` refuses; several filters and no name; a filter that does not say what its plant
            is, or that claims no covariance; modes of plant or sensor of which it has no probabilities; an unknown
            start (`hg.diffuse`) of which not all has been heard.
    """
    origin = find_origin(source)
    target = find_target(origin, node, filter)
    ahead = find_rows_ahead(origin, target.predictor.filter.inputs, horizons, inputs)
    check_steps_covered(target.predictor.filter, origin.step, len(ahead.u))
    check_inputs_ahead(target.predictor.filter.inputs, ahead, target.predictor.filter, origin.step)
    plant, sensor = target.predictor.plant, target.predictor.sensor
    if plant is None:
        raise fail("paths", "a filter that says what its plant is", type(target.predictor.filter).__name__)
    count = check_count("draws", draws)
    key = jax.random.key(check_seed("seed", seed))
    # States and modes at the start, then states x and outputs y in all rows ahead, of which the horizons are kept.
    starts = _draw_initial_states(target, count, np.random.default_rng(seed))
    keys, step = jax.random.split(key, count), np.asarray(origin.step)
    learned = None  # deviations of the sensor's noise where the filter learns them
    if isinstance(adaptive := target.predictor.filter, AdaptiveFilter):
        learned = np.asarray(adaptive.noise_deviations(target.state, origin.step))
    limits = StateLimits(target.predictor.limits)
    switching = _find_switching(target)
    x, y = _draw_paths_from_states(plant, sensor, starts, ahead.u, keys, step, switching, learned, limits)
    return Paths(
        steps=ahead.steps,
        time=ahead.time,
        states=target.predictor.filter.states,
        outputs=() if sensor is None else tuple(first(sensor).outputs),
        x=np.asarray(x)[:, ahead.rows],
        y=np.asarray(y)[:, ahead.rows],
    )


class PathState(NamedTuple):
    """Where a path is after a step: its state x, and its mode, 0 if plant and sensor have none; or of many paths."""

    x: Any
    mode: Any


class ModeSwitching(NamedTuple):
    """How a path's mode moves: by the Markov chain of the filter's modes.

    Args:
        filter: the filter, which has the chain; each of its joint modes is one of plant, sensor and channel together.
        moved: whether the filter has predicted before. If not, its modes are already those of the first step.
    """

    filter: MultipleModelFilter
    moved: Bool[Array, ""]

    def draw_next(self, key: jax.Array, mode: jax.Array, u: jax.Array, k: jax.Array, is_first: jax.Array) -> jax.Array:
        """Return the mode of step k, drawn by the chain from the mode of the previous step.

        Args:
            key: of the random numbers.
            mode: joint mode of the previous step.
            u: inputs of the step (inputs,), on which the transition probabilities may depend.
            k: number of the step.
            is_first: whether it is the path's first step. The mode stays there if the filter has not predicted before.
        """
        plant, channel = at(self.filter.plant, k), at(self.filter.channel, k)
        transition = transition_over(plant, u, jnp.asarray(channel.transition))  # row i: probabilities of the next mode
        stays = is_first & ~jnp.asarray(self.moved)
        return jnp.where(stays, mode, jax.random.categorical(key, jnp.log(transition[mode])))

    def choose_models(self, plant: Any, sensor: Any, mode: jax.Array) -> tuple[Any, Any]:
        """Return plant and sensor of one step as they are in a joint mode; a part without modes as it is.

        A joint mode is a mode of the plant, one of the sensor and one of the channel together; the filter has a table
        of each part's mode by joint mode.

        Args:
            plant: the plant of the step.
            sensor: the sensor of the step, or None.
            mode: number of the joint mode.
        """
        plant_mode = jnp.asarray(self.filter.plant_modes)[mode]
        sensor_mode = jnp.asarray(self.filter.sensor_modes)[mode]
        if isinstance(plant, ModalPlant):
            plant = plant.given(plant_mode)
        if isinstance(sensor, ModalSensor):
            sensor = sensor.given(sensor_mode)
        return plant, sensor


def _find_switching(target: ForecastTarget) -> ModeSwitching | None:
    """Return how the modes of plant and sensor move, or None if these have no modes.

    Paths draw the present mode from the filter's probabilities of the modes, so only a filter that has them will do.
    `target` is the filter, with its plant, sensor and last state.
    """
    filter = target.predictor.filter
    plant = target.predictor.plant
    sensor = target.predictor.sensor
    if not memories((plant, sensor)):
        return None
    if isinstance(filter, LimitedFilter):
        filter = filter.base
    if not isinstance(filter, MultipleModelFilter):
        expected = "a filter that has the modes' probabilities (imm_filter, gpb1_filter, gpb2_filter)"
        raise fail("paths of a plant or sensor with modes", expected, type(filter).__name__)
    return ModeSwitching(filter, target.state.moved)


def _draw_initial_states(target: ForecastTarget, draws: int, generator: np.random.Generator) -> PathState:
    """Return states (draws, n) and modes (draws,) drawn from the last estimate, a mixture of K Gaussians.

    For each draw one Gaussian is drawn by its weight, and from it the mode and the state. The modes are 0 where the
    filter has none.

    Args:
        target: the filter (`predictor`) and its last state.
        draws: number of draws.
        generator: of the random numbers.

    Raises:
        ValueError: a filter that claims no covariance, a state of which not all is known.
    """
    filter = target.predictor.filter
    if filter.claim == "none":
        raise fail("paths", "a filter that claims a covariance", f"{type(filter).__name__}, which claims none")
    weights, means, covariances = (np.asarray(part) for part in target.predictor.moments(target.state)[:3])
    if not np.isfinite(covariances).all():
        raise fail("paths", "a state that is known", "one of which not all has been heard yet (hg.diffuse)")
    part = generator.choice(len(weights), size=draws, p=weights / weights.sum())
    # A mode by its probability in the drawn part: the first whose cumulated probability is above a uniform number.
    modes: np.ndarray = np.zeros(draws, dtype=int)
    if isinstance(target.state, ModalBeliefs):
        cumulated = np.cumsum(np.asarray(target.state.weight), axis=1)[part]  # weight: (K, modes)
        uniform = generator.random(draws)[:, None] * cumulated[:, -1:]  # weights of a part need not sum to 1
        modes = np.minimum((uniform > cumulated).sum(axis=1), cumulated.shape[1] - 1)
    # States with limits first, then the others given these: the part's mean, plus a root of its covariance times
    # standard normal numbers. Attitudes are turned.
    mean, covariances = draw_limited_components(part, means, covariances, target.predictor.limits, generator)
    values, vectors = np.linalg.eigh(covariances)
    roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    changes = np.einsum("dij,dj->di", roots[part], generator.normal(size=(draws, means.shape[1])))
    drawn: np.ndarray = Manifold((), filter.attitude).settle(mean, mean + changes)
    return PathState(x=drawn, mode=modes)


@compile_in_float64
def _draw_paths_from_states(
    plant: AnyPlant,
    sensor: AnySensor | None,
    starts: PathState,
    u: Array,
    keys: jax.Array,
    step: Array,
    switching: ModeSwitching | None,
    learned: Array | None,
    limits: StateLimits,
) -> tuple[jax.Array, jax.Array]:
    """Return the states (draws, rows, n) and outputs (draws, rows, m) of drawn paths; m = 0 without a sensor.

    Args:
        plant: of the paths.
        sensor: what measures them; None for none.
        starts: states (draws, n) and modes (draws,) before the first row.
        u: inputs (rows, inputs).
        keys: a random key for each path (draws,).
        step: number of the first row.
        switching: how modes move; None where there are none.
        learned: deviations of the sensor's noise in units of its own (m,), where a filter learned them; else None.
        limits: within which states keep.
    """

    def draw_row(
        before: PathState, row: tuple[jax.Array, jax.Array], key: jax.Array
    ) -> tuple[PathState, tuple[jax.Array, jax.Array]]:
        """Draw row k of a path: return where the path is then, which the next row begins with, and state and output.

        `row` holds the inputs and the number k. The state moves by the plant, then noise is added; limits of states
        hold after both. From outside: `plant` and `sensor` are the models of all rows, `switching` says how their modes
        move, `step` is the number of the first row, `limits` are those of the states, and `learned` are deviations of
        the noise that a filter learned.
        """
        (x, mode), (u_k, k) = before, row
        key_of_row = jax.random.fold_in(key, k)
        key_of_plant, key_of_sensor = jax.random.split(key_of_row)
        plant_k = at(plant, k)
        sensor_k = None if sensor is None else at(sensor, k)
        if switching is not None:
            key_of_mode = jax.random.fold_in(key_of_row, 2)  # 0 and 1 may be the keys of plant and sensor
            mode = switching.draw_next(key_of_mode, mode, u_k, k, is_first=k == jnp.asarray(step))
            plant_k, sensor_k = switching.choose_models(plant_k, sensor_k, mode)
        moved = limits.hold(plant_k.transition(x, u_k))
        x = limits.hold(limits.mirror(plant_k.plus(moved, plant_k.sample_noise(key_of_plant, u_k))))
        y = jnp.zeros(0)
        if sensor_k is not None:
            y = _draw_outputs(sensor_k.under(plant_k.inputs, u_k), x, key_of_sensor, learned)
        return PathState(x, mode), (x, y)

    def draw_path(start: PathState, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the states (rows, n) and outputs (rows, m) of one path, drawn row by row from its start.

        From outside: `u` are the inputs of the rows, `step` is the number of the first row, and `draw_row` draws a row.
        """
        rows = jnp.asarray(u), jnp.asarray(step) + jnp.arange(len(u))
        path: tuple[jax.Array, jax.Array]
        _, path = jax.lax.scan(lambda before, row: draw_row(before, row, key), start, rows)
        return path

    paths: tuple[jax.Array, jax.Array] = jax.vmap(draw_path)(jax.tree.map(jnp.asarray, starts), keys)
    return paths


def _draw_outputs(sensor: AbstractSensor, x: jax.Array, key: jax.Array, learned: Array | None) -> jax.Array:
    """Return what a sensor measures (m,) of a state x, with noise drawn from its law.

    Args:
        sensor: the sensor of the step.
        x: the state (n,).
        key: of the random numbers.
        learned: factors (m,) of the noise's deviations, if a filter learned them; else None.
    """
    law, noise = sensor.noise, sensor.noise.sample(key)
    if learned is not None:
        noise = jnp.asarray(law.mean + jnp.asarray(learned) * (noise - law.mean))
    return jnp.asarray(wrap_angles(sensor.measure(x) + noise, sensor.angles))
