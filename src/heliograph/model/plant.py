"""Plants: x+ = f(x, u) + w, nonlinear or linear, with a Gaussian (or other) initial state."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.over_time import OverTime, first
from heliograph.numerics.angle import TURN, Angles, angles_named, continued, nearest, wrapped
from heliograph.numerics.check import array, covariance, fail, function, instance, items, names, shown_error
from heliograph.numerics.linalg import cholesky
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.traced import is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.noise import (
    AbstractNoise,
    Gaussian,
    Independent,
    Matrix,
    Square,
    Vector,
    as_noise,
)

SAME = 1e-6  # relative: what a full turn of 2 pi, known to rounding, may leave in a steep function
A = TypeVar("A", jax.Array, np.ndarray)
NoiseFunction = Callable[[jax.Array], ArrayLike]  # covariance of w, (n, n), from the input u


@readable
class AbstractPlant(Module):
    """A system x+ = f(x, u) + w with w independent over time; x_0 has `initial_mean` and `initial_covariance`.

    x_0 is Gaussian unless `deviation` holds the law of x_0 - initial_mean up to a constant. States that are `circular`
    are angles in radians: x and x with a full turn more in one of them are the same state.
    """

    noise: eqx.AbstractVar[AbstractNoise | NoiseFunction]
    initial_mean: eqx.AbstractVar[Vector]
    initial_covariance: eqx.AbstractVar[Square]
    deviation: eqx.AbstractVar[AbstractNoise | None]
    states: eqx.AbstractVar[tuple[str, ...]]
    inputs: eqx.AbstractVar[tuple[str, ...]]
    circular: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)

    @property
    def angles(self) -> Angles:
        """Indices of the states that are angles."""
        return tuple(self.states.index(name) for name in self.circular)

    def difference(self, x: A, other: A) -> A:
        """x - other of states (..., n), angles between -pi and pi."""
        return wrapped(x - other, self.angles)

    def near(self, x: A, other: Array) -> A:
        """The same state x (..., n), its angles within half a turn of those of `other`: so they can be averaged."""
        return nearest(x, other, self.angles)

    def moves(self, u: jax.Array, center: jax.Array) -> Callable[[jax.Array], jax.Array]:
        """x -> f(x, u) with angles continued from those at `center`, as moments are made of it."""
        return continued(lambda x: self.transition(x, u), center, self.angles, self.angles)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """f(x, u): shapes (n,), (inputs,) -> (n,)."""
        raise NotImplementedError

    def noise_covariance(self, u: jax.Array) -> jax.Array:
        """Covariance of w, (n, n); it may depend on the input (a time step, a distance travelled)."""
        if isinstance(self.noise, AbstractNoise):
            return jnp.asarray(self.noise.covariance)
        return jnp.asarray(self.noise(u))

    def noise_mean(self) -> jax.Array:
        """Mean of w, (n,)."""
        if isinstance(self.noise, AbstractNoise):
            return jnp.asarray(self.noise.mean)
        return jnp.zeros(self.initial_mean.shape)

    def sample_noise(self, key: jax.Array, u: jax.Array) -> jax.Array:
        """Draw w."""
        if isinstance(self.noise, AbstractNoise):
            return self.noise.sample(key)
        return cholesky(self.noise_covariance(u)) @ jax.random.normal(key, self.initial_mean.shape, dtype=float)

    def sample_initial(self, key: jax.Array) -> jax.Array:
        """Draw x_0."""
        if self.deviation is not None:
            return jnp.asarray(self.initial_mean) - self.deviation.mean + self.deviation.sample(key)
        draw = jax.random.normal(key, self.initial_mean.shape, dtype=float)
        return jnp.asarray(self.initial_mean) + cholesky(jnp.asarray(self.initial_covariance)) @ draw


class Plant(AbstractPlant):
    """A nonlinear plant: `transition(x, u)` written with jax.numpy, u of shape (len(inputs),).

    `noise` is a covariance, a noise law, or a function of u that returns a covariance (zero-mean Gaussian noise).
    `initial_covariance` is a covariance, or a noise law of x_0 - initial_mean where x_0 is not Gaussian.
    An input named "dt" is filled with the time since the previous row when recorded data has no such column.
    `circular` names the states that are angles, in radians; f must not mind a full turn more in one of them.

    Raises:
        ValueError: a transition that does not return a state, covariances that are none, numbers that are not finite,
            circular states that are none or that a full turn changes.
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
        transition: Callable[[jax.Array, jax.Array], ArrayLike],
        noise: AbstractNoise | ArrayLike | NoiseFunction,
        initial_mean: ArrayLike,
        initial_covariance: AbstractNoise | ArrayLike,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] = (),
        circular: Sequence[str] = (),
    ):
        self.function = function("transition of a plant", transition, "(x, u)")
        self.initial_mean, self.initial_covariance, self.deviation = _initial(initial_mean, initial_covariance)
        n = self.initial_mean.shape[-1]
        self.states = names("state names", states, n, "x")
        self.inputs = names("input names", inputs, len(items("input names", inputs, "names")), "u")
        u = np.zeros(len(self.inputs))
        check_shape("transition(x, u)", transition, (self.initial_mean, u), (n,))
        if callable(noise):
            check_shape("process noise covariance(u)", noise, (u,), (n, n))
            self.noise = noise
        else:
            self.noise = as_noise("process noise", noise, n)
        self.circular = _circular(self.states, circular)
        check_turns("plant", lambda x: self.transition(x, jnp.asarray(u)), self.initial_mean, self.angles, self.angles)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """f(x, u)."""
        return jnp.asarray(self.function(x, u))


