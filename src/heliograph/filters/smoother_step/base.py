"""Smoother step of a filter: what the backward pass needs of a forward step.

A pass starts at the last step with `end`, goes back over each step with `back`, and reads the estimates given all data
with `estimate_from`; `ahead` carries one earlier state forward instead.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.numerics.angle import Angles, wrapped
from heliograph.numerics.linalg import (
    congruence,
    diagonal_of,
    root,
    solve,
    spread_of,
    sum_of_squares,
    summed,
    symmetric,
    times,
    times_vector,
    transpose,
    with_rounding,
)
from heliograph.numerics.module import Module, unwritten
from heliograph.numerics.over_runs import Pick, runs_last, where_any, where_each
from heliograph.numerics.types import ArrayLike, Bool, Float, Int, PyTree


class Moments(NamedTuple):
    """Mean (N,) and covariance (N, N) of the state after a step, given later data too."""

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]


class Point(NamedTuple):
    """Mean and covariance of an earlier state x_j given the data so far, and how it goes with the state y now.

    By x_j = link y + d, apart = Cov d, and by cross = Cov(x_j, y). precise: whether some update since j was.
    """

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    link: Float[jax.Array, "N N"]
    apart: Float[jax.Array, "N N"]
    cross: Float[jax.Array, "N N"]
    precise: Bool[jax.Array, ""]


class StepTrace(NamedTuple):
    """States of a filter around step k: `before` it, `prior` after the prediction, `after` the correction with z.

    Also the innovation of the correction, the measurement z (received,) and the input u (inputs,).
    """

    before: PyTree
    prior: PyTree
    after: PyTree
    innovation: Innovation
    z: ArrayLike
    u: ArrayLike
    k: int | np.integer | Int[jax.Array, ""]


class AbstractSmootherStep(Module):
    """Smoother step: the estimate after a step, of the filter's state of N numbers, and what a backward pass needs.

    The plant's state is projection y + shift of the filter's state y, y itself without them. Stacked along time, and
    over runs, it describes a whole run of a filter.

    claim: of estimates given later data too. angles: which of the plant's states are wrapped to between -pi and pi in
    estimates; a backward pass never wraps them. nis: e' S^-1 e of the step's innovation, with mean `received`, the
    number of components that arrived.

    prior_mean, prior_covariance: of the state before the correction.

    Shapes: mean (N,), covariance (N, N), projection (n, N), shift (n,).
    """

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]
    prior_mean: Float[jax.Array, "*time N"]
    prior_covariance: Float[jax.Array, "*time N N"]
    projection: Float[jax.Array, "*time n N"] | None = eqx.field(default=None, kw_only=True)
    shift: Float[jax.Array, "*time n"] | None = eqx.field(default=None, kw_only=True)
    nis: Float[jax.Array, "*time"] | None = eqx.field(default=None, kw_only=True)
    received: Float[jax.Array, "*time"] | None = eqx.field(default=None, kw_only=True)
    claim: Claim = eqx.field(static=True, kw_only=True)
    angles: Angles = eqx.field(static=True, default=(), kw_only=True)

    def end(self) -> PyTree:
        """Start a backward pass at this step, the last."""
        raise unwritten(self, "end")

    def back(self, later: PyTree, mean: jax.Array, covariance: jax.Array) -> PyTree:
        """Pass from after this step to before it, where the filter had this mean and covariance."""
        raise unwritten(self, "back")

    def smoothed(self, later: PyTree) -> Moments:
        """Return the filter's state after this step, given later data."""
        raise unwritten(self, "smoothed")

    def ahead(self, point: Point, covariance: jax.Array) -> Point:
        """Return an earlier state given this step's data too; the filter had this covariance before the step."""
        raise unwritten(self, "ahead")

    def before(self, previous: "AbstractSmootherStep", earlier: PyTree, known: Moments) -> Moments:
        """Return the state after step `previous`, the one before this, given all later data.

        `earlier` is the result of `back`; `known` is the state after this step given the same data.
        """
        return previous.smoothed(earlier)

    def start(self) -> Point:
        """Return the state after this step as a point to be carried ahead."""
        unit = jnp.broadcast_to(jnp.eye(self.mean.shape[-1]), self.covariance.shape)
        nothing = jnp.zeros_like(self.covariance)
        return Point(self.mean, self.covariance, unit, nothing, self.covariance, jnp.asarray(False))

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> Self:
        """Return the same step with other data of the same arrivals: other means and innovation."""
        return replace(self, mean=mean, prior_mean=prior_mean)

    def estimate_from(self, moments: Moments | Point) -> Estimate:
        """Estimate of the plant's state from the filter's."""
        mean, covariance = moments.mean, moments.covariance
        if self.projection is not None:
            mean, covariance = applied(self.projection, mean), _congruence(self.projection, covariance)
        mean = mean if self.shift is None else mean + self.shift
        return Estimate(wrapped(mean, self.angles), covariance, self.claim)


