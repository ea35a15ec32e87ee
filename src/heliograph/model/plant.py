"""Plants: x+ = f(x, u) + w, nonlinear or linear, with a Gaussian (or other) initial state."""

from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.diffuse_start import DiffuseStart
from heliograph.model.over_time import OverTime, first
from heliograph.model.readings.limit_arguments import StateLimits, StateLimitsLike, read_state_limits
from heliograph.model.turn_invariance import check_turn_invariance
from heliograph.numerics.angles.angle import Angles, angles_at, read_angles
from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.check import array, covariance, error_text, fail, function, instance, items, name_list, names
from heliograph.numerics.linalg import cholesky
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import as_real, trace_shape
from heliograph.numerics.types import Array, ArrayLike, Names
from heliograph.random_affine.noises.noise import (
    AbstractNoise,
    Matrix,
    NoiseLike,
    Square,
    Vector,
    as_noise,
)

TIME_STEP = "dt"  # input that is the time since the row before, in the unit of the times
MatrixFunction = TypeAliasType("MatrixFunction", Callable[[jax.Array], ArrayLike])  # a matrix of the input u
MatrixLike = TypeAliasType("MatrixLike", ArrayLike | MatrixFunction)


class MatrixOfInputs(Module):
    """A matrix M(u) of the plant's inputs; whatever takes it for a constant array is refused in one line.

    Args:
        function: M, written with jax.numpy.
        name: name of the matrix, for errors.
        inputs: names of the inputs.
    """

    function: MatrixFunction
    name: str = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return M(u) for the plant's inputs u (inputs,)."""
        return as_real(self.function(u))

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        """Raise ValueError: here the matrix must be a constant."""
        raise fail(self.name, "a constant one, as what is computed before data needs", f"one of {list(self.inputs)}")

    __array__ = __jax_array__ = __matmul__ = __rmatmul__ = __getitem__ = __len__ = __iter__ = _refuse


def matrix_under_inputs(matrix: object, u: jax.Array) -> jax.Array:
    """Return a constant matrix as it is, or the value under the inputs u of a matrix that depends on them."""
    return matrix(u) if isinstance(matrix, MatrixOfInputs) else jnp.asarray(matrix)


A = TypeVar("A", jax.Array, np.ndarray)
TransitionFunction = TypeAliasType("TransitionFunction", Callable[[jax.Array, jax.Array], ArrayLike])  # f(x, u)
NoiseFunction = TypeAliasType("NoiseFunction", Callable[[jax.Array], ArrayLike])  # Cov w (n, n) of the input u


