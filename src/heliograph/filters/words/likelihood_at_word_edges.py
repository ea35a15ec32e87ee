"""What a jump of a likelihood at the edge between two words adds to its sums over a normal number."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ROOT_TWO_PI = np.sqrt(2 * np.pi)
CENTRE = 3.75  # of x = a / root 2, where c is 0
POWERS = (
    1.2375126308378275,
    -0.14024059858554525,
    0.0035854154854790257,
    0.08227673848999506,
    -0.10880393014244462,
    0.09230432116428125,
    -0.05869339857664934,
    0.02836227737211114,
    -0.009746579683265262,
    0.0017556261651970652,
    0.000293714378044958,
    -0.00029015535246077655,
    5.164652974177416e-05,
    2.2387565714911816e-05,
    -1.1438048033346894e-05,
    -9.792625707303523e-07,
    1.7419821586224816e-06,
    -5.084465378687302e-08,
    -2.4857126248016745e-07,
    1.879082322370048e-08,
    3.197926671666804e-08,
    -1.9551358868985616e-09,
    -2.623107347133476e-09,
)  # of (1 + 2 x) e^(x^2) erfc x


class LikelihoodStep(NamedTuple):
    """What a step of a likelihood from 0 to 1 at |t| = a adds to the sums, smoothed by a dither.

    beyond: Q(a) = P(t' > a) of a standard normal t' plus dither; density: -Q'(a); slope: Q''(a), without dither
    a phi(a).
    """

    beyond: jax.Array
    density: jax.Array
    slope: jax.Array


Smooth = Callable[[jax.Array, jax.Array], LikelihoodStep]


def tail_and_density(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return Q(a) = P(t > a) and phi(a) of a >= 0, with one exponential and one reciprocal, to 5e-16 of themselves.

    With x = a / root 2 and c = (x - K) / (x + K), which is between -1 and 1, (1 + 2 x) e^(x^2) erfc x is a polynomial
    in c. POWERS holds its coefficients, from the constant on, and CENTRE is K, 3.75.

    Source: Shepherd and Laframboise, Chebyshev approximation of (1 + 2 x) exp(x^2) erfc x (1981), in powers of c.
    """
    x = a * np.sqrt(0.5)
    gaussian = jnp.exp(-x * x)
    reciprocal = 1 / ((x + CENTRE) * (1 + 2 * x))
    c = (x - CENTRE) * (1 + 2 * x) * reciprocal
    # Horner's rule.
    polynomial = jnp.full_like(a, POWERS[-1])
    for coefficient in POWERS[-2::-1]:
        polynomial = polynomial * c + coefficient
    return polynomial * ((x + CENTRE) * reciprocal) * (gaussian / 2), gaussian * (1 / ROOT_TWO_PI)


def signed_tail_and_density(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return Q(a) and phi(a) of any a."""
    q, density = tail_and_density(jnp.abs(a))
    return jnp.where(a < 0, 1 - q, q), density


def step_without_dither(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return a step without dither: Q, phi and a phi."""
    q, density = tail_and_density(a)
    return LikelihoodStep(q, density, a * density)


def smooth_step_by_uniform(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return a likelihood that rises from 0 to 1 at a, smoothed by a uniform dither of width D.

    t is standard normal, with the tail Q and the density phi. The moments of a smoothed step are differences between
    a - D / 2 and a + D / 2, divided by D, of I(a) = E max(t - a, 0) = phi(a) - a Q(a), of Q and of phi.
    """
    low, high = a - width / 2, a + width / 2
    (q_low, p_low), (q_high, p_high) = (signed_tail_and_density(x) for x in (low, high))
    return LikelihoodStep(
        beyond=(p_low - low * q_low - p_high + high * q_high) / width,
        density=(q_low - q_high) / width,
        slope=(p_low - p_high) / width,
    )


def smooth_step_by_triangle(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return a step by a triangular dither: second differences of E((t - a)+)^2 / 2 = ((1 + a^2) Q - a phi)/2, I, Q."""
    tails, squares, means = [], [], []
    for x in (a - width, a, a + width):
        q, p = signed_tail_and_density(x)
        tails.append(q)
        means.append(p - x * q)  # I(x)
        squares.append(((1 + x * x) * q - x * p) / 2)

    def second_difference(values: list[jax.Array]) -> jax.Array:
        """Return (f(a - D) - 2 f(a) + f(a + D)) / D^2."""
        return (values[0] - 2 * values[1] + values[2]) / width**2

    return LikelihoodStep(
        beyond=second_difference(squares), density=second_difference(means), slope=second_difference(tails)
    )


SMOOTH: dict[str, Smooth] = {
    "none": step_without_dither,
    "subtracted": step_without_dither,
    "stochastic": smooth_step_by_uniform,
    "triangular": smooth_step_by_triangle,
}
ADDED = {"none": 0.0, "subtracted": 0.0, "stochastic": 1 / 12, "triangular": 1 / 6}  # variance of a dither, in D^2
