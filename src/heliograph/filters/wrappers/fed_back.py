"""Filters whose prediction is used: as the estimate, or fed back to the sensor, which subtracts it to save power."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian.factories import make_base_gaussian_filter
from heliograph.filters.gaussian.gaussian import GaussianFilter, correct_signal
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.gaussian.signal_moments import find_signal_moments
from heliograph.filters.gaussian.uncertain_channel_updates import AbstractUpdate, Polytope
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.centred_signal import predict_signal
from heliograph.model.channel import Channel
from heliograph.model.estimate import Innovation, lower_claim_by_noise
from heliograph.model.fading import memory_matters
from heliograph.model.over_time import at, first, stack_over_time
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, is_linear, refuse_angles
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Float


class BeliefAndPrior(NamedTuple):
    """belief: mean and covariance given z_0 ... z_k. prior: those given z_0 ... z_k-1, which are the estimate."""

    belief: Gaussian
    prior: Gaussian


class PredictionFilter(AbstractWrapper):
    """A Gaussian filter whose estimate at step k is made before z_k is used: from z_0 ... z_k-1.

    Mean and covariance are those of f(x, u) + w; z_k is used for the next step. Built by `prediction_of`.
    """

    base: GaussianFilter

    def __init__(self, base: GaussianFilter):
        """Wrap the Gaussian filter `base`, whose predictions are to be the estimates.

        Claim (what the covariance is said to be), states, inputs and length of z (`received`) are those of `base`.
        """
        self.base, self.claim = base, base.claim
        self.states, self.inputs, self.received, self.kept = base.states, base.inputs, base.received, base.kept

    def within(self, state: BeliefAndPrior) -> Gaussian:
        """Return the prediction, which is the estimate."""
        return state.prior

    @in_float64
    def init(self) -> BeliefAndPrior:
        """Return the law of x_0, which is both the belief and the estimate before any data."""
        return BeliefAndPrior(self.base.init(), self.base.init())

    @predicts
    def predict(self, state: BeliefAndPrior, u: ArrayLike = (), k: Step = 0) -> BeliefAndPrior:
        """Predict over step k from the belief given z_0 ... z_k-1; the result is the estimate of step k.

        `correct` will change the belief, but not the stored prediction (`prior`).
        """
        prior = self.base.predict(state.belief, u, k)
        return BeliefAndPrior(prior, prior)

    @corrects
    def correct(self, state: BeliefAndPrior, z: ArrayLike, k: Step = 0) -> tuple[BeliefAndPrior, Innovation]:
        """Correct the belief with z_k, from which the prediction of step k + 1 will start.

        The estimate of step k stays its prediction, `prior`, which does not use z_k.
        """
        belief, innovation = self.base.correct(state.belief, z, k)
        return BeliefAndPrior(belief, state.prior), innovation


def prediction_of(filter: AbstractFilter) -> PredictionFilter:
    """Return a filter whose estimate is the one-step prediction of another: at step k it does not use z_k.

    Claim: that of `filter`, a `GaussianFilter`.

    Args:
        filter: the filter whose prediction becomes the estimate.

    Raises:
        ValueError: a filter that is not Gaussian.

    Source: the prediction step of cubature fusion under amplify-and-forward relays, Section III.
    """
    if not isinstance(filter, GaussianFilter):
        raise fail("filter", "a GaussianFilter", type(filter).__name__)
    return PredictionFilter(filter)


class FedBackBelief(NamedTuple):
    """The state (n,) given the data, and the reference (m,) that the sensor subtracts from y."""

    gaussian: Gaussian
    reference: Float[jax.Array, " m"]


class FedBackFilter(AbstractWrapper):
    """Filter whose estimate is fed back to the sensor: z = G (y - r) + n with r = h(f(xhat, u)), which both compute.

    y - r has the mean E[y] - r, zero for a linear model, and the covariance of the innovation: that alone costs power,
    and that alone the gain's randomness multiplies. The feedback link is lossless.

    Args:
        base: the filter without feedback, whose plant, sensor, channel and update are used.
        claim: what the covariance is.
        states: names of the plant's states.
        inputs: names of the plant's inputs.
        received: length of z.
    """

    base: GaussianFilter

    def within(self, state: FedBackBelief) -> Gaussian:
        """Return mean and covariance of the plant's state, without the reference."""
        return state.gaussian

    def predict_reference(
        self, known: Float[Array, " n"], u: Float[Array, " inputs"], k: Step
    ) -> Float[jax.Array, " m"]:
        """Return the reference r that the sender subtracts from y at step k, the predicted y.

        It is predicted from the estimate `known` before the step, and the input u over it.
        """
        return predict_signal(at(self.base.plant, k), at(self.base.sensor, k), known, u)

    @in_float64
    def init(self) -> FedBackBelief:
        """Return the law of x_0, and a reference of zeros, since nothing has been predicted yet."""
        return FedBackBelief(self.base.init(), jnp.zeros(len(first(self.base.sensor).outputs)))

    @predicts
    def predict(self, state: FedBackBelief, u: ArrayLike = (), k: Step = 0) -> FedBackBelief:
        """Return the mean and covariance of f(x, u) + w, and the reference that the sensor will subtract."""
        moved = self.base.predict(state.gaussian, u, k)
        return FedBackBelief(moved, self.predict_reference(state.gaussian.mean, jnp.asarray(u), k))

    @corrects
    def correct(self, state: FedBackBelief, z: ArrayLike, k: Step = 0) -> tuple[FedBackBelief, Innovation]:
        """Correct with z = G (y - r) + n, where r is the reference that the sender subtracts from its signal y.

        The moments of y under the belief give those of y - r, the signal that is sent. Then the correction is that of
        `base` (its channel and its update rule) for this signal. r is known, so that it adds no uncertainty.
        """
        base = self.base
        plant, sensor = at(base.plant, k), at(base.sensor, k)
        initial_power = second_moments_at_start(base.plant, base)
        y = find_signal_moments(plant, sensor, base.transform, state.gaussian, initial_power)
        # What is sent is y - r. It has another mean and second moment than y, but the same covariance.
        mean = y.mean - state.reference
        sent = y._replace(mean=mean, second=y.covariance + jnp.outer(mean, mean))
        after, innovation = correct_signal(sent, at(base.channel, k), base.rule, jnp.asarray(z))
        return FedBackBelief(after, state.reference), innovation


