"""The linear minimum-mean-square-error filter of a linear system, and the true error of any schedule of gains."""

import warnings
from typing import NamedTuple

import numpy as np

from heliograph.factors.covariance_factors import rounding_of
from heliograph.factors.square_root_update import covariance_of_root, observe_root, roots_of
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.linear.system import Gains, LinearSystem, Schedule, Steps, repeat_last_step
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import fail, instance
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Float

SPAN = 100  # steps between two comparisons of a covariance, to see whether it has converged
STILL = 1e-12  # relative change that a converged covariance may still make
DIGITS_TOLERANCE = 1e-6  # relative rounding error of a claimed variance above which it is nominal


Pair = tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]  # a covariance and its rounding


class NoiseRoots(NamedTuple):
    """Roots of both noises of one step, Cov(w) = W W' and Cov(v) = V V', with the rounding of state and measurement."""

    process: Float[np.ndarray, "N _"]
    received: Float[np.ndarray, "m _"]


class RecursionStep(NamedTuple):
    """One step of the recursion: gain, and roots of the error covariance before and after the measurement."""

    gain: Float[np.ndarray, "N m"]
    predicted: Float[np.ndarray, "N _"]
    root: Float[np.ndarray, "N N"]


class CarriedRounding(NamedTuple):
    """Error of the filter's covariance by rounding of the system's own covariances (N, N).

    `worst` is its largest share of a claimed variance over all steps so far, and `when` the step of that.
    """

    covariance: Float[np.ndarray, "N N"]
    worst: float
    when: int

    def after_step(self, system: LinearSystem, k: int, matrices: Steps, gains: Gains) -> "CarriedRounding":
        """Return F X F' + (I - G C) D (I - G C)' + G R G' of the rounding X before, with that of Cov(w) and Cov(v).

        D and R are the roundings of Cov(w) and Cov(v), both diagonal. G is the gain, and F = (I - G C) A. The roundings
        change the gain too, but that adds nothing to first order, since the gain minimises the covariance. The largest
        share that X has had of a claimed variance is kept, with its step.

        Args:
            system: y+ = A y + a + w, z = C y+ + c + v, with the roundings of Cov(w) and Cov(v) at each step.
            k: the step.
            matrices: A, C and so on of this step.
            gains: the filter's gain and claimed covariance at this step.
        """
        I_GC = np.eye(len(gains.gain)) - gains.gain @ matrices.output
        rounding = gains.transition @ self.covariance @ gains.transition.T
        rounding += (I_GC * system.rounding[k]) @ I_GC.T
        rounding += (gains.gain * system.received_rounding[k]) @ gains.gain.T
        # Its share of each claimed variance.
        variance = np.diag(system.projection @ rounding @ system.projection.T)
        claimed_variance = np.maximum(np.diag(gains.covariance), variance)
        shares = np.divide(variance, claimed_variance, out=np.zeros_like(variance), where=variance > 0)
        largest_share = float(np.max(shares, initial=0.0))
        if largest_share >= self.worst:
            return CarriedRounding(rounding, worst=largest_share, when=k)
        return CarriedRounding(rounding, self.worst, self.when)


def find_noise_roots(matrices: Steps, size: Float[np.ndarray, " N"]) -> NoiseRoots:
    """Return roots of Cov(w) and Cov(v), with the rounding of a state y whose E[y_i^2] is `size` (N,) joined to them.

    Rounding counts as a further noise, so that no less is claimed than the computation gives. A measurement z = C y + c
    + v is rounded by its size, at most |C| sqrt(size). `matrices` are those of a step, C, Cov(w) and Cov(v) among them.
    """
    received_size = (np.abs(matrices.output) @ np.sqrt(size)) ** 2
    return NoiseRoots(_root_with_rounding(matrices.process, size), _root_with_rounding(matrices.noise, received_size))


