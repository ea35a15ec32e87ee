"""Markov jump models: of several laws of motion, or several sensors, a Markov chain picks the one of each step.

The mode of a step moves the plant and measures in it: r_1 ~ pi_0, x_1 = f_(r_1)(x_0, u) + w, z_1 = h_(r_1)(x_1) + v;
then r_2 ~ T[r_1, .].
"""

from collections.abc import Sequence
from typing import Any, NoReturn, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import OverTime
from heliograph.model.plant import TIME_STEP, AbstractPlant
from heliograph.model.sensor import SEVERAL_TAKEN_BY, AbstractSensor
from heliograph.numerics.check import array, fail, instance, items, show_value
from heliograph.numerics.module import Module, are_same
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.markov_chain_and_autoregression import MarkovChain
from heliograph.random_affine.memories_of_channels import AbstractWithMemory, memories, select_model_of_equal_structure
from heliograph.random_affine.noises.noise import AbstractNoise, Square, Vector

Transition = MarkovChain | ArrayLike  # a chain, or its probabilities (modes, modes)
SUM = 1e-9  # of the largest rate: what a row of rates may sum to
APART = 1e8  # condition of the eigenvectors of rates beyond which half of the digits are lost


class SwitchingRates(Module):
    """Rates G (modes, modes) of switches, G[i, j] per unit of time from mode i to j, by eigenvalues and projectors.

    exp(G t) = sum_k exp(l_k t) P_k, of which pairs of complex ones make real numbers.

    Shapes: growth and turn, the real and imaginary parts of l (modes,); real and imaginary of P (modes, modes, modes).
    """

    growth: Vector
    turn: Vector
    real: np.ndarray
    imaginary: np.ndarray

    def __init__(self, rates: ArrayLike):
        """Check the rates G (modes, modes), and decompose exp(G t) once for all t."""
        G = array("rates", rates, ("modes", "modes"))
        if is_traced(G):
            raise fail("rates", "numbers, which are not free", "traced ones")
        G = np.asarray(G, float)
        off_diagonal = G[~np.eye(len(G), dtype=bool)]
        is_balanced = np.max(np.abs(G.sum(axis=1))) <= SUM * np.max(np.abs(G))
        if len(G) != G.shape[1] or (off_diagonal < 0).any() or not is_balanced:
            expected = "a square matrix, 0 or more beside its diagonal, of which each row sums to 0"
            raise fail("rates", expected, G.tolist())
        values, vectors = np.linalg.eig(G)
        if np.linalg.cond(vectors) > APART:
            raise fail("rates", "as many eigenvectors as modes (change one rate a little)", G.tolist())
        projectors = np.einsum("ik,kj->kij", vectors, np.linalg.inv(vectors))
        self.growth, self.turn = values.real, values.imag  # of the eigenvalues
        self.real, self.imaginary = projectors.real, projectors.imag

    def transition_over(self, time: jax.Array) -> jax.Array:
        """Return exp(G t), the transition probabilities (modes, modes) over a time t under the rates G.

        It is sum_k e^(growth_k t) (cos(turn_k t) real_k - sin(turn_k t) imaginary_k), by eigenvalues and projectors.
        """
        size = jnp.exp(jnp.asarray(self.growth) * time)
        cosine, sine = size * jnp.cos(self.turn * time), size * jnp.sin(self.turn * time)
        rows = jnp.einsum("k,kij->ij", cosine, self.real) - jnp.einsum("k,kij->ij", sine, self.imaginary)
        return jnp.maximum(rows, 0.0)  # rounding may make a probability slightly negative


