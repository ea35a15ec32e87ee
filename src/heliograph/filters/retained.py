"""What a filter's step leaves behind for a sweep back, and how what later data say passes back over it.

A sweep starts at the last step with `end`, passes each step with `back`, and reads the estimates given all data with
`told`; `ahead` carries one earlier state forward instead.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.angle import Angles, wrapped
from heliograph.numerics.small_matrix import (
    Pick,
    congruence,
    inner,
    runs_last,
    sum_of_squares,
    symmetric,
    times,
    times_vector,
    transpose,
    where_any,
    where_each,
    with_rounding,
)
from heliograph.numerics.small_matrix import solve as small_solve
from heliograph.numerics.types import Float, PyTree

SHARP = 1e-3  # of the filter's variance: below it P - P Lambda P leaves fewer digits than a sum of squares


class Adjoint(NamedTuple):
    """What later data say of the state after a step: given them it is x - P vector, of covariance P - P matrix P."""

    vector: Float[jax.Array, "*time N"]
    matrix: Float[jax.Array, "*time N N"]


class Moments(NamedTuple):
    """Mean (N,) and covariance (N, N) of the state after a step, given later data too."""

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]


class Point(NamedTuple):
    """An earlier state x_j given the data so far: mean and covariance; `link` tells how news of x now reach it."""

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    link: Float[jax.Array, "N N"]


class AbstractRetained(eqx.Module):
    """A step as a sweep back needs it: the estimate after it, of the filter's own state of N numbers.

    The plant's state is want y + shift of the filter's state y, y itself without them. claim: of estimates given later
    data too. Stacked along time, and over runs, it is what a filter leaves of a whole run. angles: which of the plant's
    states are told between -pi and pi; a sweep never wraps them. surprise: e' S^-1 e of the
    step's innovation, expected to be `heard`, the number of components that arrived.

    Shapes: mean (N,), covariance (N, N), want (n, N), shift (n,).
    """

    mean: eqx.AbstractVar[Float[jax.Array, "*time N"]]
    covariance: eqx.AbstractVar[Float[jax.Array, "*time N N"]]
    want: eqx.AbstractVar[Float[jax.Array, "*time n N"] | None]
    shift: eqx.AbstractVar[Float[jax.Array, "*time n"] | None]
    surprise: eqx.AbstractVar[Float[jax.Array, "*time"] | None]
    heard: eqx.AbstractVar[Float[jax.Array, "*time"] | None]
    claim: eqx.AbstractVar[Claim]
    angles: eqx.AbstractVar[Angles]

    def end(self) -> PyTree:
        """At this step, if it is the last."""
        raise NotImplementedError

    def back(self, later: PyTree, mean: jax.Array, covariance: jax.Array) -> PyTree:
        """From after this step to before it, where the filter had this mean and covariance."""
        raise NotImplementedError

    def smoothed(self, later: PyTree) -> Moments:
        """The filter's state after this step, given later data."""
        raise NotImplementedError

    def ahead(self, point: Point) -> Point:
        """An earlier state given this step's data too."""
        raise NotImplementedError

    def before(self, one: "AbstractRetained", earlier: PyTree, known: Moments) -> Moments:
        """The state after step `one`, the one before this, given all later data.

        `earlier` is what `back` makes of them; `known` is the state after this step given the same.
        """
        return one.smoothed(earlier)

    def start(self) -> Point:
        """The state after this step as one to be carried ahead."""
        n = self.mean.shape[-1]
        return Point(self.mean, self.covariance, self._link(n))

    def without_data(self) -> "AbstractRetained":
        """The same step without what only means depend on."""
        raise NotImplementedError

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> "AbstractRetained":
        """The same step of other data that arrived in the same places: only means and innovation are others."""
        raise NotImplementedError

    def _link(self, n: int) -> jax.Array:
        raise NotImplementedError

    def told(self, found: Moments | Point) -> Estimate:
        """The plant's state from the filter's."""
        mean, covariance = found.mean, found.covariance
        if self.want is not None:
            mean, covariance = _product(self.want, mean), _congruence(self.want, covariance)
        mean = mean if self.shift is None else mean + self.shift
        return Estimate(wrapped(mean, self.angles), covariance, self.claim)


