"""Best linear filter with the covariance of its innovations given the one recording that it runs over."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import from_covariance
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.linear.linear_filter_state import LinearBelief, motion_of_plant
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.linalg import symmetric
from heliograph.numerics.types import Array, ArrayLike, Float


class RecordedBelief(NamedTuple):
    """State `own` of the linear filter itself, and the covariance of its error given the data up to now, (n, n)."""

    own: LinearBelief
    covariance: Float[Array, "n n"]


class LinearFilterOfRecord(AbstractSizedFilter):
    """A linear filter with its own gains and estimates, and the covariances that its errors have in this recording.

    Behind a random gain G the filter's innovation covariance S uses E[x x'] before any data, a mean over all runs. In
    one run of a wandering plant x x' stays far from that mean for as long as the plant remembers, so that the squared
    innovations of one recording do not test S. Given the data E[x x'] = m m' + P; its mean over all runs is the
    filter's own E[x x']. So here

        S = E[G C (m m' + P) C' G'] - (E[G] C m)(E[G] C m)' + ...     the filter's formula with E[x x'] = m m' + P
        P+ = P - K H P - P H' K' + K S K',  H = E[G] C

    The sum of squares may be compared with that of S, not each square by itself: a small m m' + P is more often too
    small. The claim is nominal, since the law of x given the data is not that of a linear filter's mean and covariance.

    Args:
        filter: the linear filter, whose state is a `LinearBelief`.
        plant: its plant.

    Source: De Koning (1984), with moments given the data in place of those before any.
    """

    filter: AbstractFilter
    plant: AnyPlant

    @in_float64
    def init(self) -> RecordedBelief:
        """Return the filter's state before any data, with the covariance of x_0 as that of the estimate's error."""
        own = self.filter.init()
        return RecordedBelief(own, covariance=own.state_covariance)

    @predicts
    def predict(self, state: RecordedBelief, u: ArrayLike = (), k: Step = 0) -> RecordedBelief:
        """Predict over x+ = A x + b + w: the filter's own state, and P given the recording, to A P A' + Q."""
        initial_power = second_moments_at_start(self.plant)
        move = motion_of_plant(at(self.plant, k), jnp.asarray(u), initial_power)
        covariance = move.matrix @ state.covariance @ move.matrix.T + move.covariance
        return RecordedBelief(self.filter.predict(state.own, u, k), symmetric(covariance))

    @corrects
    def correct(self, state: RecordedBelief, z: ArrayLike, k: Step = 0) -> tuple[RecordedBelief, Innovation]:
        """Correct the filter's own state as it does, and P by its gain K: P - K H P - P H' K' + K S K'.

        A linear filter behind random gains states a covariance that is a mean over all recordings; P is that given this
        recording. S is the covariance of the innovation that the filter would compute if the moments of x before any
        data were those given this recording, E[x x'] = m m' + P. The innovation that is returned has this S.

        Args:
            state: the filter's own state, and P (n, n).
            z: measurement, NaN where missing.
            k: number of the step.
        """

        def correct_mean(mean: jax.Array, value: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return the corrected mean and the innovation (0 where nothing arrived) for a predicted mean and z.

            Gain and covariance do not depend on data, so both results are affine in both arguments.
            """
            gaussian = state.own.gaussian._replace(mean=mean)
            after, innovation = self.filter.correct(state.own._replace(gaussian=gaussian), value, k)
            return after.gaussian.mean, jnp.nan_to_num(innovation.value)

        mean, P = state.own.gaussian.mean, jnp.asarray(state.covariance)
        after, own_innovation = self.filter.correct(state.own, z, k)
        arrived = ~jnp.isnan(own_innovation.value)
        # The filter computes m+ = m + K e with the innovation e = z - H m - c: K = dm+/dz and -H = de/dm.
        (_, gain), (minus_H, _) = jax.jacfwd(correct_mean, (0, 1))(mean, jnp.asarray(z))
        H, K = jnp.where(arrived[:, None], -minus_H, 0.0), jnp.where(arrived, gain, 0.0)
        # S by the filter's formula, with E[x x'] = m m' + P in place of the moments before any data.
        moments_given_data = LinearBelief(from_covariance(mean, P), state_mean=mean, state_covariance=P)
        _, innovation = self.filter.correct(moments_given_data, z, k)
        S = jnp.where(arrived[:, None] & arrived, innovation.covariance, 0.0)
        P = P - K @ H @ P - (K @ H @ P).T + K @ S @ K.T
        return RecordedBelief(after, symmetric(P)), innovation

    @estimates
    def estimate(self, state: RecordedBelief) -> Estimate:
        """Return the filter's own mean, with the covariance P that its error has given the data of this recording."""
        return Estimate(state.own.gaussian.mean, state.covariance, self.claim)