@readable
class AbstractPlant(Module):
    """A system x+ = f(x, u) + w with w independent over time; x_0 has `initial_mean` and `initial_covariance`.

    x_0 is Gaussian unless `deviation` holds the law of x_0 - initial_mean up to a constant. States that are `circular`
    are angles in radians: x and x with a full turn more in one of them are the same state. Three states that are an
    `attitude` are a rotation vector: changes of it, noises and covariances are turns in its own axes, in radians.
    `limits` are what filters believe possible, by state; `transition` and the draws know nothing of them.
    """

    noise: eqx.AbstractVar[AbstractNoise | NoiseFunction]
    initial_mean: eqx.AbstractVar[Vector]
    initial_covariance: eqx.AbstractVar[Square]
    deviation: eqx.AbstractVar[AbstractNoise | None]
    states: eqx.AbstractVar[tuple[str, ...]]
    inputs: eqx.AbstractVar[tuple[str, ...]]
    circular: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    attitude: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    limits: StateLimits = eqx.field(static=True, default=(), kw_only=True)

    @property
    def angles(self) -> Angles:
        """Indices of the states that are angles."""
        return tuple(self.states.index(name) for name in self.circular)

    @property
    def manifold(self) -> Manifold:
        """The indices of the states that are angles or attitudes, with the addition and subtraction of such states."""
        return Manifold(self.angles, tuple(self.states.index(name) for name in self.attitude))

    def difference(self, x: A, other: A) -> A:
        """Return x - other of states (..., n); for angles between -pi and pi, for attitudes the turn to x."""
        change: A = self.manifold.difference(x, other)
        return change

    def plus(self, x: A, change: A) -> A:
        """Return x + change of a state (..., n): angles are wrapped to -pi to pi, attitudes turned by the change."""
        changed: A = self.manifold.plus(x, change)
        return changed

    def near(self, x: A, other: Array) -> A:
        """Return the state x (..., n) with its angles within half a turn of those of `other`, so that they average."""
        return self.manifold.near(x, other)

    def make_motion_about(
        self, u: jax.Array, center: jax.Array, middle: jax.Array | None = None
    ) -> Callable[[jax.Array], jax.Array]:
        """Return the function x -> f(x, u) in coordinates about `center`, in which means and covariances can be taken.

        Angles do not jump by full turns, but continue from those at `center`. Attitudes are given as changes from
        `center` and returned as changes from `middle`, the state after the step (f(center, u) by default).
        """
        f: Callable[[jax.Array], jax.Array] = self.manifold.chart_move(lambda x: self.transition(x, u), center, middle)
        return f

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return f(x, u): shapes (n,), (inputs,) -> (n,)."""
        raise unwritten(self, "transition")

    def noise_covariance(self, u: jax.Array) -> jax.Array:
        """Return the covariance (n, n) of w, which may depend on the inputs (a time step, a distance travelled)."""
        if isinstance(self.noise, AbstractNoise):
            return jnp.asarray(self.noise.covariance)
        return as_real(self.noise(u))

    def noise_mean(self) -> jax.Array:
        """Return the mean (n,) of the process noise w, or zeros if only its covariance is known."""
        if isinstance(self.noise, AbstractNoise | JointNoise):
            return jnp.asarray(self.noise.mean)
        return jnp.zeros(self.initial_mean.shape)

    def sample_noise(self, key: jax.Array, u: jax.Array) -> jax.Array:
        """Draw the process noise w (n,) of a step with inputs u."""
        if isinstance(self.noise, AbstractNoise):
            return self.noise.sample(key)
        if isinstance(self.noise, JointNoise):
            return self.noise.sample(key, u)
        return cholesky(self.noise_covariance(u)) @ jax.random.normal(key, self.initial_mean.shape, dtype=float)

    def sample_initial(self, key: jax.Array) -> jax.Array:
        """Draw the initial state x_0 (n,) by the law of its deviation, or by a Gaussian law if none is given."""
        mean = jnp.asarray(self.initial_mean)
        if self.deviation is not None:
            x = mean - self.deviation.mean + self.deviation.sample(key)
        else:
            draw = jax.random.normal(key, self.initial_mean.shape, dtype=float)
            x = mean + cholesky(jnp.asarray(self.initial_covariance)) @ draw
        drawn: jax.Array = self.manifold.settle(mean, x)
        return drawn


def split_inputs(u: Array, indices: Sequence[Sequence[int]]) -> list[jax.Array]:
    """Return the inputs of each part of a model, from all inputs u (inputs,) and the indices of each part's own."""
    return [jnp.asarray(u)[np.array(own, int)] for own in indices]


