"""Smoother step of a filter: what the backward pass needs of a forward step.

A pass starts at the last step with `end`, goes back over each step with `back`, and reads the estimates given all data
with `estimate_from`; `ahead` carries one earlier state forward instead.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.angle import Angles, wrapped
from heliograph.numerics.module import Module
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import congruence, symmetric, times_vector, with_rounding
from heliograph.numerics.types import Bool, Float, PyTree


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


class AbstractSmootherStep(Module):
    """Smoother step: the estimate after a step, of the filter's state of N numbers, and what a backward pass needs.

    The plant's state is projection y + shift of the filter's state y, y itself without them. Stacked along time, and
    over runs, it describes a whole run of a filter.

    claim: of estimates given later data too. angles: which of the plant's states are wrapped to between -pi and pi in
    estimates; a backward pass never wraps them. nis: e' S^-1 e of the step's innovation, with mean `received`, the
    number of components that arrived.

    Shapes: mean (N,), covariance (N, N), projection (n, N), shift (n,).
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
        """Start a backward pass at this step, the last."""
        raise NotImplementedError

    def back(self, later: PyTree, mean: jax.Array, covariance: jax.Array) -> PyTree:
        """Pass from after this step to before it, where the filter had this mean and covariance."""
        raise NotImplementedError

    def smoothed(self, later: PyTree) -> Moments:
        """Return the filter's state after this step, given later data."""
        raise NotImplementedError

    def ahead(self, point: Point, covariance: jax.Array) -> Point:
        """Return an earlier state given this step's data too; the filter had this covariance before the step."""
        raise NotImplementedError

    def before(self, item: "AbstractSmootherStep", earlier: PyTree, known: Moments) -> Moments:
        """Return the state after step `item`, the one before this, given all later data.

        `earlier` is the result of `back`; `known` is the state after this step given the same data.
        """
        return item.smoothed(earlier)

    def start(self) -> Point:
        """Return the state after this step as a point to be carried ahead."""
        unit = jnp.broadcast_to(jnp.eye(self.mean.shape[-1]), self.covariance.shape)
        nothing = jnp.zeros_like(self.covariance)
        return Point(self.mean, self.covariance, unit, nothing, self.covariance, jnp.asarray(False))

    def without_data(self) -> "AbstractSmootherStep":
        """Return the same step without the parts that only means depend on."""
        raise NotImplementedError

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> "AbstractSmootherStep":
        """Return the same step with other data of the same arrivals: other means and innovation."""
        raise NotImplementedError

    def estimate_from(self, result: Moments | Point) -> Estimate:
        """Estimate of the plant's state from the filter's."""
        mean, covariance = result.mean, result.covariance
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
