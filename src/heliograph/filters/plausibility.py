"""Judge by the innovation's squared distance whether data are plausible; say which are not, and why.

An implausible value is never used: a live estimator, a timeline and a recording refuse it and report it.
"""

from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.angle_indices import FilterAngles
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.numerics.angles.angle import TURN, Angles
from heliograph.numerics.linalg import NEGATIVE_TOLERANCE, rounding, squared_distance, squared_distance_terms
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Float, PyTree

Candidate = TypeVar("Candidate")

LIMIT = 1e6
"""Deviations of the innovation beyond which an update loses its digits.

An update moves the mean by up to d of its deviations, since K S K' <= P. So the mean is rounded to eps d of them, and
what is a difference of second moments there (E[x x'] - m m', the second differences of a quadratic function) to eps d^2
of the variance. At d = 1e6 these are 2e-10 and 2e-4 in double precision. In single precision nothing is left of second
moments from d = eps^-1/2 = 2,900 on: the bound is there (`largest_plausible_distance`). Any bound far below would be a
statistical gate, which locks a filter out after an outage. Streams, timelines, services and recordings are in double.
"""


class Reason(IntEnum):
    """Reasons for which something is implausible."""

    PLAUSIBLE = 0
    FAR = 1
    EXCLUDED = 2
    UNSOUND = 3
    PREDICTION = 4
    UNREADABLE = 5


WORDS = {
    Reason.EXCLUDED: "a value that the model excludes",
    Reason.UNSOUND: "with it the estimate is no number, or its covariance is none",
    Reason.PREDICTION: "the prediction to its time is no finite number, its covariance is none, or its inputs are none",
    Reason.UNREADABLE: "an angle of so many turns that its digits do not say where it points",
}
INPUT = "with it the mean loses its digits to rounding"
READABLE = 0.1
"""Deviations of the innovation beyond which the rounding eps |z| of an angle z is not what a sensor says.

An angle is used without its whole turns, which take none of its rounding with them. Rounding is uniform, so that at the
bound it has a variance of READABLE^2 / 3 = 0.3 % of the innovation's: a claim does not see it.
"""


def largest_plausible_distance(dtype: np.dtype) -> float:
    """Return the squared distance beyond which an update loses its digits: LIMIT squared or, if less, 1 / eps."""
    return min(LIMIT**2, 1 / float(np.finfo(dtype).eps))