class ModalPlant(AbstractPlant, AbstractWithMemory):
    """A plant that has one of several laws of motion at each step, by the mode of a chain; built by `markov_plant`.

    Args:
        memory: the chain; of rates the identity, which leaves the mode where it is.
        models: the plant of each mode.
        rates: by which the mode moves over the time between rows, in place of the chain; none by default.
    """

    memory: MarkovChain
    models: tuple[AbstractPlant, ...]
    rates: "SwitchingRates | None"
    initial_mean: Vector
    initial_covariance: Square
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, memory: MarkovChain, models: Sequence[AbstractPlant], rates: "SwitchingRates | None" = None):
        """Hold the chain and the plant of each mode; names and law of x_0 are the first one's, as all have the same."""
        self.memory, self.rates = instance("memory", memory, MarkovChain, "a MarkovChain"), rates
        self.models = _read_mode_models("models of a plant", models, AbstractPlant)
        first_plant = self.models[0]
        if first_plant.attitude:
            raise fail("models of a plant", "ones without an attitude", list(first_plant.attitude))
        self.initial_mean, self.initial_covariance = first_plant.initial_mean, first_plant.initial_covariance
        self.deviation, self.states, self.inputs = first_plant.deviation, first_plant.states, first_plant.inputs
        self.circular, self.limits = first_plant.circular, first_plant.limits

    @property  # type: ignore[misc]
    def noise(self) -> Any:  # type: ignore[override]
        """Raise ValueError: the noise is that of a mode (`given`)."""
        return self._refuse()

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Raise ValueError: the law of motion is that of a mode (`given`)."""
        return self._refuse()

    def noise_covariance(self, u: jax.Array) -> jax.Array:
        """Raise ValueError: the noise is that of a mode (`given`)."""
        return self._refuse()

    def noise_mean(self) -> jax.Array:
        """Raise ValueError: the noise is that of a mode (`given`)."""
        return self._refuse()

    def sample_noise(self, key: jax.Array, u: jax.Array) -> jax.Array:
        """Raise ValueError: the noise is that of a mode (`given`)."""
        return self._refuse()

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractPlant:
        """Return the plant of the mode numbered `state`; for a number traced by JAX, one that picks it."""
        if isinstance(state, int | np.integer):
            return self.models[state]
        chosen = select_model_of_equal_structure(self.models, jnp.asarray(state))
        return _ChosenPlant(self.models, jnp.asarray(state)) if chosen is None else chosen

    def _refuse(self) -> NoReturn:
        """Raise ValueError: what needs one law of motion got several, and SEVERAL_TAKEN_BY says what takes them."""
        expected = f"one law of motion here ({SEVERAL_TAKEN_BY})"
        raise fail("plant", expected, f"a markov_plant of {len(self.models)} modes")


class _ChosenPlant(AbstractPlant):
    """The plant models[index], for an index that JAX traces: all are computed, and the result of one is taken."""

    models: tuple[AbstractPlant, ...]
    index: jax.Array
    noise: Any
    initial_mean: Vector
    initial_covariance: Square
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, models: tuple[AbstractPlant, ...], index: jax.Array):
        """Hold all plants and the chosen one's index; names and law of x_0 are the first's, as all have the same."""
        self.models, self.index, self.noise = models, index, None
        first_plant = models[0]
        self.initial_mean, self.initial_covariance = first_plant.initial_mean, first_plant.initial_covariance
        self.deviation, self.states, self.inputs = first_plant.deviation, first_plant.states, first_plant.inputs
        self.circular, self.limits = first_plant.circular, first_plant.limits

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return f(x, u) of the chosen plant."""
        return jnp.stack([model.transition(x, u) for model in self.models])[self.index]

    def sample_noise(self, key: jax.Array, u: jax.Array) -> jax.Array:
        """Draw the noise of the chosen plant."""
        return jnp.stack([model.sample_noise(key, u) for model in self.models])[self.index]


class ModalSensor(AbstractSensor, AbstractWithMemory):
    """A sensor that is one of several at each step, by the mode of a chain; built by `markov_sensor`.

    Args:
        memory: the chain.
        models: the sensor of each mode.
    """

    memory: MarkovChain
    models: tuple[AbstractSensor, ...]
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, memory: MarkovChain, models: Sequence[AbstractSensor]):
        """Hold the chain and the sensor of each mode, which have the same outputs."""
        self.memory = instance("memory", memory, MarkovChain, "a MarkovChain")
        self.models = _read_mode_models("models of a sensor", models, AbstractSensor)
        self.outputs, self.circular = self.models[0].outputs, self.models[0].circular

    @property  # type: ignore[misc]
    def noise(self) -> Any:  # type: ignore[override]
        """Raise ValueError: the noise is that of a mode (`given`)."""
        return self._refuse()

    def measure(self, x: jax.Array) -> jax.Array:
        """Raise ValueError: what is measured is up to the mode (`given`)."""
        return self._refuse()

    def check_states(self, states: int) -> None:
        """Raise ValueError unless each mode measures a state of this length."""
        for model in self.models:
            model.check_states(states)

    def given(self, state: int | float | jax.Array | np.ndarray) -> AbstractSensor:
        """Return the sensor of the mode numbered `state`; for a number traced by JAX, one that picks it."""
        if isinstance(state, int | np.integer):
            return self.models[state]
        chosen = select_model_of_equal_structure(self.models, jnp.asarray(state))
        return _ChosenSensor(self.models, jnp.asarray(state)) if chosen is None else chosen

    def _refuse(self) -> NoReturn:
        """Raise ValueError: what needs one law of what is measured got several."""
        expected = f"one law of what is measured here ({SEVERAL_TAKEN_BY})"
        raise fail("sensor", expected, f"a markov_sensor of {len(self.models)} modes")


