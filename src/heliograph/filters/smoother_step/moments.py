"""Smoother step of any update, by its moments (Rauch, Tung and Striebel)."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from heliograph.filters.smoother_step.base import AbstractSmootherStep, Moments, Point, applied, less
from heliograph.numerics.over_runs import runs_last
from heliograph.numerics.small_matrix import solve, times, transpose
from heliograph.numerics.types import Float


class MomentsSmootherStep(AbstractSmootherStep):
    """Any update: prior mean and covariance too, and cross = Cov(y before the step, y after its prediction).

    J = cross (P-)^+: y_s = y + J (y_s+ - y-), P_s = P + J (P_s+ - P-) J'. Exact where the covariances are.

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems (1965).
    """

    prior_mean: Float[jax.Array, "*time N"]
    prior_covariance: Float[jax.Array, "*time N N"]
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

    def without_data(self) -> AbstractSmootherStep:
        """Return the step without both means."""
        none = jnp.zeros_like(self.mean)
        return replace(self, mean=none, prior_mean=none, shift=None, nis=None, received=None)

    def with_data(self, mean: jax.Array, prior_mean: jax.Array, innovation: jax.Array) -> AbstractSmootherStep:
        """Return the step with these means."""
        return replace(self, mean=mean, prior_mean=prior_mean)

    def _gain(self) -> jax.Array:
        return _solved(self.prior_covariance, self.cross)


@runs_last
def _solved(a: jax.Array, b: jax.Array) -> jax.Array:
    """B A^+."""
    return transpose(solve(a, transpose(b)))


@runs_last
def _product_of(a: jax.Array, b: jax.Array) -> jax.Array:
    return times(a, b)