class JointNoise(Module):
    """Independent noises of several plants, one above the other, of which some depend on inputs: a function of these.

    Args:
        plants: the plants.
        indices: indices of each plant's inputs among all.
    """

    plants: tuple[AbstractPlant, ...]
    indices: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the block-diagonal covariance (n, n) of all noises under all inputs u."""
        pairs = zip(self.plants, split_inputs(u, self.indices), strict=True)
        return jnp.asarray(jax.scipy.linalg.block_diag(*(plant.noise_covariance(own) for plant, own in pairs)))

    @property
    def mean(self) -> jax.Array:
        """Mean of the joint noise: the means of all its parts."""
        return jnp.concatenate([plant.noise_mean() for plant in self.plants])

    def sample(self, key: jax.Array, u: jax.Array) -> jax.Array:
        """Draw the noise of every plant, each with a key and inputs of its own; the draws follow one another."""
        parts = zip(self.plants, jax.random.split(key, len(self.plants)), split_inputs(u, self.indices), strict=True)
        return jnp.concatenate([plant.sample_noise(k, own) for plant, k, own in parts])


class Plant(AbstractPlant):
    """A nonlinear plant: `transition(x, u)` written with jax.numpy, u of shape (len(inputs),).

    Tables that it uses are made with np.asarray: JAX makes arrays in single precision by default, which is warned of.
    `noise` is a covariance, a noise law, or a function of u that returns a covariance (zero-mean Gaussian noise).
    `initial_covariance` is a covariance, or a noise law of x_0 - initial_mean where x_0 is not Gaussian.
    An input named "dt" is filled with the time since the previous row when recorded data has no such column.
    `states` and `inputs` are names, or a mapping of names to units: {"position": "m"}. `circular` names the states that
    are angles, in radians; f must not mind a full turn more in one of them. `limits` are lowest and highest values of
    states, {"soc": (0, 1), "speed": (0, None)}: filters condition on them, and f must keep them by itself if the plant
    that is simulated is to keep them.

    `attitude` names three states that are the rotation vector of an attitude, R = exp [r]x from body to world, or three
    for each of several, at most pi long: f returns it turned, `hg.models.turn_attitude(r, rate * dt)`, since a rotation
    has no sum. Its entries of covariances, and of w, are turns in the body's axes, in radians: the error state.

    Raises:
        ValueError: a transition that does not return a state, covariances that are none, numbers that are not finite,
            circular states or attitudes that are none or that a full turn changes, limits that exclude the initial
            mean or stand beside attitudes.
    """

    function: Callable[[jax.Array, jax.Array], ArrayLike]
    noise: AbstractNoise | NoiseFunction
    initial_mean: Vector
    initial_covariance: Square
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        transition: TransitionFunction,
        noise: NoiseLike | NoiseFunction,
        initial_mean: ArrayLike,
        initial_covariance: NoiseLike,
        states: Names | None = None,
        inputs: Names = (),
        circular: Sequence[str] = (),
        attitude: Sequence[str] = (),
        limits: StateLimitsLike = (),
    ):
        """Check and hold x+ = f(x, u) + w: f = `transition`, laws of w and x_0, names, angles, attitudes, limits."""
        self.function = function("transition of a plant", transition, "(x, u)")
        self.initial_mean, self.initial_covariance, self.deviation = _read_initial_law(initial_mean, initial_covariance)
        n = self.initial_mean.shape[-1]
        self.states = names("state names", states, n, "x")
        self.inputs = names("input names", inputs, len(name_list("input names", inputs)), "u")
        u = np.zeros(len(self.inputs))  # an example, with which the shapes of f and of the noise are checked
        check_shape("transition(x, u)", transition, (self.initial_mean, u), (n,))
        if callable(noise):
            check_shape("process noise covariance(u)", noise, (u,), (n, n))
            self.noise = noise
        else:
            self.noise = as_noise("process noise", noise, n)
        # States that are angles or attitudes, which a full turn must leave the same, and limits of the others.
        self.circular = read_angles("circular states", circular, self.states)
        self.attitude = _read_attitude(self.states, attitude, self.circular)
        if limits and attitude:
            raise fail("limits of states", "none beside attitudes", list(self.attitude))
        self.limits = read_state_limits(limits, self.states, self.circular, self.initial_mean)
        check_turn_invariance("plant", self.transition, self.initial_mean, self.manifold, self.manifold, u)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return f(x, u)."""
        return as_real(self.function(x, u))


