"""The paper's interval bound with the sign of its last term as printed."""

import jax
import numpy as np

import heliograph as hg
from heliograph.filters.gaussian.correction import Signal, as_array, as_scalars, young_correction
from heliograph.filters.gaussian.update import AbstractUpdate, interval_description
from heliograph.random_affine.moments.second_moments import SecondOrder


class LooseInterval(AbstractUpdate):
    """`hg.filters.Interval` with the squared mean added where it should be subtracted: var g <= s + q + (m - r)^2.

    A bound still, but of the power of g instead of its variance, so it trusts a good channel too little: with a perfect
    channel it does not become the filter without one.

    Source: cubature fusion under amplify-and-forward relays, equation (11) as printed.
    """

    scalars: np.ndarray

    def __init__(self, scalars: hg.filters.Scalars | None = None):
        self.scalars = as_array(scalars)

    def describe(self, channel: hg.random_affine.AbstractRandomAffine) -> SecondOrder:
        """Worst cases from intervals.

        Raises:
            ValueError: a channel that is not a chain of scalar hops.
        """
        return interval_description(channel, lambda hop: hop.second + (hop.mean - hop.mean_radius) ** 2)

    def described(self) -> AbstractUpdate:
        """Young's bound, as for a polytope."""
        return hg.filters.Polytope(as_scalars(self.scalars))

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Minimise the trace over K, and over the scalars unless they are fixed."""
        return young_correction(prior, signal, channel, present, self.scalars)
