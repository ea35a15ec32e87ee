"""Best split of a path's power over its hops, the information that it gives, and the envelope that bounds it.

With the power P of a path split at its best, p_h(l) = (sqrt(alpha_h^2 + 4 alpha_h / l) - alpha_h) / 2 with sum P, it
carries j(P) = 1 / (D - t), D = A prod (1 + alpha_h / p_h), A = s K, and dD/dP = -l D. With several hops j is S-shaped.
The ray from zero touches it once, and behind that point it is concave:
  j' P / j = P l D / (D - t) <= 1  if and only if  D (1 - P l) >= t, and the left side never decreases, since
  e = -P l' / l >= 2 - max_h a_h and P l = sum_h a_h with a_h = alpha_h / (p_h + alpha_h), so that e - 2 + P l >= 0;
  j'' <= 0  if and only if  2 P l D / (D - t) <= P l + e, and there the left side is at most 2, the right at least 2.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import array, fail, scalar
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.planning.multihop_paths.model import (
    Paths,
    PathValues,
    Powers,
    compute_path_kappas,
    require_at_least,
    share_of_signal,
)

NEWTON_STEPS = 60  # of the root in l, on a logarithmic scale on which Newton's steps cannot leave it
BISECTIONS = 120  # of log l between ends: 2^-120 of their distance, 138, is far below its rounding
MULTIPLIER_ENDS = 1e-30, 1e30  # of l, times the largest alpha
CONVERGED_STEP = 1e-15  # relative change of log l at which Newton's steps end
DEAD_PATH_NOISE = 1e150  # noise of a path in which a hop that is not free sends nothing
LARGEST = 1e100  # powers and noises, whose squares doubles hold

Hops = Float[np.ndarray, "time path hops"]


class PowerSplit(NamedTuple):
    """Best split of each path's power P over its hops.

    Args:
        powers: power of each hop (time, path, hops).
        information: j, what the path then carries (time, path).
        slope: dj/dP (time, path).
    """

    powers: Hops
    information: PathValues
    slope: PathValues


class SplitPaths(NamedTuple):
    """Paths by the power P that their free hops send together: j = 1 / (A prod_h (1 + alpha_h / p_h) - t), sum p_h = P.

    Args:
        full: A = s K over what hops of fixed power let pass (time, path).
        signal: t (time, path).
        alpha: noise of each free hop in units of sent power, 0 where a path has fewer hops than another
            (time, path, hops).
    """

    full: PathValues
    signal: PathValues
    alpha: Hops


def split_paths(paths: Paths, free: Bool[np.ndarray, "hop"], fixed: Powers) -> SplitPaths:
    """Return the paths as functions of the total power of their free hops, while other hops send the powers `fixed`.

    A path's information is j = 1 / (A prod_h (1 + alpha_h / p_h) - t), with the product over its free hops. A (`full`)
    is s K prod (1 + alpha / p) over the hops of fixed power, s = E y^2 (`second`) and K the product of all kappa.
    `fixed`: powers (time, hop). DEAD_PATH_NOISE: the A of a path through a hop that sends nothing.
    """
    full = paths.second * compute_path_kappas(paths)
    # Gather alpha of the free hops by path.
    free_hops = [np.flatnonzero((paths.path == i) & free) for i in range(full.shape[1])]
    alpha = np.zeros((*full.shape, max(1, max(len(hops) for hops in free_hops))))
    for i, hops in enumerate(free_hops):
        alpha[:, i, : len(hops)] = paths.alpha[:, hops]
    # A hop of fixed power divides `full` by its share of signal, p / (p + alpha).
    share = share_of_signal(fixed, paths.alpha)
    for h in np.flatnonzero(~free):
        i = paths.path[h]
        full[:, i] = np.where(
            share[:, h] > 0, full[:, i] / np.maximum(share[:, h], 1 / DEAD_PATH_NOISE), DEAD_PATH_NOISE
        )
    return SplitPaths(full=np.minimum(full, DEAD_PATH_NOISE), signal=paths.signal, alpha=alpha)


def split_power(alpha: "Float[ArrayLike, ' H']", total: "Float[ArrayLike, '']") -> Float[np.ndarray, "H"]:
    """Return the powers p_h >= 0 of a given sum with the least noise factor prod_h (1 + alpha_h / p_h) of a chain.

    They are p_h = (sqrt(alpha_h^2 + 4 alpha_h / l) - alpha_h) / 2, where the sum determines the multiplier l. Plant,
    sensor and fading do not matter. Two hops share as sqrt(alpha_1 (P + alpha_2)) to sqrt(alpha_2 (P + alpha_1)).

    Args:
        alpha: noise of each hop in units of sent power, Var m / E g^2, shape (H,). A hop without noise gets nothing.
        total: the sum P of the powers.

    Returns:
        The powers, shape (H,).

    Raises:
        ValueError: a negative noise or total, no hops, or numbers whose squares overflow or underflow.
    """
    noise = check_hop_noises(alpha)
    power = float(scalar("total power", total, 0.0))
    if not np.any(noise):
        return np.zeros(len(noise))
    if power and not 1 / LARGEST <= power <= LARGEST:
        raise fail("total power", f"0, or a number from {1 / LARGEST:g} to {LARGEST:g}", f"{power:g}")
    one = np.ones((1, 1))  # one step of one path
    path = SplitPaths(full=one, signal=0 * one, alpha=noise[None, None])
    return np.asarray(split_power_over_hops(path, power * one).powers[0, 0])


def check_hop_noises(alpha: ArrayLike) -> Float[np.ndarray, "H"]:
    """Return alpha = (noise variance) / E[gain^2] of a path's hops (H,), nonnegative and small enough to square."""
    noise = require_at_least(0.0, "alpha of hops", array("alpha of hops", alpha, (None,)))
    if not len(noise):
        raise fail("alpha of hops", "at least one", "none")
    if np.max(noise) > LARGEST:
        raise fail("alpha of hops", f"numbers of at most {LARGEST:g}", f"{np.max(noise):g}")
    return noise