@readable
class Judgement(NamedTuple):
    """Judgement of one step of a filter.

    distance: e' S^-1 e of the components that arrived, NaN if none did or no covariance is known (any more); arrived:
    how many did; reason: a `Reason`; input: 1 where the prediction took the mean to where its deviations are below its
    rounding, NaN where no covariance is claimed. All are numbers, so that a judgement is a row of an array.
    """

    distance: Array
    arrived: Array
    reason: Array
    input: Array

    @property
    def implausible(self) -> Array:
        """True where the measurement must not be used: it has a reason other than `Reason.PLAUSIBLE`, 0."""
        return self.reason > 0

    @staticmethod
    def judge_prediction(
        claim: Claim, states: tuple[PyTree, PyTree], estimates: tuple[Estimate, Estimate], are_inputs_invalid: Array
    ) -> "Judgement":
        """Judge a prediction by itself, as a step without data.

        `states`, `estimates`: before and after the prediction. `are_inputs_invalid`: whether some input is no finite
        number. `claim`: "none" if the filter claims no covariance.
        """
        (before, prior), (estimate_before, prediction), no_data = states, estimates, jnp.zeros(0)
        no_innovation = Innovation(no_data, jnp.zeros((0, 0)), jnp.zeros(()))
        three_states = before, prior, prior  # before, after prediction, after a correction by nothing
        three_estimates = estimate_before, prediction, prediction
        return judge_step(
            claim,
            three_states,
            three_estimates,
            no_innovation,
            no_data,
            of_atoms=False,
            angles=None,
            spoilt=are_inputs_invalid,
        )

    @staticmethod
    def judge_correction(
        claim: Claim, states: tuple[PyTree, PyTree], estimates: tuple[Estimate, Estimate], innovation: Innovation,
        z: Float[Array, " m"], of_atoms: bool, angles: FilterAngles | None,
    ) -> "Judgement":  # fmt: skip
        """Judge a correction alone, from the states and estimates before and after it.

        The innovation is that of the measurement z. `claim` is "none" without a covariance. `of_atoms`: the filter is a
        mixture of components, each of which may exclude z. `angles`: which components of z are angles.
        """
        prior, after = states
        expected, corrected = estimates
        # `judge_step` takes a whole step: here the prediction has changed nothing.
        three_states, three_estimates = (prior, prior, after), (expected, expected, corrected)
        return judge_step(claim, three_states, three_estimates, innovation, z, of_atoms, angles)

    @staticmethod
    def find_far(innovation: Innovation) -> jax.Array:
        """Return which components of the innovation e, of covariance S, are far: |e_j| > 1e6 sqrt(S_jj)."""
        variances = jnp.diagonal(jnp.asarray(innovation.covariance))
        return jnp.abs(innovation.value) > LIMIT * jnp.sqrt(jnp.maximum(variances, 0.0))

    @staticmethod
    def find_unreadable(innovation: Innovation, z: Float[Array, " m"], angles: Angles, eps: float) -> jax.Array:
        """Return which angles among z have so many turns that their rounding hides where they point.

        It does if eps |z_j| is above READABLE sqrt(S_jj), S the innovation's covariance, and above sqrt(eps) turns.

        Args:
            innovation: of z.
            z: the measurement (m,).
            angles: indices of the components that are angles.
            eps: relative rounding of the precision in which z was sent.
        """
        variances = jnp.diagonal(jnp.asarray(innovation.covariance))
        known = jnp.maximum(READABLE * jnp.sqrt(jnp.maximum(variances, 0.0)), np.sqrt(eps) * TURN)
        is_angle = np.isin(np.arange(len(z)), angles)
        return jnp.asarray(is_angle & (eps * jnp.abs(z) > known))

    @staticmethod
    def find_culprit(
        candidates: "Sequence[Candidate]", size: "Callable[[Candidate], float]", excuses: "Callable[[Candidate], bool]"
    ) -> "Candidate":
        """Return the largest value without which a row is plausible, or the largest of all if there is none.

        Args:
            candidates: values of several nodes that one filter judged together, and found implausible.
            size: returns the size of a value, by which values are ordered.
            excuses: whether the row is plausible without a value.
        """
        largest_first = sorted(candidates, key=size, reverse=True)
        if len(largest_first) == 1:  # nothing need be computed again
            return largest_first[0]
        return next((candidate for candidate in largest_first if excuses(candidate)), largest_first[0])

    @staticmethod
    def is_spoilt(reason: float) -> bool:
        """Return whether the reason is a state or a prediction that is no number: a function of the model gave none."""
        return reason in (Reason.UNSOUND, Reason.PREDICTION)

    @staticmethod
    def describe(reason: float, squared_distance: float) -> str:
        """Describe in words why something is implausible, with the bound of the precision that the distance has.

        `reason` is the number of a `Reason`, and WORDS has the texts of all but FAR. `squared_distance` is in squared
        deviations. LIMIT is the bound of the distance in double precision, 1e6.
        """
        if Reason(int(reason)) != Reason.FAR:
            return WORDS[Reason(int(reason))]
        largest_distance = np.sqrt(largest_plausible_distance(np.asarray(squared_distance).dtype))
        bound = "1e6" if largest_distance == LIMIT else f"{largest_distance:,.0f}"
        description = f"more than {bound} deviations from what was expected"
        return description + (f" ({np.sqrt(squared_distance):.3g} of them)" if np.isfinite(squared_distance) else "")

    @staticmethod
    def why_values(judgements: Float[np.ndarray, "filters 4"]) -> str | None:
        """Return why a measurement is implausible, or None if some filter finds it plausible or none implausible.

        So a filter that has diverged, and judges all values implausible, does not exclude them for the others. A filter
        that claims no covariance judges only its own state.

        `judgements` has a row for each filter: squared distance (NaN if it cannot judge), numbers arrived, reason (0 if
        plausible), judgement of inputs.
        """
        squared_distance, _, reason, _ = judgements.T
        is_implausible = reason > 0
        if not is_implausible.any() or (~is_implausible & ~np.isnan(squared_distance)).any():
            return None
        first_filter = int(np.argmax(is_implausible))
        return Judgement.describe(reason[first_filter], squared_distance[first_filter])

    @staticmethod
    def why_inputs(judgements: Float[np.ndarray, "filters 4"]) -> str | None:
        """Return why inputs are implausible, or None if some filter finds them plausible or none implausible.

        `judgements` has a row for each filter: squared distance, numbers arrived, reason, judgement of inputs (1 if
        implausible, NaN if it cannot judge). INPUT is the text for inputs by which the mean loses its digits.
        """
        _, _, reason, of_inputs = judgements.T
        by_prediction = reason == Reason.PREDICTION
        is_implausible = (of_inputs > 0) | by_prediction
        if not is_implausible.any() or (~is_implausible & ~np.isnan(of_inputs)).any():
            return None
        return WORDS[Reason.PREDICTION] if by_prediction.any() else INPUT