@believes
def fed_back_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    transform: AbstractTransform | None = None,
    update: AbstractUpdate | None = None,
) -> FedBackFilter:
    """Filter whose prediction is fed back to the sensor, which sends y less that prediction: z = G (y - r) + n.

    y is the sensor's measurement, r its prediction by the filter, G and n the channel's gain and noise. The difference
    needs less power than y. A node that has this filter is simulated so. z is what arrives: the filter adds no r to it.

    Args:
        plant: the plant; a linear plant and sensor need no transform.
        sensor: its sensor, without angles.
        channel: from the sensor to the filter; the feedback is lossless.
        transform: how moments of a nonlinear function are found; `Cubature()` by default.
        update: how the correction handles gains that are known only up to a set; `Polytope()` by default.

    Claim (what the covariance is said to be): "exact" for a linear plant and sensor, however random the gains. Then
    y - r has mean 0 and covariance S = C P C' + R, and with M = E[G], Sigma(S) = Cov of (G - M) (y - r) + n, the best
    gain is K = P C' M' (M S M' + Sigma(S))^-1. Else "nominal".

    Raises:
        ValueError: parts that do not fit, angles.

    Source: Schalkwijk and Kailath, A coding scheme for additive noise channels with feedback (1966), for a state that
        moves; Elia, Remote stabilization over fading channels (2005).
    """
    chosen = Cubature() if transform is None else transform
    rule = Polytope() if update is None else update
    base = make_base_gaussian_filter("filter that is fed back", plant, sensor, channel, chosen, rule)
    refuse_angles("filter that is fed back", plant, sensor)
    # Exact: linear, the channel's moments known, no memory of the channel that a filter could use, the standard update.
    described = stack_over_time(base.channel)
    exact = is_linear(plant, sensor) and not described.uncertain and not memory_matters(channel) and update is None
    claim = lower_claim_by_noise("exact" if exact else "nominal", plant, sensor, channel)
    return FedBackFilter(base=base, claim=claim, states=base.states, inputs=base.inputs, received=base.received)