def split_power_over_hops(whole: SplitPaths, total: PathValues) -> PowerSplit:
    """Return the split of each path's power P over its free hops that is best, with the path's information j and dj/dP.

    A path is a chain of relays that amplify; p_h is the power that free hop h sends, and alpha_h its noise variance in
    units of sent power. With D = A prod_h (1 + alpha_h / p_h) the path's information on the measured signal is
    j = 1 / (D - t). It is greatest where all d log D / dp_h equal -l, with a Lagrange multiplier l for sum_h p_h = P;
    then dD/dP = -l D.

    Args:
        whole: A (`full`), which is D at infinite powers, and t (`signal`), of each path at each step (time, path); and
            alpha (time, path, hop), 0 where a path has fewer hops than another.
        total: the power P of each path at each step (time, path).
    """
    alpha = whole.alpha
    power = np.where(total > 0, total, 1.0)[..., None]  # any power where there is none: see below
    hops = (alpha > 0).sum(axis=-1)  # number of a path's free hops with noise
    # The powers p_h(l), (time, path, hop), of exactly this sum.
    log_l = _find_multiplier(alpha, power)
    p, _ = _split_at_multiplier(alpha, log_l)
    reached = p.sum(axis=-1, keepdims=True)
    p = p * np.divide(power, reached, out=np.ones_like(power), where=reached > 0)
    # j = (A / D) / (A - t A / D) and dj/dP = l D / (D - t)^2, in the ratio A / D, which vanishes with a power.
    ratio = share_of_signal(p, alpha).prod(axis=-1)
    denominator = whole.full - whole.signal * ratio  # A - t A / D
    sends = (total > 0) | (hops == 0)  # a path that needs no power is always there
    slope = np.exp(log_l[..., 0]) * ratio * whole.full / denominator**2
    # Without power the information j is 0; its slope is 1 / (A alpha) with one hop, and 0 with several.
    slope_at_zero = np.divide(1.0, whole.full * alpha.sum(axis=-1), out=np.zeros_like(ratio), where=hops == 1)
    return PowerSplit(
        powers=np.where(sends[..., None], p, 0.0),
        information=np.where(sends, ratio / denominator, 0.0),
        slope=np.where(hops == 0, 0.0, np.where(sends, slope, slope_at_zero)),
    )


