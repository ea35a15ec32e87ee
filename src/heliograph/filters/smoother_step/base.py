"""What a filter's step leaves behind for a sweep back, and how what later data say passes back over it.

A sweep starts at the last step with `end`, passes each step with `back`, and reads the estimates given all data with
`told`; `ahead` carries one earlier state forward instead.
"""

from typing import NamedTuple

import equinox as eqx
import jax

from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.angle import Angles, wrapped
from heliograph.numerics.module import Module
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import congruence, symmetric, times_vector, with_rounding
from heliograph.numerics.types import Float, PyTree


class Moments(NamedTuple):
    """Mean (N,) and covariance (N, N) of the state after a step, given later data too."""

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]


class Point(NamedTuple):
    """An earlier state x_j given the data so far: mean and covariance; `link` tells how news of x now reach it."""

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    link: Float[jax.Array, "N N"]


class AbstractSmootherStep(Module):
    """A step as a sweep back needs it: the estimate after it, of the filter's own state of N numbers.

    The plant's state is want y + shift of the filter's state y, y itself without them. claim: of estimates given later
    data too. Stacked along time, and over runs, it is what a filter leaves of a whole run. angles: which of the plant's
    states are told between -pi and pi; a sweep never wraps them. surprise: e' S^-1 e of the
    step's innovation, expected to be `heard`, the number of components that arrived.

    Shapes: mean (N,), covariance (N, N), want (n, N), shift (n,).
    """

    mean: Float[jax.Array, "*time N"]
    covariance: Float[jax.Array, "*time N N"]
    projection: Float[jax.Array, "*time n N"] | None
    shift: Float[jax.Array, "*time n"] | None
    nis: Float[jax.Array, "*time"] | None
    received: Float[jax.Array, "*time"] | None
    claim: Claim = eqx.field(static=True)
    angles: Angles = eqx.field(static=True)

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

    def before(self, item: "AbstractSmootherStep", earlier: PyTree, known: Moments) -> Moments:
        """The state after step `one`, the one before this, given all later data.

        `earlier` is what `back` makes of them; `known` is the state after this step given the same.
        """
        return item.smoothed(earlier)

    def start(self) -> Point:
        """The state after this step as one to be carried ahead."""
        n = self.mean.shape[-1]
        return Point(self.mean, self.covariance, self._link(n))

    def without_data(self) -> "AbstractSmootherStep":
        """The same step without what only means depend on."""
        raise NotImplementedError

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> "AbstractSmootherStep":
        """The same step of other data that arrived in the same places: only means and innovation are others."""
        raise NotImplementedError

    def _link(self, n: int) -> jax.Array:
        raise NotImplementedError

    def estimate_from(self, result: Moments | Point) -> Estimate:
        """The plant's state from the filter's."""
        mean, covariance = result.mean, result.covariance
        if self.projection is not None:
            mean, covariance = applied(self.projection, mean), _congruence(self.projection, covariance)
        mean = mean if self.shift is None else mean + self.shift
        return Estimate(wrapped(mean, self.angles), covariance, self.claim)


@runs_last
def less(p: jax.Array, factor: jax.Array, middle: jax.Array) -> jax.Array:
    """P - F M F', known to rounding of P alone, which is added."""
    return symmetric(with_rounding(p, len(p)) - congruence(factor, middle))


@runs_last
def applied(a: jax.Array, x: jax.Array) -> jax.Array:
    """A x."""
    return times_vector(a, x)


@runs_last
def _congruence(a: jax.Array, p: jax.Array) -> jax.Array:
    return congruence(a, p)
