"""The linear minimum-mean-square-error filter of a linear system, and the true error of any schedule of gains."""

import warnings
from typing import NamedTuple

import numpy as np

from heliograph.linear.jump_system import moved
from heliograph.linear.system import Gains, LinearSystem, Schedule, Steps, over_horizon
from heliograph.model.estimate import Claim, weakest
from heliograph.model.premise import believing
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, fail, instance
from heliograph.numerics.lapack import pseudo_solve, spectral_radius
from heliograph.numerics.linalg import PRECISE, with_rounding
from heliograph.numerics.types import Float

SPAN, STILL = 100, 1e-12  # steps between comparisons, and what may be left, relatively, of a covariance's way
DIGITS_TOLERANCE = 1e-6  # relative rounding error of a claimed variance above which it is nominal


Pair = tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"]]  # a covariance and its rounding


class Corrected(NamedTuple):
    """One step of the covariance recursion: gain, error covariance before and after the measurement."""

    gain: Float[np.ndarray, "N m"]
    predicted: Float[np.ndarray, "N N"]
    covariance: Float[np.ndarray, "N N"]


def covariance_step(
    spread: Float[np.ndarray, "N N"], s: Steps, size: Float[np.ndarray, " N"] | float = 0.0
) -> Corrected:
    """P- = A P A' + Cov(w), O = C P- C' + Cov(v), G = P- C' O^-1, P = P- - G C P-.

    O may be singular (products of a measurement with few values repeat): then directions it does not have are skipped.
    Of a variance of which next to nothing is left the mean cannot say ((N + 2) eps)^2 `size`, E[y^2] at the start.
    """
    predicted = s.transition @ spread @ s.transition.T + s.process
    cross = s.output @ predicted
    total = cross @ s.output.T + s.noise
    gain = pseudo_solve(total, cross).T
    rounded = with_rounding(predicted, len(cross))
    variances = np.diag(s.noise)
    if np.all(variances >= 0) and np.any(variances < PRECISE * np.diag(total)):  # P - G C P lost digits
        keep, units = np.eye(len(gain)) - gain @ s.output, np.diag(rounded - predicted) ** 2
        known = np.diag(units / np.where(units > 0, np.diag(predicted), 1.0))
        after = keep @ predicted @ keep.T + gain @ s.noise @ gain.T + known
        whole, unit = np.diag(predicted), (len(gain) + 2) * np.finfo(float).eps
        after += np.diag(np.where(np.diag(after) < PRECISE * whole, np.minimum(unit**2 * size, whole), 0.0))
    else:
        after = rounded - gain @ cross
    return Corrected(gain, predicted, (after + after.T) / 2)


def information_step(
    predicted: Float[np.ndarray, "*nodes n n"], information: Float[np.ndarray, "*nodes n n"]
) -> Float[np.ndarray, "*nodes n n"]:
    """P = (P-^-1 + J)^-1 = (I + P- J)^-1 P- by the information J = C' Cov(v)^-1 C; P- may be singular."""
    after = np.linalg.solve(np.eye(predicted.shape[-1]) + predicted @ information, predicted)
    return np.asarray(after + after.swapaxes(-1, -2)) / 2


def nearest_covariance(a: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """The positive semidefinite matrix nearest to a symmetric one, by its correlation matrix: zero for what is below.

    Of noises that are differences of larger moments, the rounding of these may leave less than nothing.
    """
    deviation = np.sqrt(np.maximum(np.diag(a), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    values, vectors = np.linalg.eigh(np.where(np.outer(deviation, deviation) > 0, a, 0.0) / np.outer(unit, unit))
    if values[0] >= -DEFINITENESS_TOLERANCE and np.all(np.diag(a) >= 0):
        return a
    root = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(root @ root.T)


def lmmse(system: LinearSystem, claim: Claim = "exact") -> Schedule:
    """The best linear filter of x = W y from z_1 ... z_k: an ordinary Kalman recursion, since w and v are white.

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
    spread, projection, parts = system.covariance, system.projection, []
    size = system.mean**2 + np.diag(spread)
    rounding, worst, when = np.diag(system.start_rounding), 0.0, 0
    steady, transition = system.steady_from, np.eye(len(spread))
    last: tuple[np.ndarray, np.ndarray] | None = None
    for k in range(system.horizon):
        if k > steady and (k - steady) % SPAN == 0:
            if last is not None and _is_still((spread, rounding), last, transition):
                break  # what follows is the same, to rounding
            last = spread, rounding
        s = system.step(k)
        gain, predicted, spread = covariance_step(spread, s, size)
        keep = np.eye(len(spread)) - gain @ s.output
        transition, offset = keep @ s.transition, keep @ s.drift - gain @ s.offset
        expected = s.output @ s.transition, s.output @ s.drift + s.offset
        estimate = projection @ transition, projection @ gain, projection @ offset
        claimed = nearest_covariance(projection @ spread @ projection.T)
        innovation = s.output @ predicted @ s.output.T + s.noise
        before = nearest_covariance(projection @ predicted @ projection.T), innovation
        parts.append((transition, gain, offset, *estimate, *expected, claimed, *before))
        # what an error diag(rounding) in Cov(w) adds to the error's covariance: a gain that minimises has no part in it
        rounding = transition @ rounding @ transition.T + (keep * system.rounding[k]) @ keep.T
        rounding += (gain * system.received_rounding[k]) @ gain.T
        error = np.diag(projection @ rounding @ projection.T)
        share = np.divide(error, np.maximum(np.diag(claimed), error), out=np.zeros_like(error), where=error > 0)
        worst, when = max((worst, when), (float(np.max(share, initial=0.0)), k))
    gains = Gains(*(over_horizon(values, system.horizon) for values in zip(*parts, strict=True)))
    return believing(Schedule(gains, system.mean, _supported(claim, worst, when)), system.kept.premise)


def _is_still(after: Pair, before: Pair, loop: Float[np.ndarray, "N N"]) -> bool:
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


def _supported(claim: Claim, lost: float, step: int) -> Claim:
    """The claim that is left where rounding is `lost` of a claimed variance."""
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
    """E[(x - xhat)(x - xhat)'] of a schedule run on a system that it need not have been designed for.

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
        spread = moved(maps, spread, moved(into, s.process, moved(received, s.noise, 0.0)))
        covariances.append(spread[-q:, -q:] + np.outer(mean[-q:], mean[-q:]))
        mean, spread = mean[:-q], spread[:-q, :-q]
    return np.array(covariances)