def _find_multiplier(alpha: Hops, power: np.ndarray) -> np.ndarray:
    """Return log l of each path (time, path, 1), with the multiplier l at which sum_h p_h(l) is the path's power P.

    Newton's method is applied to log sum_h p_h as a function of log l. It starts at l = (sum_h sqrt(alpha_h) / P)^2,
    which is exact for large P.

    Args:
        alpha: noise of each hop in units of sent power (time, path, hop), 0 where a path has fewer.
        power: P > 0 of each path (time, path, 1).
    """
    has_hops = (alpha > 0).any(axis=-1, keepdims=True)
    log_l: np.ndarray = 2 * np.log(np.where(has_hops, np.sqrt(alpha).sum(axis=-1, keepdims=True), 1.0) / power)
    for _ in range(NEWTON_STEPS):
        p, negative_slope = _split_at_multiplier(alpha, log_l)
        total = p.sum(axis=-1, keepdims=True)
        excess = np.log(np.divide(total, power, out=np.ones_like(power), where=total > 0))
        # Newton's step: the slope of log(sum p) by log l is (d sum p / d log l) / sum p.
        step = np.divide(excess * total, negative_slope, out=np.zeros_like(total), where=negative_slope > 0)
        log_l = log_l + step
        if np.all(np.abs(step) <= CONVERGED_STEP * (1 + np.abs(log_l))):
            break
    return log_l


def _split_at_multiplier(alpha: np.ndarray, log_l: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return p_h(l) of each hop (time, path, hop), and -d sum_h p_h / d log l of each path (time, path, 1).

    p_h = 2 (alpha / l) / (root + alpha) with root = sqrt(alpha^2 + 4 alpha / l). This equals (root - alpha) / 2, but
    loses no digits by cancellation.

    Args:
        alpha: noise of each hop in units of sent power (time, path, hop), 0 where a path has fewer.
        log_l: logarithm of the multiplier l of each path (time, path, 1).
    """
    inverse = np.exp(-log_l)
    root = np.sqrt(alpha**2 + 4 * alpha * inverse)
    denominator = root + alpha
    p = np.divide(2 * alpha * inverse, denominator, out=np.zeros_like(denominator), where=denominator > 0)
    negative_slopes = np.divide(alpha * inverse, root, out=np.zeros_like(root), where=root > 0)
    return p, negative_slopes.sum(axis=-1, keepdims=True)


class Envelope(NamedTuple):
    """Concave envelope of the information j(P) of each path on [0, cap]: a ray from 0 up to a power, then j itself.

    Args:
        whole: the paths, with j as a function of their power P.
        touch: power up to which the ray goes, where it touches j (time, path).
        ray: slope of the ray (time, path).
    """

    whole: SplitPaths
    touch: PathValues
    ray: PathValues

    def information(self, total: PathValues) -> tuple[PathValues, PathValues]:
        """Return the concave envelope of the information, and its slope, at these powers of the paths.

        It is the least concave function above the information: a line of slope `self.ray` from 0 up to the power
        `self.touch`, and the information itself beyond.
        """
        exact = split_power_over_hops(self.whole, total)
        on_ray = total < self.touch
        return np.where(on_ray, self.ray * total, exact.information), np.where(on_ray, self.ray, exact.slope)


def compute_envelope(whole: SplitPaths, cap: PathValues) -> Envelope:
    """Return the concave envelope of each path's information j(P) over its power P on [0, cap], cap (time, path).

    j = 1 / (D - t) with D = A prod_h (1 + alpha_h / p_h): A (`full`) and t (`signal`) are constants of a path, alpha_h
    the noise of its hops and p_h their powers. The best split of P = sum_h p_h has one multiplier l, dD/dP = -D l. With
    several hops j is S-shaped, and the envelope begins with a ray from 0. It touches j where j = P dj/dP, which is
    D (1 - P l) = t: found by bisection in log l, as the left side falls with l.

    Args:
        whole: the paths, as functions of the power that their free hops send together.
        cap: largest power of each path (time, path).
    """
    alpha, hops = whole.alpha, (whole.alpha > 0).sum(axis=-1)
    largest = np.where(hops > 0, alpha.max(axis=-1), 1.0)
    low, high = (np.log(end / largest) for end in MULTIPLIER_ENDS)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        p, _ = _split_at_multiplier(alpha, middle[..., None])
        noise = np.divide(alpha, p, out=np.zeros_like(p), where=p > 0)
        left_side = whole.full * np.prod(1 + noise, axis=-1) * (1 - p.sum(axis=-1) * np.exp(middle))
        is_above = left_side >= whole.signal
        low = np.where(is_above, middle, low)
        high = np.where(is_above, high, middle)
    # The power where the ray touches, at most the cap, and its slope j(P) / P.
    p, _ = _split_at_multiplier(alpha, low[..., None])
    touch = np.minimum(np.where(hops > 1, p.sum(axis=-1), 0.0), cap)
    at_touch = split_power_over_hops(whole, touch)
    ray = np.divide(at_touch.information, touch, out=np.zeros_like(touch), where=touch > 0)
    return Envelope(whole, touch, ray)
