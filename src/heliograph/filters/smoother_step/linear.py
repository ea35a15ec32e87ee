"""Smoother step of a linear update, by the adjoint (Bryson and Frazier) form."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.filters.smoother_step.base import AbstractSmootherStep, Moments, Point, applied, less
from heliograph.numerics.over_runs import Pick, runs_last, where_any, where_each
from heliograph.numerics.small_matrix import (
    congruence,
    diagonal_of,
    root,
    solve,
    sum_of_squares,
    summed,
    symmetric,
    times,
    times_vector,
    transpose,
    with_rounding,
)
from heliograph.numerics.types import Float

SHARP = 1e-3  # of the filter's variance: below it P - P Lambda P leaves fewer digits than a sum of squares


class Adjoint(NamedTuple):
    """Adjoint of the state after a step: given later data it has mean x - P vector and covariance P - P matrix P."""

    vector: Float[jax.Array, "*time N"]
    matrix: Float[jax.Array, "*time N N"]


class LinearSmootherStep(AbstractSmootherStep):
    """A linear update: y- = A y + ..., y = y- + K e, e = z - H y- - ..., K = P- H' S^-1, nothing else inverted.

    transition A, process Q (None: not separately known), gain K, output H, weigh H' S^-1, innovation e; zero for what
    did not arrive. With B = I - K H, lambda- = B' lambda - H' S^-1 e and Lambda- = B' Lambda B + H' S^-1 H, then both
    through A'.

    Source: Bryson and Frazier, Smoothing for linear and nonlinear dynamic systems (1963).
    """

    transition: Float[jax.Array, "*time N N"]
    process: Float[jax.Array, "*time N N"] | None
    gain: Float[jax.Array, "*time N m"]
    output: Float[jax.Array, "*time m N"]
    weigh: Float[jax.Array, "*time N m"]
    innovation: Float[jax.Array, "*time m"]

    def end(self) -> Adjoint:
        """Adjoint of zero: there are no later data."""
        return Adjoint(jnp.zeros_like(self.mean), jnp.zeros_like(self.covariance))

    def back(self, later: Adjoint, mean: jax.Array, covariance: jax.Array) -> Adjoint:
        """Pass back through the update, then through the transition."""
        vector = _vector_back(later.vector, self.transition, self.gain, self.output, self.weigh, self.innovation)
        return Adjoint(vector, _matrix_back(later.matrix, self.transition, self.gain, self.output, self.weigh))

    def smoothed(self, later: Adjoint) -> Moments:
        """x - P lambda and P - P Lambda P."""
        return Moments(
            self.mean - applied(self.covariance, later.vector), less(self.covariance, self.covariance, later.matrix)
        )

    def ahead(self, point: Point) -> Point:
        """Pi- = Pi A', g = Pi- H' S^-1: x_j + g e, P_j - g H Pi-', and Pi = Pi- B'; Pi is Cov(y_j, y)."""
        return Point(*_point_ahead(*point, self.transition, self.gain, self.output, self.weigh, self.innovation))

    def before(self, item: AbstractSmootherStep, earlier: Adjoint, known: Moments) -> Moments:
        """P_s = (I - J A) P (I - J A)' + J (Q + P_s+) J', J = P A' (P-)^+, where P - P Lambda P cancels.

        A sum of squares, by Rauch, Tung and Striebel with P - J P- J' in Joseph's form; it needs one more inverse.
        """
        if self.process is None:
            return item.smoothed(earlier)
        given = item.covariance, earlier.matrix, self.transition, self.process, known.covariance
        return Moments(item.mean - applied(item.covariance, earlier.vector), _left(*given))

    def without_data(self) -> AbstractSmootherStep:
        """Return the step without mean and innovation."""
        mean, innovation = jnp.zeros_like(self.mean), jnp.zeros_like(self.innovation)
        return replace(self, mean=mean, innovation=innovation, shift=None, nis=None, received=None)

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> AbstractSmootherStep:
        """Return the step with this mean and innovation."""
        return replace(self, mean=mean, innovation=innovation)

    def _link(self, n: int) -> jax.Array:
        return self.covariance


@runs_last
def _vector_back(
    vector: jax.Array,
    transition: jax.Array,
    gain: jax.Array,
    output: jax.Array,
    weigh: jax.Array,
    innovation: jax.Array,
) -> jax.Array:
    stored = vector - times_vector(transpose(output), times_vector(transpose(gain), vector))
    return times_vector(transpose(transition), stored - times_vector(weigh, innovation))


@runs_last
def _matrix_back(
    matrix: jax.Array, transition: jax.Array, gain: jax.Array, output: jax.Array, weigh: jax.Array
) -> jax.Array:
    half = matrix - times(times(matrix, gain), output)
    stored = half - times(transpose(output), times(transpose(gain), half)) + times(weigh, output)
    return symmetric(congruence(transpose(transition), stored))


@runs_last
def _point_ahead(
    mean: jax.Array,
    covariance: jax.Array,
    link: jax.Array,
    transition: jax.Array,
    gain: jax.Array,
    output: jax.Array,
    weigh: jax.Array,
    innovation: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    moved = times(link, transpose(transition))
    news = times(moved, weigh)
    received = times(output, transpose(moved))
    after = symmetric(with_rounding(covariance, len(covariance)) - times(news, received))
    return mean + times_vector(news, innovation), after, moved - times(transpose(received), transpose(gain))


def _left_by(
    pick: Pick, p: jax.Array, matrix: jax.Array, transition: jax.Array, process: jax.Array, later: jax.Array
) -> jax.Array:
    half = times(p, matrix)
    sharp = jnp.any(diagonal_of(p) - summed(half * p, 1) < SHARP * diagonal_of(p), axis=0)

    def squares() -> jax.Array:
        moved = times(transition, p)
        back = transpose(solve(times(moved, transpose(transition)) + process, moved))
        return sum_of_squares(p, root(p), back, transition, process + later)

    return pick(sharp, squares, lambda: symmetric(with_rounding(p, len(p)) - times(half, p)))


_left = runs_last(partial(_left_by, where_any), partial(_left_by, where_each))
