"""The linear minimum-mean-square-error filter of a linear system, and the true error of any schedule of gains."""

import warnings
from typing import NamedTuple

import numpy as np

from heliograph.factors.columns import rounding_of
from heliograph.factors.roots import covariance_of_root, observe_root, roots_of
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.linear.system import Gains, LinearSystem, Schedule, Steps, repeat_last
from heliograph.model.estimate import Claim, weakest
from heliograph.model.premises.premise import on_premise
from heliograph.numerics.check import fail, instance
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Float

SPAN, STILL = 100, 1e-12  # steps between comparisons, and what may be left, relatively, of a covariance's way
DIGITS_TOLERANCE = 1e-6  # relative rounding error of a claimed variance above which it is nominal


Pair = tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]  # a covariance and its rounding


class NoiseRoots(NamedTuple):
    """Roots of both noises of one step, with the rounding of what they are added to: Cov(w) = W W', Cov(v) = V V'."""

    process: Float[np.ndarray, "N _"]
    received: Float[np.ndarray, "m _"]


class RecursionStep(NamedTuple):
    """One step of the recursion: gain, and roots of the error covariance before and after the measurement."""

    gain: Float[np.ndarray, "N m"]
    predicted: Float[np.ndarray, "N _"]
    root: Float[np.ndarray, "N N"]


class CarriedRounding(NamedTuple):
    """What rounding of the system's own covariances adds to that of the error, and its largest share of a claimed one.

    `worst` is that share of a claimed variance, of all steps so far, and `when` its step.
    """

    covariance: Float[np.ndarray, "N N"]
    worst: float
    when: int

    def after_step(self, system: LinearSystem, k: int, s: Steps, gains: Gains) -> "CarriedRounding":
        """Return F X F' + (I - G C) D (I - G C)' + G R G' of the rounding X before, with that of Cov(w) and Cov(v).

        An error D in Cov(w) adds as much to the error's covariance; a gain that minimises has no part in it.
        """
        keep = np.eye(len(gains.gain)) - gains.gain @ s.output
        rounding = gains.transition @ self.covariance @ gains.transition.T
        rounding += (keep * system.rounding[k]) @ keep.T
        rounding += (gains.gain * system.received_rounding[k]) @ gains.gain.T
        # Its share of each claimed variance.
        error = np.diag(system.projection @ rounding @ system.projection.T)
        claimed = np.maximum(np.diag(gains.covariance), error)
        share = np.divide(error, claimed, out=np.zeros_like(error), where=error > 0)
        worst, when = max((self.worst, self.when), (float(np.max(share, initial=0.0)), k))
        return CarriedRounding(rounding, worst, when)


def take_noise_roots(s: Steps, size: Float[np.ndarray, " N"]) -> NoiseRoots:
    """Return roots of Cov(w) and Cov(v), beside those of the rounding of a state with second moments `size` before."""
    reach = np.abs(s.output) @ np.sqrt(size)
    return NoiseRoots(_root_with_rounding(s.process, size), _root_with_rounding(s.noise, reach**2))


