"""Construction of smoother steps around a correction: linear ones by its innovation, others by moments."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import jax
import jax.numpy as jnp

from heliograph.filters.plausibility import innovation_distance
from heliograph.filters.smoother_step.base import (
    AbstractSmootherStep,
    LinearSmootherStep,
    Moments,
    Point,
    StepTrace,
    applied,
    less,
)
from heliograph.model.estimate import Claim, Innovation
from heliograph.numerics.angle import Angles
from heliograph.numerics.linalg import (
    PRECISE,
    congruence,
    diagonal,
    diagonal_of,
    pivots,
    rounding,
    solve,
    times,
    transpose,
)
from heliograph.numerics.linalg import solve as small_solve
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.types import Array, Float


class MomentsSmootherStep(AbstractSmootherStep):
    """Any update: prior mean and covariance too, and cross = Cov(y before the step, y after its prediction).

    J = cross (P-)^+: y_s = y + J (y_s+ - y-), P_s = P + J (P_s+ - P-) J'. Exact where the covariances are.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """

    cross: Float[jax.Array, "*time N N"]

    def end(self) -> Moments:
        """Moments of the filter at the last step."""
        return Moments(self.mean, self.covariance)

    def back(self, later: Moments, mean: jax.Array, covariance: jax.Array) -> Moments:
        """Pass back through J: y + J (y_s+ - y-), P + J (P_s+ - P-) J'."""
        gain = self._gain()
        news = applied(gain, later.mean - self.prior_mean)
        return Moments(mean + news, less(covariance, gain, self.prior_covariance - later.covariance))

    def smoothed(self, later: Moments) -> Moments:
        """Return the moments as they are."""
        return later

    def ahead(self, point: Point, covariance: jax.Array) -> Point:
        """x_j + M (y - y-) and P_j - M (P- - P) M', M the product of all J since j."""
        gain = _product_of(point.link, self._gain())
        news = applied(gain, self.mean - self.prior_mean)
        after = less(point.covariance, gain, self.prior_covariance - self.covariance)
        return point._replace(mean=point.mean + news, covariance=after, link=gain)

    def _gain(self) -> jax.Array:
        return _solved(self.prior_covariance, self.cross)


@runs_last
def _solved(a: jax.Array, b: jax.Array) -> jax.Array:
    """B A^+."""
    return transpose(solve(a, transpose(b)))


@runs_last
def _product_of(a: jax.Array, b: jax.Array) -> jax.Array:
    return times(a, b)


def with_nis(step: AbstractSmootherStep, innovation: Innovation) -> AbstractSmootherStep:
    """Return the step with the normalised innovation squared, e' S^-1 e."""
    nis, count = innovation_distance(innovation)
    return replace(step, nis=nis, received=count)


class HasMoments(Protocol):
    """A state of a filter with a mean (N,) and a covariance (N, N)."""

    @property
    def mean(self) -> Float[jax.Array, " N"]:
        """Mean of the state."""

    @property
    def covariance(self) -> Float[Array, "N N"]:
        """Covariance of the state."""


def moments_smoother_step(
    after: HasMoments, prior: HasMoments, cross: Array, claim: Claim, angles: Angles = ()
) -> MomentsSmootherStep:
    """Build the step from the states after and before a correction, and Cov(x before the step, x predicted)."""
    moments = after.mean, after.covariance, prior.mean, prior.covariance, cross
    return MomentsSmootherStep(*map(jnp.asarray, moments), claim=claim, angles=angles)


def linear_smoother_step(
    step: StepTrace,
    model: tuple[Array, Array, Array],
    rounded: Array,
    claim: Claim,
    projection: Array | None = None,
    solve: Callable[[jax.Array, jax.Array], jax.Array] | None = None,
) -> LinearSmootherStep:
    """Build the step from the states around a correction, its innovation e and S, and A, Q and H of the `model`.

    `rounded`: variance of each component of a mean by rounding alone (N,), a part of the process.
    Rows of what did not arrive are left out: e is NaN there. `solve` gives S^+ B where S is singular; without it a
    component that others determine is left out.
    """
    spread, (transition, process, output) = jnp.asarray(step.prior.covariance), map(jnp.asarray, model)
    given = spread, output, jnp.asarray(step.innovation.covariance), jnp.asarray(step.innovation.value)
    # H' S^-1 and K = P- H' S^-1 of the components that arrived.
    if solve is None:
        gain, weigh, received, arrived, innovation = _parts(*given)
    else:
        received, arrived, innovation = _of_what_arrived(*given[1:])
        weigh = solve(arrived, received).T
        gain = spread @ weigh
    return LinearSmootherStep(
        mean=jnp.asarray(step.after.mean),
        covariance=jnp.asarray(step.after.covariance),
        prior_mean=jnp.asarray(step.prior.mean),
        prior_covariance=spread,
        precise=_precise(spread, received, arrived),
        transition=transition,
        process=process + jnp.diag(rounded),
        gain=gain,
        output=received,
        weigh=weigh,
        innovation=innovation,
        claim=claim,
        projection=None if projection is None else jnp.asarray(projection),
    )


@runs_last
def _parts(prior: jax.Array, output: jax.Array, total: jax.Array, innovation: jax.Array) -> tuple[jax.Array, ...]:
    received, total, innovation = _of_what_arrived(output, total, innovation)
    weigh = transpose(small_solve(total, received))
    return times(prior, weigh), weigh, received, total, innovation


@runs_last
def _precise(prior: jax.Array, output: jax.Array, total: jax.Array) -> jax.Array:
    """Test whether the noise S - H P- H' of some component, given those before it, is far below S (or is rounding)."""
    noise = pivots(total - congruence(output, prior))
    return jnp.any(~(noise >= rounding(PRECISE, total, 1000) * diagonal_of(total)), axis=0)


def _of_what_arrived(
    output: jax.Array, total: jax.Array, innovation: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """H, S and e without the rows of what did not arrive, for which S has ones."""
    present = ~jnp.isnan(innovation)
    both = present[:, None] & present[None]
    alone = diagonal(jnp.where(present, 0.0, 1.0))
    return jnp.where(present[:, None], output, 0.0), jnp.where(both, total, alone), jnp.where(present, innovation, 0.0)


@runs_last
def observed_through(gain: jax.Array, matrix: jax.Array) -> jax.Array:
    """H = M C."""
    return times(gain, matrix)