class LinearPlant(AbstractPlant):
    """A linear plant x+ = A x + B u + w; noise, initial law and circular states are given as for `Plant`.

    Shapes: matrix (n, n), input_matrix (n, inputs).

    Raises:
        ValueError: wrong shapes, covariances that are none, numbers that are not finite, circular states that are none
            or that a full turn changes.
    """

    matrix: Square
    input_matrix: Matrix
    noise: AbstractNoise | NoiseFunction
    initial_mean: Vector
    initial_covariance: Square
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        matrix: ArrayLike,
        noise: AbstractNoise | ArrayLike,
        initial_mean: ArrayLike,
        initial_covariance: AbstractNoise | ArrayLike,
        input_matrix: ArrayLike | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        circular: Sequence[str] = (),
    ):
        self.initial_mean, self.initial_covariance, self.deviation = _initial(initial_mean, initial_covariance)
        n = self.initial_mean.shape[-1]
        self.matrix = array("plant matrix", matrix, (n, n))
        self.input_matrix = np.zeros((n, 0)) if input_matrix is None else array("input matrix", input_matrix, (n, None))
        self.noise = as_noise("process noise", noise, n)
        self.states = names("state names", states, n, "x")
        self.inputs = names("input names", inputs, self.input_matrix.shape[-1], "u")
        self.circular = _circular(self.states, circular)
        check_turns("plant", lambda x: jnp.asarray(self.matrix) @ x, self.initial_mean, self.angles, self.angles)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """A x + B u."""
        return jnp.asarray(self.matrix) @ x + jnp.asarray(self.input_matrix) @ u