def _root_with_rounding(covariance: Float[np.ndarray, "n n"], seconds: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return a root of a noise covariance, beside that of the rounding of what the noise is added to.

    `seconds` are the second moments of the numbers it is added to.
    """
    rounding = rounding_of(seconds + np.maximum(np.diag(covariance), 0.0))
    return np.concatenate([roots_of(covariance), rounding.matrix * np.sqrt(rounding.weights)], axis=1)


def covariance_step(root: Float[np.ndarray, "N _"], s: Steps, noises: NoiseRoots) -> RecursionStep:
    """Return P- = A P A' + Cov(w), O = C P- C' + Cov(v), G = P- C' O^-1, P = P- - G C P-, on roots.

    O may be singular (products of a measurement with few values repeat): what repeats has the gain zero.
    """
    predicted = np.concatenate([s.transition @ root, noises.process], axis=1)
    gain, after = observe_root(predicted, s.output, noises.received)
    return RecursionStep(gain, predicted, after)


def lmmse(system: LinearSystem, claim: Claim = "exact") -> Schedule:
    """Return the best linear filter of x = W y from z_1 ... z_k: an ordinary Kalman recursion, since w and v are white.

    `claim` is what the covariance is worth: "exact" if the system's moments are the world's. It is lowered to
    "nominal", with a warning, where rounding in the system's own covariances reaches a visible part of the error's.

    Args:
        system: whose state y is estimated from its measurements z.
        claim: of the schedule (default "exact").

    Raises:
        ValueError: an unknown claim.
    Source: Kalman (1960), with the second moments of random coefficients in the noises.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    root, steps = roots_of(system.covariance), list[Gains]()
    size = system.mean**2 + np.diag(system.covariance)
    noises = take_noise_roots(system.step(0), size)
    rounding = CarriedRounding(np.diag(system.start_rounding), 0.0, 0)
    steady, last = system.steady_from, None
    for k in range(system.horizon):
        # From `steady` on the system is the same: stop where the recursion has come to rest.
        if k > steady and (k - steady) % SPAN == 0:
            now = covariance_of_root(root), rounding.covariance
            if last is not None and _has_converged(now, last, steps[-1].transition):
                break  # what follows is the same, to rounding
            last = now
        s = system.step(k)
        noises = take_noise_roots(s, size) if 0 < k <= steady else noises
        step = covariance_step(root, s, noises)
        gains, root = _make_gains(system, s, step), step.root
        rounding = rounding.after_step(system, k, s, gains)
        steps.append(gains)
    gains = Gains(*(repeat_last(values, system.horizon) for values in zip(*steps, strict=True)))
    claim = _support_claim(claim, rounding.worst, rounding.when)
    return on_premise(Schedule(gains, system.mean, claim), system.kept.premise)


def _make_gains(system: LinearSystem, s: Steps, step: RecursionStep) -> Gains:
    """Return the gains of one step: y+ = (I - G C) A y + ... + G z, of which W y+ is the estimate, and covariances."""
    projection, gain = system.projection, step.gain
    keep = np.eye(len(gain)) - gain @ s.output
    transition, offset = keep @ s.transition, keep @ s.drift - gain @ s.offset
    return Gains(
        transition,
        gain,
        offset,
        output=projection @ transition,
        direct=projection @ gain,
        output_offset=projection @ offset,
        expected=s.output @ s.transition,
        expected_offset=s.output @ s.drift + s.offset,
        covariance=covariance_of_root(projection @ step.root),
        predicted=covariance_of_root(projection @ step.predicted),
        innovation=covariance_of_root(s.output @ step.predicted) + s.noise,
    )


def _has_converged(after: Pair, before: Pair, loop: Float[np.ndarray, "N N"]) -> bool:
    """Return whether a covariance and its rounding are steady, to STILL of each entry's own scale.

    A difference D obeys D+ = F D F' with the loop F = (I - G C) A, so that SPAN steps shrink it by r = rho(F)^(2 SPAN)
    and a change d leaves d r / (1 - r) to come. Without any change a recursion repeats itself, whatever rho is.
    """
    changes = [np.abs(a - b) for a, b in zip(after, before, strict=True)]
    if not any(np.any(change) for change in changes):
        return True
    ratio = spectral_radius(loop) ** (2 * SPAN)
    if ratio >= 1:
        return False
    left = max(1.0, ratio / (1 - ratio))
    units = [np.sqrt(np.abs(np.diag(a))) for a in after]
    return all(
        np.all(left * change <= STILL * np.outer(unit, unit)) for change, unit in zip(changes, units, strict=True)
    )


def _support_claim(claim: Claim, lost: float, step: int) -> Claim:
    """Lower the claim where rounding is more than a small part (`lost`) of a claimed variance."""
    remedy = "use a shorter horizon, a lower degree, units in which the state is near zero, or linear_filter"
    if lost > DIGITS_TOLERANCE:
        warnings.warn(
            f"lmmse: rounding is {lost:.1g} of a claimed variance at step {step}: the state's own moments have "
            f"outgrown the error's, so the claim is nominal; {remedy}",
            stacklevel=3,
        )
        return weakest([claim, "nominal"])
    return claim


def true_covariance(system: LinearSystem, schedule: Schedule) -> Float[np.ndarray, "time q q"]:
    """Return E[(x - xhat)(x - xhat)'] of a schedule run on a system that it need not have been designed for.

    Joint moments of (y, s) are propagated; nothing is assumed of the gains.

    Args:
        system: the world.
        schedule: gains for as many steps and measurements.

    Raises:
        ValueError: a system and a schedule of different lengths or measurements.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    instance("schedule", schedule, Schedule, "a Schedule")
    g, m = schedule.gains, system.steps.offset.shape[-1]
    if schedule.horizon != system.horizon or g.gain.shape[-1] != m:
        got = f"{schedule.horizon} steps of {g.gain.shape[-1]} measurements"
        raise fail("schedule", f"{system.horizon} steps of {m} measurements", got)
    mean, spread = np.append(system.mean, schedule.start), np.pad(system.covariance, (0, len(schedule.start)))
    q, nothing = len(system.projection), np.zeros((len(system.mean), len(schedule.start)))
    covariances = []
    # Maps from (y, s) and (w, v) to (y+, s+ = F s + K z + c, x - xhat = W y+ - L s - J z - d).
    for k in range(system.horizon):
        s, now = system.step(k), Gains(*(field[k] for field in g))
        into = np.concatenate([np.eye(len(nothing)), now.gain @ s.output, system.projection - now.direct @ s.output])
        received = np.concatenate([np.zeros((len(nothing), m)), now.gain, -now.direct])
        maps = np.concatenate([into @ s.transition, np.concatenate([nothing, now.transition, -now.output])], axis=1)
        shift = np.concatenate([np.zeros(len(nothing)), now.offset, -now.output_offset])
        mean = maps @ mean + into @ s.drift + received @ s.offset + shift
        spread = propagate_by_mode(
            maps, spread, propagate_by_mode(into, s.process, propagate_by_mode(received, s.noise, 0.0))
        )
        covariances.append(spread[-q:, -q:] + np.outer(mean[-q:], mean[-q:]))
        mean, spread = mean[:-q], spread[:-q, :-q]
    return np.array(covariances)