@runs_last
def less(p: jax.Array, factor: jax.Array, middle: jax.Array) -> jax.Array:
    """P - F M F', accurate to rounding of P alone, which is added."""
    return symmetric(with_rounding(p, len(p)) - congruence(factor, middle))


@runs_last
def applied(a: jax.Array, x: jax.Array) -> jax.Array:
    """A x."""
    return times_vector(a, x)


@runs_last
def _congruence(a: jax.Array, p: jax.Array) -> jax.Array:
    return congruence(a, p)


SHARP = 1e-3  # of the filter's variance: below it P - P Lambda P leaves fewer digits than a sum of squares


class Adjoint(NamedTuple):
    """Adjoint of the state after a step: given later data it has mean x - P vector and covariance P - P matrix P.

    precise: whether some later update was. That divides innovations by a variance S far below P, and what earlier steps
    are to take off again leaves P eps / S of an adjoint, which is no number where S is the rounding of a known state.
    """

    vector: Float[jax.Array, "*time N"]
    matrix: Float[jax.Array, "*time N N"]
    precise: Bool[jax.Array, "*time"]


class LinearSmootherStep(AbstractSmootherStep):
    """A linear update: y- = A y + ..., y = y- + K e, e = z - H y- - ..., K = P- H' S^-1, nothing else inverted.

    Moments before the correction, transition A, process Q (with the rounding of y), gain K, output H, weigh H' S^-1,
    innovation e; zero for what did not arrive. With B = I - K H, lambda- = B' lambda - H' S^-1 e and
    Lambda- = B' Lambda B + H' S^-1 H, then both through A'.

    precise: whether the noise of z is far below S. From such an update back, states are smoothed as Rauch, Tung and
    Striebel do, by J = P A' (P-)^+, which divides no innovation. To such a J rounding is noise of the process: without
    it a Q of zero says that y+ = A y to the last digit, J goes to A^-1, and that takes rounding for news.

    Source: Bryson and Frazier, Smoothing for linear and nonlinear dynamic systems (1963).
    """

    precise: Bool[jax.Array, "*time"]
    transition: Float[jax.Array, "*time N N"]
    process: Float[jax.Array, "*time N N"]
    gain: Float[jax.Array, "*time N m"]
    output: Float[jax.Array, "*time m N"]
    weigh: Float[jax.Array, "*time N m"]
    innovation: Float[jax.Array, "*time m"]

    def end(self) -> Adjoint:
        """Adjoint of zero: there are no later data."""
        return Adjoint(jnp.zeros_like(self.mean), jnp.zeros_like(self.covariance), jnp.zeros_like(self.precise))

    def back(self, later: Adjoint, mean: jax.Array, covariance: jax.Array) -> Adjoint:
        """Pass back through the update, then through the transition."""
        vector = _vector_back(later.vector, self.transition, self.gain, self.output, self.weigh, self.innovation)
        matrix = _matrix_back(later.matrix, self.transition, self.gain, self.output, self.weigh)
        return Adjoint(vector, matrix, later.precise | self.precise)

    def smoothed(self, later: Adjoint) -> Moments:
        """x - P lambda and P - P Lambda P."""
        return Moments(
            self.mean - applied(self.covariance, later.vector), less(self.covariance, self.covariance, later.matrix)
        )

    def ahead(self, point: Point, covariance: jax.Array) -> Point:
        """Update by g = Pi- H' S^-1, Pi- = Pi A': x_j + g e, P_j - g H Pi-', and Pi = Pi- B'; Pi is Cov(y_j, y).

        From a precise update on x_j + M (y - y-) and P_j = D + M P M', with M the product of all J since j and D the
        covariance of x_j - M y, to which a step adds M ((I - J A) P (I - J A)' + J Q J') M': all are squares.

        Source: Rauch, Solutions to the linear smoothing problem (1963).
        """
        link, apart = _point_moved(point.link, point.apart, covariance, self.transition, self.process)
        news = self.mean - self.prior_mean
        squares = _point_from(point.mean, link, apart, news, self.covariance)
        step = self.transition, self.gain, self.output, self.weigh, self.innovation
        *adjoint, cross = _point_ahead(point.mean, point.covariance, point.cross, *step)
        precise = point.precise | self.precise
        mean, after = (jnp.where(precise, a, b) for a, b in zip(squares, adjoint, strict=True))
        return Point(mean, after, link, apart, cross, precise)

    def before(self, previous: AbstractSmootherStep, earlier: Adjoint, known: Moments) -> Moments:
        """Smooth by the adjoint or, where that has lost its digits, by J = P A' (P-)^+.

        x + J (x_s+ - x-) and P_s = (I - J A) P (I - J A)' + J (Q + P_s+) J', a sum of squares by Rauch, Tung and
        Striebel with P - J P- J' in Joseph's form; it needs one more inverse.
        """
        step = previous.covariance, self.transition, self.process, earlier.precise
        mean = _mean_before(previous.mean, earlier.vector, known.mean - self.prior_mean, *step)
        return Moments(mean, _left(earlier.matrix, known.covariance, *step))

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> Self:
        """Return the step with these means and innovation."""
        return replace(self, mean=mean, prior_mean=prior_mean, innovation=innovation)


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
    cross: jax.Array,
    transition: jax.Array,
    gain: jax.Array,
    output: jax.Array,
    weigh: jax.Array,
    innovation: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    moved = times(cross, transpose(transition))
    news = times(moved, weigh)
    received = times(output, transpose(moved))
    after = symmetric(with_rounding(covariance, len(covariance)) - times(news, received))
    return mean + times_vector(news, innovation), after, moved - times(transpose(received), transpose(gain))


