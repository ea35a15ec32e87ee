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
    """What a likelihood L(t) that steps from 0 to 1 at t = a adds to sums over a standard normal t.

    beyond: E L = Q(a), the normal tail; density: E[t L] = -Q'(a) = phi(a); slope: E[t^2 L] - E L = Q''(a) = a phi(a).
    A dither d that is added to t makes each of them its mean over d, as a function of a.
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
    """Return the normal tail Q(a) = P(t > a) and the density phi(a) of any a, negative ones too: Q(a) = 1 - Q(-a)."""
    q, density = tail_and_density(jnp.abs(a))
    return jnp.where(a < 0, 1 - q, q), density


def step_without_dither(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return Q(a), phi(a) and a phi(a), for a likelihood that steps from 0 to 1 at a >= 0, if there is no dither.

    `width`, that of the dither, is not used: all forms of a step have the same arguments.
    """
    q, density = tail_and_density(a)
    return LikelihoodStep(q, density, a * density)


def smooth_step_by_uniform(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return the means of Q, phi and a phi over a uniform dither of width D about a, for a step of a likelihood at a.

    Q is the normal tail and phi the density. The mean of f over [a - D/2, a + D/2] is (F(a + D/2) - F(a - D/2)) / D
    with F' = f. With E_1(a) = E max(t - a, 0) = phi(a) - a Q(a) for a standard normal t, these are

        Q(a) = -E_1'(a),    phi(a) = -Q'(a),    a phi(a) = -phi'(a)
    """
    low, high = a - width / 2, a + width / 2
    (q_low, p_low), (q_high, p_high) = (signed_tail_and_density(x) for x in (low, high))
    return LikelihoodStep(
        beyond=(p_low - low * q_low - p_high + high * q_high) / width,  # (E_1(low) - E_1(high)) / D
        density=(q_low - q_high) / width,
        slope=(p_low - p_high) / width,
    )


def smooth_step_by_triangle(a: jax.Array, width: jax.Array) -> LikelihoodStep:
    """Return the means of Q, phi and a phi over a triangular dither about a, for a step of a likelihood at a.

    Q is the normal tail and phi the density. The dither, on [-D, D], is a sum of two uniform ones of width D. So the
    mean of f is the second difference (F(a - D) - 2 F(a) + F(a + D)) / D^2 with F'' = f. For a standard normal t,

        E_1(a) = E max(t - a, 0)       = phi(a) - a Q(a)
        E_2(a) = E max(t - a, 0)^2 / 2 = ((1 + a^2) Q(a) - a phi(a)) / 2
        Q(a) = E_2''(a),    phi(a) = E_1''(a),    a phi(a) = Q''(a)
    """
    Q, E_1, E_2 = [], [], []
    for x in (a - width, a, a + width):
        q, p = signed_tail_and_density(x)
        Q.append(q)
        E_1.append(p - x * q)
        E_2.append(((1 + x * x) * q - x * p) / 2)

    def second_difference(values: list[jax.Array]) -> jax.Array:
        """Return (F(a - D) - 2 F(a) + F(a + D)) / D^2, from the three values of F."""
        return (values[0] - 2 * values[1] + values[2]) / width**2

    return LikelihoodStep(beyond=second_difference(E_2), density=second_difference(E_1), slope=second_difference(Q))


SMOOTH: dict[str, Smooth] = {
    "none": step_without_dither,
    "subtracted": step_without_dither,
    "stochastic": smooth_step_by_uniform,
    "triangular": smooth_step_by_triangle,
}
ADDED = {"none": 0.0, "subtracted": 0.0, "stochastic": 1 / 12, "triangular": 1 / 6}  # variance of a dither, in D^2
