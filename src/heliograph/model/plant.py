"""Plants: x+ = f(x, u) + w, nonlinear or linear, with a Gaussian (or other) initial state."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import array, covariance, fail, function, instance, items, names, shown_error
from heliograph.numerics.linalg import cholesky
from heliograph.numerics.readable import readable
from heliograph.numerics.traced import library
from heliograph.random_affine.noise import (
    AbstractNoise,
    Gaussian,
    Independent,
    Matrix,
    Square,
    Vector,
    as_noise,
)

NoiseFunction = Callable[[jax.Array], ArrayLike]  # covariance of w, (n, n), from the input u


@readable
class AbstractPlant(eqx.Module):
    """A system x+ = f(x, u) + w with w independent over time; x_0 has `initial_mean` and `initial_covariance`.

    x_0 is Gaussian unless `deviation` holds the law of x_0 - initial_mean up to a constant.
    """

    noise: eqx.AbstractVar[AbstractNoise | NoiseFunction]
    initial_mean: eqx.AbstractVar[Vector]
    initial_covariance: eqx.AbstractVar[Square]
    deviation: eqx.AbstractVar[AbstractNoise | None]
    states: eqx.AbstractVar[tuple[str, ...]]
    inputs: eqx.AbstractVar[tuple[str, ...]]

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

    Raises:
        ValueError: a transition that does not return a state, covariances that are none, numbers that are not finite.
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

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """f(x, u)."""
        return jnp.asarray(self.function(x, u))


class LinearPlant(AbstractPlant):
    """A linear plant x+ = A x + B u + w; noise and initial law are given as for `Plant`.

    Shapes: matrix (n, n), input_matrix (n, inputs).

    Raises:
        ValueError: wrong shapes, covariances that are none, numbers that are not finite.
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
    ):
        self.initial_mean, self.initial_covariance, self.deviation = _initial(initial_mean, initial_covariance)
        n = self.initial_mean.shape[-1]
        self.matrix = array("plant matrix", matrix, (n, n))
        self.input_matrix = np.zeros((n, 0)) if input_matrix is None else array("input matrix", input_matrix, (n, None))
        self.noise = as_noise("process noise", noise, n)
        self.states = names("state names", states, n, "x")
        self.inputs = names("input names", inputs, self.input_matrix.shape[-1], "u")

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """A x + B u."""
        return jnp.asarray(self.matrix) @ x + jnp.asarray(self.input_matrix) @ u


def with_bias(plant: LinearPlant, coupling: ArrayLike, bias: LinearPlant) -> LinearPlant:
    """The plant driven by a dynamical bias, as one plant of X = [x; b]: x+ = A x + E b + B u + w, b+ = F b + xi.

    The bias is a plant of its own, independent of the first; every filter of the result estimates both. A name that
    the plant has too gets the prefix "bias_".

    Shapes: coupling E (n, bias states).

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
    noises = [p.noise for p in (plant, bias) if isinstance(p.noise, AbstractNoise)]
    if len(noises) < 2:
        raise fail("noise of a plant with bias", "a covariance or a noise law", "a function of the inputs")
    deviations = [p.deviation or Gaussian(p.initial_covariance) for p in (plant, bias)]
    centers = [p.initial_mean - d.mean for p, d in zip((plant, bias), deviations, strict=True)]
    xp = library(plant.matrix, coupling, bias.matrix, centers, plant.input_matrix)
    return LinearPlant(
        xp.block([[plant.matrix, coupling], [np.zeros((extra, n)), bias.matrix]]),
        Independent(noises),
        xp.concatenate(centers),
        Independent(deviations),
        xp.concatenate([plant.input_matrix, np.zeros((extra, len(plant.inputs)))]),
        states=(*plant.states, *(f"bias_{name}" if name in plant.states else name for name in bias.states)),
        inputs=plant.inputs,
    )


def _initial(mean: ArrayLike, spread: AbstractNoise | ArrayLike) -> tuple[Vector, Square, AbstractNoise | None]:
    """Mean, covariance and law of the deviation (None: Gaussian) of an initial state."""
    center = array("initial mean", mean, (None,))
    n = center.shape[-1]
    if not isinstance(spread, AbstractNoise):
        return center, covariance("initial covariance", spread, n), None
    law = as_noise("initial deviation", spread, n)
    return center + law.mean, law.covariance, law


AnyPlant = AbstractPlant | OverTime  # an OverTime holds one plant per step


def check_shape(name: str, called: Callable[..., Any], values: tuple[Any, ...], shape: tuple[int, ...]) -> None:
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
    return instance("plant", first(plant), AbstractPlant, "a plant")