def innovation_distance(innovation: Innovation) -> tuple[jax.Array, jax.Array]:
    """Return e' S^-1 e of the components that arrived, and their number; it is infinite where S excludes e.

    e is the innovation and S its covariance. What did not arrive gets variance 1 and innovation 0, and adds nothing.
    """
    value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
    present = ~jnp.isnan(value)
    unit_if_missing = jnp.diag(jnp.where(present, 0.0, 1.0))
    covariance_with_missing = jnp.where(present[:, None] & present, covariance, unit_if_missing)
    distance = squared_distance(covariance_with_missing, jnp.where(present, value, 0.0))
    return distance, jnp.sum(present).astype(distance.dtype)


def judge_step(
    claim: Claim, states: tuple[PyTree, PyTree, PyTree], estimates: tuple[Estimate, Estimate, Estimate],
    innovation: Innovation, z: Float[Array, " m"], of_atoms: bool, angles: FilterAngles | None,
    spoilt: Array | bool = False,
) -> Judgement:  # fmt: skip
    """Judge a step by its innovation, and by the states and estimates before it, after prediction and after correction.

    A value is far where the components larger than expected are too many deviations off
    (`largest_plausible_distance`): a smaller one takes the mean to where it has more digits, so that an estimate which
    is far off can return. It is unreadable where it is an angle of very many turns (`find_unreadable`). It is excluded
    where the model determines all of it and it differs, or where its density is 0 in each component of a mixture. A
    state is unsound if a mean or variance in it is not finite, a variance is negative or a number is infinite, and the
    state before it was sound. A prediction is judged like a state.

    Args:
        claim: of the filter; "none" where it claims no covariance, and nothing is judged by one.
        states: of the filter, before the step, after its prediction and after its correction.
        estimates: of these states.
        innovation: of the measurement.
        z: the measurement (m,), NaN for what did not arrive.
        of_atoms: whether the filter is a mixture (particles, modes) in which each component may exclude z.
        angles: which components of z the filter takes for angles; None if it is not known.
        spoilt: whether the inputs of the prediction were not finite.
    """
    (state_before, state_prior, state_after), (before, prior, after) = states, estimates
    judged = _judge_value(innovation, z, of_atoms, angles.received if angles else ())
    # States that stop being numbers, by the correction or already by the prediction.
    is_sound = _is_sound_correction(after, claim, prior)
    loses_soundness = _is_sound_correction(prior, claim, before) & ~is_sound
    by_correction = loses_soundness | _overflows(state_prior, state_after)
    loses_soundness = _are_finite(before, claim) & ~_is_sound_prediction(prior, claim)
    by_prediction = loses_soundness | _overflows(state_before, state_prior) | spoilt
    # If several reasons apply, the last of these lines wins.
    reason = jnp.where(judged.excluded, Reason.EXCLUDED, Reason.PLAUSIBLE)
    reason = jnp.where(by_correction & judged.came, Reason.UNSOUND, reason)
    reason = jnp.where(judged.unreadable, Reason.UNREADABLE, reason)
    reason = jnp.where(judged.far, Reason.FAR, reason)
    reason = jnp.where(by_prediction, Reason.PREDICTION, reason)
    # Inputs that move the mean to where its deviation is below its rounding.
    distance, count = judged.distance, judged.arrived
    loses_digits = jnp.any(_mask_rounded_away(prior) & ~_mask_rounded_away(before)).astype(count.dtype)
    input_verdict = jnp.nan if claim == "none" else loses_digits
    # No distance if nothing arrived, or if the estimate was not finite before.
    distance = jnp.where((count > 0) & (is_sound | (reason > 0)), distance, jnp.nan)
    return Judgement(
        distance=distance,
        arrived=count,
        reason=reason.astype(count.dtype),
        input=jnp.asarray(input_verdict),
    )