def with_bias(plant: LinearPlant, coupling: "Float[ArrayLike, 'n bias']", bias: LinearPlant) -> LinearPlant:
    """Return the plant driven by a dynamical bias, as one plant of X = [x; b]: x+ = A x + E b + B u + w, b+ = F b + xi.

    Every filter of the result estimates both. A name that the plant has too gets the prefix "bias_".

    Args:
        plant: the plant of x (n states).
        coupling: E (n, bias states).
        bias: the plant of b, without inputs, independent of the first.

    Raises:
        ValueError: shapes that do not fit, a bias with inputs, noise that depends on inputs.
    Source: quadratic filtering with dynamical bias, equations (1), (2) and (10).
    """
    for what, item in (("plant with bias", plant), ("bias", bias)):
        instance(what, item, LinearPlant, "a LinearPlant")
    n, extra = len(plant.states), len(bias.states)
    coupling = array("coupling of the bias", coupling, (n, extra))
    if bias.inputs:
        raise fail("bias", "a plant without inputs", list(bias.inputs))
    # (w, xi) and the two initial states are independent.
    noises = [p.noise for p in (plant, bias) if isinstance(p.noise, AbstractNoise)]
    if len(noises) < 2:
        raise fail("noise of a plant with bias", "a covariance or a noise law", "a function of the inputs")
    deviations = [p.deviation or Gaussian(p.initial_covariance) for p in (plant, bias)]
    centers = [p.initial_mean - d.mean for p, d in zip((plant, bias), deviations, strict=True)]
    xp = library(plant.matrix, coupling, bias.matrix, centers, plant.input_matrix)
    # [x; b]+ = [[A, E], [0, F]] [x; b] + [B; 0] u + [w; xi].
    renamed = {name: f"bias_{name}" if name in plant.states else name for name in bias.states}
    return LinearPlant(
        xp.block([[plant.matrix, coupling], [np.zeros((extra, n)), bias.matrix]]),
        Independent(noises),
        xp.concatenate(centers),
        Independent(deviations),
        xp.concatenate([plant.input_matrix, np.zeros((extra, len(plant.inputs)))]),
        states=(*plant.states, *renamed.values()),
        inputs=plant.inputs,
        circular=(*plant.circular, *(renamed[name] for name in bias.circular)),
    )


def _circular(states: tuple[str, ...], circular: Sequence[str]) -> tuple[str, ...]:
    return tuple(states[i] for i in angles_named("circular states", circular, states))


def check_turns(
    name: str, function: Callable[[jax.Array], jax.Array], center: Vector, given: Angles, result: Angles
) -> None:
    """Raise ValueError where a full turn of a given angle changes f(center) by more than turns of the angles found."""
    if not given or is_traced(center):
        return
    with jax.enable_x64(True):
        start = np.asarray(function(jnp.asarray(center)))
        for i in given:
            moved = np.asarray(function(jnp.asarray(center + TURN * np.eye(len(center))[i])))
            change = wrapped(moved - start, result)
            if np.any(np.abs(change) > SAME * (1 + np.abs(start))):
                raise fail(f"{name} with circular states", "one that a full turn does not change",
                           f"a change of {np.abs(change).max():.3g} by a turn of state {i}")  # fmt: skip


def _initial(mean: ArrayLike, spread: AbstractNoise | ArrayLike) -> tuple[Vector, Square, AbstractNoise | None]:
    """Mean, covariance and law of the deviation (None: Gaussian) of an initial state."""
    center = array("initial mean", mean, (None,))
    n = center.shape[-1]
    if not isinstance(spread, AbstractNoise):
        return center, covariance("initial covariance", spread, n), None
    law = as_noise("initial deviation", spread, n)
    return center + law.mean, law.covariance, law


AnyPlant = TypeAliasType("AnyPlant", AbstractPlant | OverTime)  # an OverTime holds one plant per step


def check_shape(name: str, called: Callable[..., object], values: tuple[object, ...], shape: tuple[int, ...]) -> None:
    """Raise ValueError unless a user's function returns an array of `shape`."""
    try:
        with jax.enable_x64(True):
            got = jax.eval_shape(lambda *args: jnp.asarray(called(*args)), *values).shape
    except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise fail(name, f"a function in operations of jax.numpy, of shape {shape}", shown_error(error)) from error
    if got != shape:
        raise fail(name, f"shape {shape}", f"shape {got}")


def check_plant(plant: AnyPlant) -> Any:
    """Return the plant at its first step."""
    start = instance("plant", first(plant), AbstractPlant, "a plant")
    if isinstance(start.noise, AbstractNoise):
        _ = start.noise.covariance  # refused where it does not exist
    return start