def _root_with_rounding(covariance: Float[np.ndarray, "n n"], seconds: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return a root W of a noise covariance plus that of rounding, W W' = Cov + rounding: their columns side by side.

    `seconds` are the second moments (n,) of the numbers to which the noise is added, since the sums are rounded.
    """
    rounding = rounding_of(seconds + np.maximum(np.diag(covariance), 0.0))  # matrix diag(weights) matrix'
    return np.concatenate([roots_of(covariance), rounding.matrix * np.sqrt(rounding.weights)], axis=1)


def step_covariance_roots(root: Float[np.ndarray, "N _"], matrices: Steps, noises: NoiseRoots) -> RecursionStep:
    """Return the gain G and roots of P- and P, given a root of P before: one step of Kalman's recursion.

    P- = A P A' + Cov(w), O = C P- C' + Cov(v), G = P- C' O^-1, P = P- - G C P-, with A and C of the step's `matrices`.
    A root W of P is a matrix with W W' = P; by roots half as many digits are lost. O may be singular (products of a
    measurement with few values repeat): what repeats has the gain zero. `noises` are roots of Cov(w) and Cov(v).
    """
    predicted = np.concatenate([matrices.transition @ root, noises.process], axis=1)
    gain, after = observe_root(predicted, matrices.output, noises.received)
    return RecursionStep(gain, predicted, after)


def lmmse(system: LinearSystem, claim: Claim = "exact") -> Schedule:
    """Return gains of the best linear filter of x = W y from z_1 ... z_k: a Kalman recursion, since w and v are white.

    The system is y+ = A y + a + w, z = C y+ + c + v with white, uncorrelated w and v. Gains and error covariances do
    not depend on data, so they are computed once. They are found by roots, P = root root', which lose fewer digits.
    `claim` says what the covariance is: "exact" if the system's moments are the true ones. It is lowered to "nominal",
    with a warning, if rounding of the system's own covariances is a visible share of the error's.

    Args:
        system: whose state y is estimated from its measurements z.
        claim: of the schedule (default "exact").

    Raises:
        ValueError: an unknown claim.
    Source: Kalman (1960), with the second moments of random coefficients in the noises.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    root = roots_of(system.covariance)  # of P, the error covariance: P = root root'
    gains_by_step = list[Gains]()
    # E[y_i^2] at the start, by whose size the noises' rounding is judged.
    second_moments = system.mean**2 + np.diag(system.covariance)
    noises = find_noise_roots(system.step(0), second_moments)
    rounding = CarriedRounding(covariance=np.diag(system.start_rounding), worst=0.0, when=0)
    steady_from = system.steady_from  # from this step on all steps of the system are equal
    earlier: Pair | None = None  # P and its rounding SPAN steps ago
    for k in range(system.horizon):
        # Where the system is steady, test every SPAN steps whether the error covariance has converged: then all later
        # gains are the last ones, to rounding.
        if k > steady_from and (k - steady_from) % SPAN == 0:
            now = covariance_of_root(root), rounding.covariance
            if earlier is not None and _has_converged(now, earlier, gains_by_step[-1].transition):
                break
            earlier = now
        matrices = system.step(k)
        if 0 < k <= steady_from:  # later steps have the noises of step `steady_from`
            noises = find_noise_roots(matrices, second_moments)
        # P- = A P A' + Q, S = C P- C' + R, K = P- C' S^-1, P = P- - K S K', by roots; then the rounding that P carries.
        covariances = step_covariance_roots(root, matrices, noises)
        gains = _make_gains(system, matrices, covariances)
        root = covariances.root
        rounding = rounding.after_step(system, k, matrices, gains)
        gains_by_step.append(gains)
    over_time = Gains(*(repeat_last_step(values, system.horizon) for values in zip(*gains_by_step, strict=True)))
    claim = _lower_unsupported_claim(claim, rounding.worst, rounding.when)
    return with_assumed(Schedule(over_time, system.mean, claim), system.kept.assumed)


def _make_gains(system: LinearSystem, matrices: Steps, covariances: RecursionStep) -> Gains:
    """Return the gains of one step of the filter of y+ = A y + a + w, z = C y+ + c + v, and its covariances.

    With the estimate s of y and Kalman's gain G, s+ = A s + a + G (z - C (A s + a) - c) is F s + G z + f, where
    F = (I - G C) A and f = (I - G C) a - G c. The estimate of x = W y is W s+ = L s + J z + d with L = W F, J = W G and
    d = W f. The expected measurement is C A s + C a + c.
    """
    W, gain = system.projection, covariances.gain
    I_GC = np.eye(len(gain)) - gain @ matrices.output
    transition, offset = I_GC @ matrices.transition, I_GC @ matrices.drift - gain @ matrices.offset
    return Gains(
        transition,
        gain,
        offset,
        output=W @ transition,
        direct=W @ gain,
        output_offset=W @ offset,
        expected=matrices.output @ matrices.transition,
        expected_offset=matrices.output @ matrices.drift + matrices.offset,
        covariance=covariance_of_root(W @ covariances.root),
        predicted=covariance_of_root(W @ covariances.predicted),
        innovation=covariance_of_root(matrices.output @ covariances.predicted) + matrices.noise,
    )


def _has_converged(after: Pair, before: Pair, loop: Float[np.ndarray, "N N"]) -> bool:
    """Return whether a covariance and its rounding are steady, up to STILL of each entry's own scale.

    `before` holds both as they were SPAN steps ago. An entry's scale is the product of its two deviations.
    A difference D obeys D+ = F D F' with the loop F = (I - G C) A. So SPAN steps shrink it by r = rho(F)^(2 SPAN), and
    after a change d all later changes sum up to d r / (1 - r). If nothing has changed at all, the recursion is steady
    for any rho.
    """
    changes = [np.abs(new - old) for new, old in zip(after, before, strict=True)]
    if not any(np.any(change) for change in changes):
        return True
    r = spectral_radius(loop) ** (2 * SPAN)
    if r >= 1:
        return False
    factor_of_changes_to_come = max(1.0, r / (1 - r))
    for covariance, change in zip(after, changes, strict=True):
        deviations = np.sqrt(np.abs(np.diag(covariance)))
        if not np.all(factor_of_changes_to_come * change <= STILL * np.outer(deviations, deviations)):
            return False
    return True


