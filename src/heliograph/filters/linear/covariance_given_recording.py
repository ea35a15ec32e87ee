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
    """The filter's own state, and the covariance of its error given the data up to now, (n, n)."""

    own: LinearBelief
    covariance: Float[Array, "n n"]


class LinearFilterOfRecord(AbstractSizedFilter):
    """A linear filter with its own gains and estimates, and the covariances that its errors have in this recording.

    Behind a random gain G the filter's S counts E[x x'] over all runs. In one run of a plant that wanders x x' is
    nowhere near that mean, for as long as the plant remembers, so the squares of one recording say nothing of S. Given
    the data E[x x'] = m m' + P, of which the mean over all runs is the filter's own: with J = I - K E[G] C

        S = E[G C (m m' + P) C' G'] - (E[G] C m)(E[G] C m)' + ...     as the filter computes it, from these moments
        P+ = P - K H P - P H' K' + K S K',  H = E[G] C

    Squares are compared with S in sum, not one by one: where m m' + P came out small it is more often too small. The
    posterior is taken for one that the mean and covariance of the linear filter describe: a nominal claim.

    Args:
        filter: the linear filter, whose state is a `LinearBelief`.
        plant: its plant.

    Source: De Koning (1984), with moments given the data in place of those before any.
    """

    filter: AbstractFilter
    plant: AnyPlant

    @in_float64
    def init(self) -> RecordedBelief:
        """Return the filter's prior."""
        own = self.filter.init()
        return RecordedBelief(own, own.state_covariance)

    @predicts
    def predict(self, state: RecordedBelief, u: ArrayLike = (), k: Step = 0) -> RecordedBelief:
        """Predict the filter's own state, and the covariance P given the recording: A P A' + Q."""
        initial_power = second_moments_at_start(self.plant)
        move = motion_of_plant(at(self.plant, k), jnp.asarray(u), initial_power)
        covariance = move.matrix @ state.covariance @ move.matrix.T + move.covariance
        return RecordedBelief(self.filter.predict(state.own, u, k), symmetric(covariance))

    @corrects
    def correct(self, state: RecordedBelief, z: ArrayLike, k: Step = 0) -> tuple[RecordedBelief, Innovation]:
        """Correct the filter's own state as it does, and P by its gain K: P - K H P - P H' K' + K S K'.

        S is the covariance of the innovation that the filter would compute if the moments of x before any data were
        those given this recording, E[x x'] = m m' + P. The innovation that is returned has this S.
        """

        def correct_mean(mean: jax.Array, value: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return the corrected mean and the innovation (0 for what is missing), from the predicted mean and z.

            `state.own` is the filter's own state. Its covariance and gain depend on no data, so that the mean and the
            innovation are affine in both arguments.
            """
            gaussian = state.own.gaussian._replace(mean=mean)
            after, innovation = self.filter.correct(state.own._replace(gaussian=gaussian), value, k)
            return after.gaussian.mean, jnp.nan_to_num(innovation.value)

        mean, P = state.own.gaussian.mean, jnp.asarray(state.covariance)
        after, own = self.filter.correct(state.own, z, k)
        # The gain K, and H, the derivative by the mean of what is expected of z, from the filter's own arithmetic: its
        # innovation is z - H m - c.
        arrived = ~jnp.isnan(own.value)
        (_, gain), (slope, _) = jax.jacfwd(correct_mean, (0, 1))(mean, jnp.asarray(z))
        H, K = jnp.where(arrived[:, None], -slope, 0.0), jnp.where(arrived, gain, 0.0)
        # The covariance of the innovation where the moments before data are those of the estimate.
        given = LinearBelief(from_covariance(mean, P), mean, P)
        _, innovation = self.filter.correct(given, z, k)
        S = jnp.where(arrived[:, None] & arrived, innovation.covariance, 0.0)
        P = P - K @ H @ P - (K @ H @ P).T + K @ S @ K.T
        return RecordedBelief(after, symmetric(P)), innovation

    @estimates
    def estimate(self, state: RecordedBelief) -> Estimate:
        """Return the filter's mean, with the covariance of its error given this recording."""
        return Estimate(state.own.gaussian.mean, state.covariance, self.claim)