@runs_last
def _point_moved(
    link: jax.Array, apart: jax.Array, p: jax.Array, transition: jax.Array, process: jax.Array
) -> tuple[jax.Array, jax.Array]:
    moved = times(link, _smoother_gain(p, transition, process))
    left = link - times(moved, transition)
    return moved, apart + spread_of(left, p) + spread_of(moved, process)


@runs_last
def _point_from(
    mean: jax.Array, link: jax.Array, apart: jax.Array, news: jax.Array, posterior: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return mean + times_vector(link, news), symmetric(apart + spread_of(link, posterior))


def _smoother_gain(p: jax.Array, transition: jax.Array, process: jax.Array) -> jax.Array:
    """J = P A' (P-)^+ with P- = A P A' + Q."""
    moved = times(transition, p)
    prior = symmetric(times(moved, transpose(transition)) + process)
    return transpose(solve(prior, moved))


def _mean_before_by(
    pick: Pick,
    mean: jax.Array,
    vector: jax.Array,
    news: jax.Array,
    p: jax.Array,
    transition: jax.Array,
    process: jax.Array,
    precise: jax.Array,
) -> jax.Array:
    return pick(
        precise,
        lambda: mean + times_vector(_smoother_gain(p, transition, process), news),
        lambda: mean - times_vector(p, vector),
    )


_mean_before = runs_last(partial(_mean_before_by, where_any), partial(_mean_before_by, where_each))


def _left_by(
    pick: Pick,
    matrix: jax.Array,
    later: jax.Array,
    p: jax.Array,
    transition: jax.Array,
    process: jax.Array,
    precise: jax.Array,
) -> jax.Array:
    half = times(p, matrix)
    sharp = jnp.any(diagonal_of(p) - summed(half * p, 1) < SHARP * diagonal_of(p), axis=0)
    return pick(
        sharp | precise,
        lambda: sum_of_squares(p, root(p), _smoother_gain(p, transition, process), transition, process + later),
        lambda: symmetric(with_rounding(p, len(p)) - times(half, p)),
    )


_left = runs_last(partial(_left_by, where_any), partial(_left_by, where_each))