class RetainedLinear(AbstractRetained):
    """A linear update: y- = A y + ..., y = y- + K e, e = z - H y- - ..., K = P- H' S^-1, nothing else inverted.

    transition A, process Q (None: not known apart), gain K, output H, weigh H' S^-1, innovation e; of what did not
    arrive nothing. With B = I - K H, lambda- = B' lambda - H' S^-1 e and Lambda- = B' Lambda B + H' S^-1 H, then both
    through A'.

    Source: Bryson and Frazier, Smoothing for linear and nonlinear dynamic systems (1963).
    """

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]
    transition: Float[jax.Array, "*time N N"]
    process: Float[jax.Array, "*time N N"] | None
    gain: Float[jax.Array, "*time N m"]
    output: Float[jax.Array, "*time m N"]
    weigh: Float[jax.Array, "*time N m"]
    innovation: Float[jax.Array, "*time m"]
    claim: Claim = eqx.field(static=True)
    want: Float[jax.Array, "*time n N"] | None
    shift: Float[jax.Array, "*time n"] | None
    surprise: Float[jax.Array, "*time"] | None
    heard: Float[jax.Array, "*time"] | None
    angles: Angles = eqx.field(static=True)

    def end(self) -> Adjoint:
        """Nothing is later."""
        return Adjoint(jnp.zeros_like(self.mean), jnp.zeros_like(self.covariance))

    def back(self, later: Adjoint, mean: jax.Array, covariance: jax.Array) -> Adjoint:
        """Through the update, then through the transition."""
        vector = _vector_back(later.vector, self.transition, self.gain, self.output, self.weigh, self.innovation)
        return Adjoint(vector, _matrix_back(later.matrix, self.transition, self.gain, self.output, self.weigh))

    def smoothed(self, later: Adjoint) -> Moments:
        """x - P lambda and P - P Lambda P."""
        return Moments(
            self.mean - _product(self.covariance, later.vector), _less(self.covariance, self.covariance, later.matrix)
        )

    def ahead(self, point: Point) -> Point:
        """Pi- = Pi A', g = Pi- H' S^-1: x_j + g e, P_j - g H Pi-', and Pi = Pi- B'; Pi is Cov(y_j, y)."""
        return Point(*_point_ahead(*point, self.transition, self.gain, self.output, self.weigh, self.innovation))

    def before(self, one: AbstractRetained, earlier: Adjoint, known: Moments) -> Moments:
        """P_s = (I - J A) P (I - J A)' + J (Q + P_s+) J', J = P A' (P-)^+, where P - P Lambda P loses its digits.

        A sum of squares, by Rauch, Tung and Striebel with P - J P- J' in Joseph's form; one inverse more.
        """
        if self.process is None:
            return one.smoothed(earlier)
        given = one.covariance, earlier.matrix, self.transition, self.process, known.covariance
        return Moments(one.mean - _product(one.covariance, earlier.vector), _left(*given))

    def without_data(self) -> AbstractRetained:
        """Without mean and innovation."""
        mean, innovation = jnp.zeros_like(self.mean), jnp.zeros_like(self.innovation)
        return replace(self, mean=mean, innovation=innovation, shift=None, surprise=None, heard=None)

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> AbstractRetained:
        """Mean and innovation."""
        return replace(self, mean=mean, innovation=innovation)

    def _link(self, n: int) -> jax.Array:
        return self.covariance