class LinearPlant(AbstractPlant):
    """A linear plant x+ = A x + B u + w; noise, initial law, circular states and limits are given as for `Plant`.

    `initial_covariance` may be `hg.diffuse` too: nothing is known of the start, of all states or of named ones.

    A, B and the covariance of w may be functions of the input u, such as `matrix=lambda u: F(u[0])` with
    `inputs=["dt"]`: the plant is linear all the same, varies with its inputs, and what filters claim stays exact. What
    is computed before data (a steady state, schedules, designs) needs constants, and refuses.

    Shapes: matrix (n, n), input_matrix (n, inputs), zero unless given.

    Raises:
        ValueError: wrong shapes, covariances that are none, numbers that are not finite, circular states that are none
            or that a full turn changes, functions of inputs without names.
    """

    matrix: Square  # or MatrixOfInputs, which refuses to be taken for an array
    input_matrix: Matrix  # likewise
    noise: AbstractNoise | NoiseFunction
    initial_mean: Vector
    initial_covariance: Any  # (n, n), or an unknown start, which refuses to be taken for an array
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        matrix: "MatrixLike",
        noise: "NoiseLike | NoiseFunction",
        initial_mean: ArrayLike,
        initial_covariance: "NoiseLike | DiffuseStart",
        input_matrix: "MatrixLike | None" = None,
        states: "Names | None" = None,
        inputs: "Names | None" = None,
        circular: "Sequence[str]" = (),
        limits: "StateLimitsLike" = (),
    ):
        """Check and hold x+ = A x + B u + w: A, B and the noise, which may depend on u, and the law of x_0."""
        # E x_0; Cov x_0, or a `DiffuseStart` if states start unknown; and the law of x_0 about its mean.
        self.initial_mean, initial, self.deviation = _read_initial_law(initial_mean, initial_covariance, unknown=True)
        n = self.initial_mean.shape[-1]
        self.states = names("state names", states, n, "x")
        self.initial_covariance = initial.of_states(self.states) if isinstance(initial, DiffuseStart) else initial
        if isinstance(initial, DiffuseStart) and (circular or limits):
            raise fail("initial covariance", "a known one beside angles and limits of states", "hg.diffuse")
        # Inputs: as many as B has columns, or as have names where something depends on them.
        varies = any(callable(entry) for entry in (matrix, input_matrix, noise))
        if varies and not inputs:
            raise fail("inputs", "the names of those that plant matrices depend on, such as ['dt']", "none")
        count = None if inputs is None or not varies else len(name_list("input names", inputs))  # None: B says it
        B: Any = np.zeros((n, count or 0)) if input_matrix is None else input_matrix
        if not callable(B):
            B = array("input matrix", B, (n, count))
        self.inputs = names("input names", inputs, B.shape[-1] if count is None else count, "u")
        self.matrix = self._read_matrix("plant matrix", matrix, (n, n))
        self.input_matrix = self._read_matrix("input matrix", B, (n, len(self.inputs)))
        if callable(noise):
            check_shape("process noise covariance(u)", noise, (np.zeros(len(self.inputs)),), (n, n))
        self.noise = noise if callable(noise) else as_noise("process noise", noise, n)
        self.circular = read_angles("circular states", circular, self.states)
        self.limits = read_state_limits(limits, self.states, self.circular, self.initial_mean)
        u = np.zeros(len(self.inputs))
        check_turn_invariance("plant", self.transition, self.initial_mean, self.manifold, self.manifold, u)

    def _read_matrix(self, name: str, value: MatrixLike, shape: tuple[int, int]) -> Any:
        """Return a plant's matrix of a given shape: an array, or a `MatrixOfInputs` if `value` is a function of u."""
        if not callable(value):
            return array(name, value, shape)
        check_shape(f"{name}(u)", value, (np.zeros(len(self.inputs)),), shape)
        return MatrixOfInputs(value, name, self.inputs)

    def transition_matrix(self, u: jax.Array) -> jax.Array:
        """Return A (n, n) under the input u (inputs,)."""
        return matrix_under_inputs(self.matrix, u)

    def shift(self, u: jax.Array) -> jax.Array:
        """Return B u + E w (n,) under the input u (inputs,)."""
        return matrix_under_inputs(self.input_matrix, u) @ u + self.noise_mean()

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return A x + B u."""
        return self.transition_matrix(u) @ x + matrix_under_inputs(self.input_matrix, u) @ u


def _read_attitude(states: tuple[str, ...], attitude: Sequence[str], circular: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the states that are rotation vectors; raise unless there are three for each attitude."""
    given, allowed = [str(name) for name in items("attitude", attitude, "names")], set(states) - set(circular)
    if len(given) % 3 or len(set(given)) < len(given) or not set(given) <= allowed:
        expected = f"three of {[name for name in states if name in allowed]} for each attitude, each once"
        raise fail("attitude", expected, given)
    return tuple(given)


def _read_initial_law(
    mean: ArrayLike, initial: NoiseLike | DiffuseStart, unknown: bool = False
) -> tuple[Vector, Any, AbstractNoise | None]:
    """Return mean, covariance and law (None: Gaussian) of an initial state, which may be diffuse if `unknown`."""
    center = array("initial mean", mean, (None,))
    n = center.shape[-1]
    if isinstance(initial, DiffuseStart):
        if not unknown:
            expected = "a covariance or a law, of a plant that is not linear (a large one where little is known)"
            raise fail("initial covariance", expected, "hg.diffuse")
        return center, initial, None
    if not isinstance(initial, AbstractNoise):
        return center, covariance("initial covariance", initial, n), None
    law = as_noise("initial deviation", initial, n)
    return center + law.mean, law.covariance, law


AnyPlant = TypeAliasType("AnyPlant", AbstractPlant | OverTime)  # an OverTime holds one plant per step


def read_manifold(angles: "Sequence[int] | AnyPlant", states: int) -> Manifold:
    """Return which of `states` states are angles or attitudes, from the indices of angles or from the states' plant."""
    plant = first(angles)
    if not isinstance(plant, AbstractPlant):
        return Manifold(angles_at(angles, states))
    if len(plant.states) != states:
        raise fail("angles", f"those of a plant of {states} states", f"one of {list(plant.states)}")
    return plant.manifold


def check_shape(name: str, called: Callable[..., object], values: tuple[object, ...], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless a user's function, `called` with `values`, returns an array of `shape`; it is traced."""
    try:
        got = trace_shape(name, called, *values)
    except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise fail(name, f"a function in operations of jax.numpy, of shape {shape}", error_text(error)) from error
    if got != shape:
        raise fail(name, f"shape {shape}", f"shape {got}")


def read_first_plant(plant: AnyPlant) -> Any:
    """Return the plant at its first step; raise ValueError if it is none, or its noise has no covariance."""
    plant_0 = instance("plant", first(plant), AbstractPlant, "a plant")
    if isinstance(plant_0.noise, AbstractNoise):
        _ = plant_0.noise.covariance  # raises if it does not exist
    return plant_0