class _JudgedValue(NamedTuple):
    """Judgement of a measurement: its squared distance, the number of components judged, flags of what is wrong.

    `came` is True if any number arrived, also where the expected value is no number, so that nothing was judged.
    """

    distance: Array
    arrived: Array
    far: Array
    unreadable: Array
    excluded: Array
    came: Array


def _judge_value(innovation: Innovation, z: Float[Array, " m"], of_atoms: bool, angles: Angles) -> _JudgedValue:
    """Judge a measurement z (m,), some of it `angles`, by its innovation e = z - expected and its covariance S.

    Far: components with |z| > |expected| whose squared distance e' S^-1 e exceeds `largest_plausible_distance`.
    Excluded: every component is determined by the model (no variance), and one of them differs; or, for a filter that
    is a mixture (`of_atoms`), z has the likelihood 0 under each Gaussian of it.
    """
    value, covariance, z = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance), jnp.asarray(z)
    z = z if len(z) == len(value) else jnp.full_like(value, jnp.nan)  # a filter without measurements
    # e_j^2 / s_j of each component given those before it, and whether these determine it.
    present, expected = ~jnp.isnan(value), z - value
    size = jnp.where(jnp.isfinite(expected), jnp.abs(z) + jnp.abs(expected), 0.0)
    squares_of_all, is_determined = _squared_distance_terms_in_turn(value, covariance, present, size)
    distance, count = jnp.sum(squares_of_all), jnp.sum(present.astype(value.dtype))
    # Far: the components that are larger than expected, without the others, are beyond the limit of this precision.
    is_larger = present & ~(jnp.abs(z) <= jnp.abs(expected))
    squares_of_larger, is_larger_determined = squares_of_all, is_determined
    if len(value) > 1:  # a single component has no others that are left out
        squares_of_larger, is_larger_determined = _squared_distance_terms_in_turn(value, covariance, is_larger, size)
    undetermined_squares = jnp.where(is_larger & ~is_larger_determined, squares_of_larger, 0.0)
    limit = largest_plausible_distance(value.dtype)
    far = jnp.any((undetermined_squares > limit) | (is_larger & jnp.isinf(value))) | (
        jnp.sum(undetermined_squares) > limit
    )
    # Excluded: all determined, and one differs; or the mixture's density is 0, though the squared distance is finite.
    excluded = jnp.any(jnp.isinf(squares_of_all) & is_determined) & ~jnp.any(~is_determined & present)
    if of_atoms:
        excluded |= (jnp.asarray(innovation.log_likelihood) == -jnp.inf) & jnp.isfinite(distance)
    return _JudgedValue(
        distance=distance,
        arrived=count,
        far=far,
        unreadable=jnp.any(Judgement.find_unreadable(innovation, z, angles, float(np.finfo(value.dtype).eps))),
        excluded=excluded,
        came=(count > 0) | jnp.any(~jnp.isnan(z)),
    )