class RetainedMoments(AbstractRetained):
    """Any update: mean and covariance before it too, and cross = Cov(y before the step, y after its prediction).

    J = cross (P-)^+: y_s = y + J (y_s+ - y-), P_s = P + J (P_s+ - P-) J'. Exact where the covariances are.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]
    prior_mean: Float[jax.Array, "*time N"]
    prior_covariance: Float[jax.Array, "*time N N"]
    cross: Float[jax.Array, "*time N N"]
    claim: Claim = eqx.field(static=True)
    want: Float[jax.Array, "*time n N"] | None
    shift: Float[jax.Array, "*time n"] | None
    surprise: Float[jax.Array, "*time"] | None
    heard: Float[jax.Array, "*time"] | None
    angles: Angles = eqx.field(static=True)

    def end(self) -> Moments:
        """The filter's own."""
        return Moments(self.mean, self.covariance)

    def back(self, later: Moments, mean: jax.Array, covariance: jax.Array) -> Moments:
        """What was not expected of the state after the step, through J."""
        gain = self._gain()
        news = _product(gain, later.mean - self.prior_mean)
        return Moments(mean + news, _less(covariance, gain, self.prior_covariance - later.covariance))

    def smoothed(self, later: Moments) -> Moments:
        """As it is."""
        return later

    def ahead(self, point: Point) -> Point:
        """x_j + M (y - y-) and P_j - M (P- - P) M', M the product of all J since j."""
        gain = _product_of(point.link, self._gain())
        news = _product(gain, self.mean - self.prior_mean)
        return Point(point.mean + news, _less(point.covariance, gain, self.prior_covariance - self.covariance), gain)

    def without_data(self) -> AbstractRetained:
        """Without both means."""
        none = jnp.zeros_like(self.mean)
        return replace(self, mean=none, prior_mean=none, shift=None, surprise=None, heard=None)

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> AbstractRetained:
        """Both means."""
        return replace(self, mean=mean, prior_mean=prior_mean)

    def _link(self, n: int) -> jax.Array:
        return jnp.broadcast_to(jnp.eye(n), self.covariance.shape)

    def _gain(self) -> jax.Array:
        return _solved(self.prior_covariance, self.cross)


@runs_last
def _vector_back(
    vector: jax.Array,
    transition: jax.Array,
    gain: jax.Array,
    output: jax.Array,
    weigh: jax.Array,
    innovation: jax.Array,
) -> jax.Array:
    kept = vector - times_vector(transpose(output), times_vector(transpose(gain), vector))
    return times_vector(transpose(transition), kept - times_vector(weigh, innovation))


@runs_last
def _matrix_back(
    matrix: jax.Array, transition: jax.Array, gain: jax.Array, output: jax.Array, weigh: jax.Array
) -> jax.Array:
    half = matrix - times(times(matrix, gain), output)
    kept = half - times(transpose(output), times(transpose(gain), half)) + times(weigh, output)
    return symmetric(congruence(transpose(transition), kept))


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
    heard = times(output, transpose(moved))
    after = symmetric(with_rounding(covariance, len(covariance)) - times(news, heard))
    return mean + times_vector(news, innovation), after, moved - times(transpose(heard), transpose(gain))


@runs_last
def _less(p: jax.Array, factor: jax.Array, middle: jax.Array) -> jax.Array:
    """P - F M F', known to rounding of P alone, which is added."""
    return symmetric(with_rounding(p, len(p)) - congruence(factor, middle))


def _left_by(
    pick: Pick, p: jax.Array, matrix: jax.Array, transition: jax.Array, process: jax.Array, later: jax.Array
) -> jax.Array:
    half = times(p, matrix)
    own = [p[i, i] - inner(half[i : i + 1], p[i : i + 1]) < SHARP * p[i, i] for i in range(len(p))]

    def squares() -> jax.Array:
        moved = times(transition, p)
        back = transpose(small_solve(times(moved, transpose(transition)) + process, moved))
        return sum_of_squares(p, back, transition, process + later)

    return pick(jnp.any(jnp.stack(own), axis=0), squares, lambda: symmetric(with_rounding(p, len(p)) - times(half, p)))


_left = runs_last(partial(_left_by, where_any), partial(_left_by, where_each))


@runs_last
def _solved(a: jax.Array, b: jax.Array) -> jax.Array:
    """B A^+."""
    return transpose(small_solve(a, transpose(b)))


@runs_last
def _product(a: jax.Array, x: jax.Array) -> jax.Array:
    return times_vector(a, x)


@runs_last
def _product_of(a: jax.Array, b: jax.Array) -> jax.Array:
    return times(a, b)


@runs_last
def _congruence(a: jax.Array, p: jax.Array) -> jax.Array:
    return congruence(a, p)
