"""A robust filter of plant, sensor and channel: by the score of the noise law, or by a rule that weighs."""

import numpy as np

from heliograph.filters.gaussian.gaussian_prediction import choose_initial_moments
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.gaussian.recovering_gate import GivingInFilter, build_giving_in_filter
from heliograph.filters.gaussian.robust import Gate, RobustFilter, StudentVB
from heliograph.filters.gaussian.robust_scores import AbstractWeightingRule
from heliograph.filters.received_outlier_noise import ReceivedNoise, Vector, separate_outlier_noise
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_told_numbers
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.fading import without_memory
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail, instance
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import ArrayLike


def _student_degrees_of(noise: ReceivedNoise) -> Vector:
    """Return the degrees of freedom (m,) of the Student law of each received component's noise.

    Raises:
        ValueError: a component has another law, for which `degrees` is NaN. Traced numbers cannot be looked at.
    """
    if not is_traced(noise.degrees) and np.isnan(noise.degrees).any():  # NaN: not of Student's law
        raise fail("StudentVB", "noise of Student's law (StudentT) in each component", "another law")
    degrees: Vector = noise.degrees
    return degrees


@accept_limits
@believes
@accept_told_numbers
def robust_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    rule: "AbstractWeightingRule | None" = None,
    transform: "AbstractTransform | None" = None,
    initial_mean: ArrayLike | None = None,
    initial_covariance: ArrayLike | None = None,
) -> "RobustFilter | GivingInFilter":
    """Return the filter whose estimate no single outlier takes far, for noises like `StudentT` and `Contaminated`.

    Without a rule, the score update: the exact posterior mean and covariance of each component, for a Gaussian prior
    and the law's Gaussian branches. `rule` instead weighs each component before one joint update: `Huber(c)`,
    `InverseMultiquadric(c)`, `WoLF(c)`, `Gate(c)` by its innovation, `StudentVB()` by variational Bayes. The noise that
    is weighed is the sensor's, and the last hop's where its law has outliers. `transform` is `Cubature()` unless
    given; linear parts need none.

    Claim: "nominal"; in simulation the score update's covariance is right (NEES 0.95 to 1.05) where the law is true.

    Args:
        plant: linear or not; it may vary over time.
        sensor: with the noise law whose outliers are weighed.
        channel: between sensor and filter.
        rule: weights by component (default: none, the score update).
        transform: of moments, for a plant or sensor that is not linear (default `Cubature()`).
        initial_mean: mean of x_0 (n,), by default the plant's.
        initial_covariance: covariance of x_0 (n, n), by default the plant's.

    Raises:
        ValueError: parts that do not fit, components of the noise that are correlated (score and StudentVB) or mixed
            by the channel, no noise to weigh, StudentVB of another law than Student's.
    Source: Masreliez (1975) for the score; Duran-Martin et al., Outlier-robust Kalman filtering through generalised
        Bayes (2024), for weights of one update.
    """
    # Parts that fit, and the rule's type.
    start = read_first_plant(plant)
    check_link(first(sensor), first(channel), len(start.states), moments=False)
    if rule is not None:
        instance("rule", rule, AbstractWeightingRule, "one such as Huber(1.345), or None for the score update")
    move = Cubature() if transform is None else transform
    instance("transform", move, AbstractTransform, "one such as Cubature()")
    mean, covariance, _ = choose_initial_moments(start, initial_mean, initial_covariance)
    # The channel without the noise that is weighed, and that noise. Its components must be independent where its law's
    # branches are used: by the score (no rule) and by StudentVB.
    needs_law = rule is None or isinstance(rule, StudentVB)
    plain, noise = separate_outlier_noise(sensor, without_memory(channel), needs_law)
    if isinstance(rule, StudentVB):
        rule = rule.of_law(_student_degrees_of(first(noise)))
    robust = RobustFilter(
        plant=plant, sensor=sensor, channel=plain, noise=noise, rule=rule, transform=move, initial_mean=mean,
        initial_covariance=covariance, received_angles=find_received_angles(plant, sensor, channel), claim="nominal",
        states=start.states, inputs=start.inputs, received=first(channel).outputs,
    )  # fmt: skip
    if isinstance(rule, Gate) and rule.gives_in:
        return build_giving_in_filter(robust, rule)
    return robust