def _squared_distance_terms_in_turn(
    value: jax.Array, covariance: jax.Array, used: jax.Array, size: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return e_j^2 / s_j of each used component, given those before it, and which components those before determine.

    e_j is the innovation given the components before j, and s_j its variance. A determined component has only rounding
    as variance. `used` says which components count. `size` is that of the subtracted numbers, for their rounding.
    """
    covariance_of_used = jnp.where(used[:, None] & used, covariance, jnp.eye(len(value), dtype=value.dtype))
    squares, determined = squared_distance_terms(
        covariance_of_used, jnp.where(used, value, 0.0), jnp.where(used, size, 0.0)
    )
    return jnp.where(used, squares, 0.0), used & determined


def _are_finite(estimates: Estimate, claim: Claim) -> jax.Array:
    """Return whether all means are finite numbers, and the covariances too where one is claimed."""
    finite = ~jnp.any(~jnp.isfinite(jnp.asarray(estimates.mean)))
    return finite if claim == "none" else finite & ~jnp.any(~jnp.isfinite(jnp.asarray(estimates.covariance)))


def _is_sound_correction(estimates: Estimate, claim: Claim, before: Estimate) -> jax.Array:
    """Return whether all is finite, and no variance is below zero by more than the rounding of the variance before.

    The share NEGATIVE_TOLERANCE of the variance before counts as rounding. A filter with the claim "none" has no
    covariance to judge.
    """
    if claim == "none":
        return _are_finite(estimates, claim)
    variances_after = jnp.diagonal(jnp.asarray(estimates.covariance))
    variances_before = jnp.diagonal(jnp.asarray(before.covariance))
    # A correction subtracts from the variance before, and its rounding has that size.
    size = jnp.where(jnp.isfinite(variances_before), jnp.abs(variances_before), 0.0)
    rounded = rounding(NEGATIVE_TOLERANCE, variances_after) * size
    return _are_finite(estimates, claim) & ~jnp.any(variances_after < -rounded)


def _is_sound_prediction(prior: Estimate, claim: Claim) -> jax.Array:
    """Return whether all is finite, and no variance is below zero by more than the rounding of the largest variance.

    The share NEGATIVE_TOLERANCE of the largest variance counts as rounding, since it may enter every other one. A
    filter with the claim "none" has no covariance to judge.
    """
    if claim == "none":
        return _are_finite(prior, claim)
    variances = jnp.diagonal(jnp.asarray(prior.covariance))
    largest = jnp.max(jnp.abs(variances), initial=0.0)
    return _are_finite(prior, claim) & ~jnp.any(variances < -rounding(NEGATIVE_TOLERANCE, variances) * largest)


def _overflows(before: PyTree, after: PyTree) -> jax.Array:
    """Return whether some real number of a state is infinite after the step, but not before it; NaN does not count."""
    has_overflowed = jnp.asarray(False)
    for number_before, number_after in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        if _is_real_array(number_after):
            has_overflowed |= jnp.any(jnp.isinf(jnp.asarray(number_after)) & ~jnp.isinf(jnp.asarray(number_before)))
    return has_overflowed


def _is_real_array(leaf: Array) -> bool:
    """Return whether an array holds real numbers: not integers, booleans or random keys."""
    return bool(jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating))


def _mask_rounded_away(estimates: Estimate) -> jax.Array:
    """Return the mask (n,) of the states with a deviation that is positive, but smaller than their mean's rounding."""
    mean = jnp.asarray(estimates.mean)
    variance = jnp.diagonal(jnp.asarray(estimates.covariance))
    unit = float(np.finfo(mean.dtype).eps) * jnp.abs(mean)  # of rounding
    return jnp.asarray((variance > 0) & (jnp.sqrt(jnp.maximum(variance, 0.0)) < unit))
