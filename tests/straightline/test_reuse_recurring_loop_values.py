"""Numbers of a loop that come back are computed once: the bits are those of a program that computes them in each turn.

That is the same function with runs side by side, in whose loops nothing is kept.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline import compile

RNG = np.random.default_rng(5)
ROWS = 3000
TRANSITION = 0.8 * np.eye(5) + 0.3 * np.eye(5, k=1)
NOISE = np.array([0.2, 0.1, 0.3, 0.1, 0.2])
COMPLETE = RNG.normal(size=(ROWS, 2))


def filtered(rows, noise):
    """A Kalman filter of rows with missing numbers, and a log-likelihood: covariances stand still, or go round."""

    def step(state, z):
        mean, covariance = state
        mean, covariance = TRANSITION @ mean, TRANSITION @ covariance @ TRANSITION.T + jnp.diag(noise)
        logs = 0.0
        for i in range(2):
            there, variance = ~jnp.isnan(z[i]), covariance[i, i] + 0.5
            gain = jnp.where(there, covariance[:, i] / variance, 0.0)
            rest = jnp.where(there, z[i] - mean[i], 0.0)
            logs = logs - jnp.where(there, jnp.log(variance) + rest**2 / variance, 0.0)
            mean, covariance = mean + gain * rest, covariance - variance * jnp.outer(gain, gain)
        return (mean, covariance), (mean, covariance, logs)

    return jax.lax.scan(step, (jnp.zeros(5), jnp.eye(5)), rows)


def counted(length):
    """Sums of a polynomial of a number that counts to `length`, and of rows."""

    def function(rows, noise):
        def step(carry, z):
            number, total = carry
            value = jnp.float64(0.0)
            for k in range(150):
                value = (value + k) * jnp.cos(number * 0.1) * noise[0]
            following = number + 1
            return (jnp.where(following == length, 0, following), total + value * z[0]), value

        return jax.lax.scan(step, (jnp.int64(0), jnp.float64(0.0)), rows)

    return function


def turned(rows, noise):
    """A zero whose sign changes in each turn, and what tells the sign."""

    def step(x, z):
        value = jnp.arctan2(x, -1.0)
        for k in range(60):
            value = jnp.sin(value + k) + noise[0] * value
        return -x, (jnp.arctan2(x, -1.0), value, z[0] * value)

    return jax.lax.scan(step, jnp.float64(0.0), rows)


def judged(rows, noise):
    """A variance that grows where a number is missing; a second test is of a number that follows from the first."""

    def step(variance, z):
        weight = jnp.where(jnp.isnan(z[0]), 0.0, 1.0)
        counts = jnp.abs(weight) <= noise[0] + 0.5
        for k in range(40):
            variance = (
                variance - weight * variance**2 / (variance + 1.0) / 40 + jnp.where(counts, 0.1, noise[1]) / (k + 1)
            )
        return variance, (variance, weight * z[1])

    return jax.lax.scan(step, jnp.float64(1.0), rows)


def nested(rows, noise):
    """Filters of parts of the rows in a loop that carries what grows, as a variance does."""

    def part(size, some):
        (mean, _), (_, _, logs) = filtered(some, noise * size)
        return size + 0.5, (mean, jnp.sum(logs))

    return jax.lax.scan(part, 1.0, rows.reshape(30, -1, 2))


def missing(share):
    return np.where(RNG.random((ROWS, 2)) < share, np.nan, COMPLETE)


def pattern(period):
    rows = COMPLETE.copy()
    rows[np.arange(ROWS) % period != 0, 1] = np.nan
    return rows


OUTAGES = COMPLETE.copy()
OUTAGES[1000:1100] = OUTAGES[1110:1111] = OUTAGES[2000:2400, 1] = np.nan


@pytest.mark.parametrize(
    ("function", "rows"),
    [
        *((filtered, rows) for rows in (COMPLETE, OUTAGES, missing(0.05), missing(0.5), pattern(4), pattern(50))),
        (counted(5), COMPLETE),
        (counted(32), COMPLETE),
        (counted(33), COMPLETE),
        (turned, COMPLETE),
        (judged, COMPLETE),
        (judged, OUTAGES),
        (nested, OUTAGES),
    ],
)
def test_the_bits_are_those_of_computing_all(function, rows):
    with jax.enable_x64(True):
        kept = compile(function, rows, NOISE, shared=[0, 1])(rows, NOISE)
        anew = compile(function, rows, NOISE)(np.stack([rows, rows]), np.stack([NOISE, NOISE]))
    for a, b in zip(jax.tree.leaves(kept), jax.tree.leaves(anew), strict=True):
        np.testing.assert_array_equal(a[0].view(np.int64), b[1].view(np.int64))