class _ChosenNoise(Module):
    """The noise noises[index] of one of several sensors, for an index that JAX traces; it can only be drawn."""

    noises: tuple[AbstractNoise, ...]
    index: jax.Array

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw from all noises with the same key, and return the draw of the one that `index` says."""
        return jnp.stack([noise.sample(key) for noise in self.noises])[self.index]

    def report(self, value: jax.Array) -> jax.Array:
        """Return what the sensor of the index reports of a value, such as it rounded."""
        return jnp.stack([noise.report(value) for noise in self.noises])[self.index]


class _ChosenSensor(AbstractSensor):
    """The sensor models[index], for an index that JAX traces: all measure, and the result of one is taken."""

    models: tuple[AbstractSensor, ...]
    index: jax.Array
    noise: Any
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, models: tuple[AbstractSensor, ...], index: jax.Array):
        """Hold all sensors, which have the same outputs, and the index of the chosen one."""
        self.models, self.index = models, index
        self.noise = _ChosenNoise(tuple(model.noise for model in models), index)
        self.outputs, self.circular = models[0].outputs, models[0].circular

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(x) of the chosen sensor."""
        return jnp.stack([model.measure(x) for model in self.models])[self.index]


def markov_plant(
    models: Sequence[AbstractPlant],
    transition: "Transition | None" = None,
    initial: "ArrayLike | None" = None,
    name: str | None = None,
    modes: "AbstractWithMemory | None" = None,
    rates: "ArrayLike | None" = None,
) -> "ModalPlant":
    """Return a plant whose law of motion is that of the mode of a Markov chain: straight or turning, intact or worn.

    x_k = f_r(x_(k-1), u_k) + w_r with r the mode of step k, r_1 ~ `initial`, r_(k+1) ~ transition[r_k, .]. The mode of
    a step moves the plant and, of a `markov_sensor` or a link of the same chain, measures in it. Switches fall on steps
    only: a row that is inserted between two others is a step more.

    Args:
        models: one plant for each mode, of the same states, inputs, angles and law of x_0 (if traced, the first one's).
        transition: P(next mode j | present mode i) (modes, modes), or a chain.
        initial: law (modes,) of the mode at the first step; the stationary law by default.
        name: links, sensors and plants of one name share the chain; by default it is the plant's own.
        modes: a sensor, plant or link whose chain it is, in place of `transition`; none by default.
        rates: G (modes, modes) of switches per unit of time, in place of `transition`: T = exp(G dt) from a row to the
            next, of plants whose input is "dt"; `imm_filter`, `gpb1_filter` and `gpb2_filter` take it. None by default.

    Raises:
        ValueError: fewer than two models, models of other states, inputs, angles, limits or laws of x_0 than the first,
            probabilities that are none; rates that are none, or without an input "dt" or an initial law.
    """
    # The models may differ in their law of motion alone.
    plants = _read_mode_models("models of a plant", models, AbstractPlant)
    for i, plant in enumerate(plants[1:], start=1):
        for what in ("states", "inputs", "circular", "limits"):
            if getattr(plant, what) != getattr(plants[0], what):
                remedy = " (a model without one of them has it all the same, such as a turn rate that stays 0)"
                raise fail(f"{what} of model {i}", f"{list(getattr(plants[0], what))}, as those of model 0{remedy}",
                           list(getattr(plant, what)))  # fmt: skip
        for what in ("initial_mean", "initial_covariance", "deviation"):
            laws = getattr(plant, what), getattr(plants[0], what)
            if not all(map(is_traced, laws)) and not are_same(*laws):
                raise fail(f"law of x_0 of model {i}", "that of model 0, since the state starts before the first mode",
                           f"another {what.replace('_', ' ')}")  # fmt: skip
    if rates is None:
        return ModalPlant(_read_mode_chain(transition, initial, name, modes, len(plants)), plants)
    # Rates move the mode, by the time between rows. The chain, of the identity, holds the modes and the initial law.
    if initial is None:  # a law is asked for, since the identity has no stationary one of its own
        raise fail("rates of the modes", "initial=, the law of the mode of the first row, beside them", "none")
    if transition is not None or modes is not None:
        given = "transition=" if modes is None else "modes="
        raise fail("rates of the modes", "no transition= and no modes= beside them", given)
    if TIME_STEP not in plants[0].inputs:
        raise fail("rates of the modes", f"plants with the input {TIME_STEP!r}", list(plants[0].inputs))
    moving = SwitchingRates(rates)
    return ModalPlant(_read_mode_chain(np.eye(len(moving.growth)), initial, name, None, len(plants)), plants, moving)