def _lower_unsupported_claim(claim: Claim, share_of_rounding: float, step: int) -> Claim:
    """Return the claim of a covariance, or warn and lower it to "nominal" if rounding is too large.

    `share_of_rounding` is the largest share that rounding has of a claimed variance, and `step` is the step where it
    occurs. A share up to DIGITS_TOLERANCE is accepted.
    """
    if share_of_rounding <= DIGITS_TOLERANCE:
        return claim
    remedy = "use a shorter horizon, a lower degree, units in which the state is near zero, or linear_filter"
    warnings.warn(
        f"lmmse: rounding is {share_of_rounding:.1g} of a claimed variance at step {step}: the state's own moments "
        f"have outgrown the error's, so the claim is nominal; {remedy}",
        stacklevel=3,
    )
    return weakest([claim, "nominal"])


def true_covariance(system: LinearSystem, schedule: Schedule) -> Float[np.ndarray, "time q q"]:
    """Return E[(x - xhat)(x - xhat)'] over time of a schedule run on a system that it need not have been designed for.

    A schedule is a linear filter with gains known before any data; they may be optimal for another system, or for none.
    Mean and covariance of (y, s), the system's state and the schedule's, are propagated together.

    Args:
        system: the true system, y+ = A y + a + w and z = C y+ + c + v, with x = W y to be estimated.
        schedule: gains for as many steps and measurements, s+ = F s + K z + f and xhat = L s + J z + d.

    Raises:
        ValueError: a system and a schedule of different lengths or measurements.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    instance("schedule", schedule, Schedule, "a Schedule")
    m, received_by_schedule = system.steps.offset.shape[-1], schedule.gains.gain.shape[-1]
    if schedule.horizon != system.horizon or received_by_schedule != m:
        got = f"{schedule.horizon} steps of {received_by_schedule} measurements"
        raise fail("schedule", f"{system.horizon} steps of {m} measurements", got)
    # Mean and covariance of (y, s); at the start s is a known number.
    mean = np.append(system.mean, schedule.start)
    covariance = np.pad(system.covariance, (0, len(schedule.start)))
    q = len(system.projection)
    covariances = []
    for k in range(system.horizon):
        gains = Gains(*(field[k] for field in schedule.gains))
        mean, covariance = _propagate_errors(system.step(k), gains, system.projection, mean, covariance)
        # The last q numbers are the error x - xhat, whose second moment is Cov + mean mean'; the others, (y, s), go
        # into the next step.
        error_mean, error_covariance = mean[-q:], covariance[-q:, -q:]
        covariances.append(error_covariance + np.outer(error_mean, error_mean))
        mean, covariance = mean[:-q], covariance[:-q, :-q]
    return np.array(covariances)


def _propagate_errors(
    step: Steps,
    gains: Gains,
    projection: Float[np.ndarray, "q N"],
    mean: Float[np.ndarray, " joint"],
    covariance: Float[np.ndarray, "joint joint"],
) -> tuple[Float[np.ndarray, " next"], Float[np.ndarray, "next next"]]:
    """Return mean and covariance of (y+, s+, x - xhat) after a step from those of (y, s) before it.

    So the error of a filter of fixed gains is known before any data, also under another model than its own. The system
    is y+ = A y + a + w, z = C y+ + c + v and x = W y+ (`projection`); the filter, of state s, is the schedule of gains
    s+ = F s + K z + f and xhat = L s + J z + d. Put together,

        (y+, s+, x - xhat) = M y+ + N (c + v) + S s + (0, f, -d),
        M = [I; K C; W - J C],  N = [0; K; -J],  S = [0; F; -L].
    """
    # The matrices M, N and S, and the constants (0, f, -d).
    A, C, K, J = step.transition, step.output, gains.gain, gains.direct
    size, m = len(A), len(step.noise)
    states = len(mean) - size
    M = np.concatenate([np.eye(size), K @ C, projection - J @ C])
    N = np.concatenate([np.zeros((size, m)), K, -J])
    S = np.concatenate([np.zeros((size, states)), gains.transition, -gains.output])
    offset = np.concatenate([np.zeros(size), gains.offset, -gains.output_offset])
    # In (y, s), w and v: [M A, S] (y, s) + M (a + w) + N (c + v) + offset.
    maps = np.concatenate([M @ A, S], axis=1)
    mean = maps @ mean + M @ step.drift + N @ step.offset + offset
    noise = propagate_by_mode(M, step.process, propagate_by_mode(N, step.noise, 0.0))  # M Cov(w) M' + N Cov(v) N'
    return mean, propagate_by_mode(maps, covariance, noise)