def markov_sensor(
    models: Sequence[AbstractSensor],
    transition: "Transition | None" = None,
    initial: "ArrayLike | None" = None,
    name: str | None = None,
    modes: "AbstractWithMemory | None" = None,
) -> ModalSensor:
    """Return a sensor that is another one in each mode of a Markov chain: it works, is stuck, has a bias.

    z_k = h_r(x_k) + v_r with r the mode of step k. A sensor that is stuck at a value measures 0 x (a matrix of zeros,
    and a noise with that mean). One that *freezes* repeats its last value, which is a state of the plant then: y = s,
    and s+ = h(x+) while it works, s+ = s while it is frozen, in a `markov_plant` of the same chain.

    Args:
        models: one sensor for each mode, of the same outputs and angles.
        transition: P(next mode j | present mode i) (modes, modes), or a chain.
        initial: law (modes,) of the mode at the first step; the stationary law by default.
        name: links, sensors and plants of one name share the chain; by default it is the sensor's own.
        modes: a plant, sensor or link whose chain it is, in place of `transition`; none by default.

    Raises:
        ValueError: fewer than two models, models of other outputs or angles than the first, or that depend on inputs,
            probabilities that are none.
    """
    sensors = _read_mode_models("models of a sensor", models, AbstractSensor)
    for sensor in sensors:
        sensor.refuse_inputs("a sensor with modes")
    for i, sensor in enumerate(sensors[1:], start=1):
        for what in ("outputs", "circular"):
            if getattr(sensor, what) != getattr(sensors[0], what):
                raise fail(f"{what} of model {i}", f"{list(getattr(sensors[0], what))}, as those of model 0",
                           list(getattr(sensor, what)))  # fmt: skip
    return ModalSensor(_read_mode_chain(transition, initial, name, modes, len(sensors)), sensors)


def transition_over(plant: AbstractPlant, u: jax.Array, chain: jax.Array) -> jax.Array:
    """Return the transition probabilities (M, M) of the joint modes of plant and all else, over a row with inputs u.

    The plant's mode varies slowest in their order. If the plant has rates, its mode moves by them over the input dt,
    and then all modes move by `chain` (M, M). Otherwise the result is `chain`.
    """
    if not isinstance(plant, ModalPlant) or plant.rates is None:
        return chain
    by_rates = plant.rates.transition_over(u[plant.inputs.index(TIME_STEP)])
    return jnp.kron(by_rates, jnp.eye(len(chain) // len(by_rates))) @ chain


def list_mode_models(model: Any) -> tuple[Any, ...]:
    """Return the plants or sensors of all modes of one with modes; of one without modes itself alone."""
    return model.models if isinstance(model, ModalPlant | ModalSensor) else (model,)


def _read_mode_models(name: str, models: object, kind: type) -> tuple[Any, ...]:
    """Return the checked models of a chain's modes: at least two, of the class `kind`, constant and without modes."""
    checked = tuple(items(name, models, "one model for each mode"))
    if len(checked) < 2:
        raise fail(name, "at least two, one for each mode", len(checked))
    for model in checked:
        if isinstance(model, OverTime | ModalPlant | ModalSensor) or not isinstance(model, kind):
            got = "one that varies over time" if isinstance(model, OverTime) else show_value(model)
            raise fail(name, "models of one law each, for all steps", got)
    return checked


def _read_mode_chain(
    transition: "Transition | None",
    initial: ArrayLike | None,
    name: str | None,
    modes: object,
    count: int,
) -> MarkovChain:
    """Return the chain of the modes: made of its transition, given as a chain, or that of another model.

    Args:
        transition: a chain, or P(next mode j | present mode i) (modes, modes); None if `modes` is given.
        initial: law (modes,) of the mode at the first step, only with probabilities; None for the stationary law.
        name: name of a chain that several models share, only with probabilities; None for a chain of its own.
        modes: a plant, sensor or link whose chain is taken; None if `transition` is given.
        count: number of modes that it must have.

    Raises:
        ValueError: both or neither of `transition` and `modes`, another number of modes, uncertain transitions.
    """
    # Exactly one of the two says the chain: a transition, or another model whose only memory is a chain.
    if (transition is None) == (modes is None):
        got = "none" if modes is None else "both"
        raise fail("chain of the modes", "transition=, or modes= of a model that has them", got)
    if modes is not None:
        held = list(memories(modes).values())
        if len(held) != 1 or not isinstance(held[0], MarkovChain):
            raise fail("modes", "a plant, sensor or link that has one chain", show_value(modes))
        transition = held[0]
    if isinstance(transition, MarkovChain):
        if initial is not None or name is not None:
            raise fail("initial and name", "none beside a chain, which has its own", "one")
        chain = transition
    else:
        chain = MarkovChain(cast(ArrayLike, transition), initial, name)
    if chain.modes != count:
        raise fail("models", f"{chain.modes}, one for each mode of the chain", count)
    if chain.is_uncertain:
        raise fail("chain of a plant's or sensor's modes", "known transitions", "a radius of uncertainty")
    return chain
