"""The most that a path of several hops can tell for its power, and the concave envelope of it: what bounds all designs.

With the power P of a path split at its best, p_h(l) = (sqrt(alpha_h^2 + 4 alpha_h / l) - alpha_h) / 2 with sum P, it
carries j(P) = 1 / (D - t), D = A prod (1 + alpha_h / p_h), A = s K, and dD/dP = -l D. With several hops j is S-shaped.
The ray from zero touches it once, and behind that point it is concave:
  j' P / j = P l D / (D - t) <= 1  if and only if  D (1 - P l) >= t, and the left side never decreases, since
  e = -P l' / l >= 2 - max_h a_h and P l = sum_h a_h with a_h = alpha_h / (p_h + alpha_h), so that e - 2 + P l >= 0;
  j'' <= 0  if and only if  2 P l D / (D - t) <= P l + e, and there the left side is at most 2, the right at least 2.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Float

STEPS = 60  # of the root in l, on a logarithmic scale on which Newton's steps cannot leave it

PathPowers = Float[np.ndarray, "time path"]


class Split(NamedTuple):
    """Powers of the hops of each path, j of it, and dj/dP."""

    powers: Float[np.ndarray, "time path hops"]
    information: PathPowers
    slope: PathPowers


class Whole(NamedTuple):
    """Paths by their whole power: A = s K over what hops whose powers are given let pass, t, and alpha of the others.

    A path with fewer hops than another has zeros among its alphas.
    """

    full: PathPowers
    signal: PathPowers
    alpha: Float[np.ndarray, "time path hops"]


def split(whole: Whole, total: PathPowers) -> Split:
    """The best split of each path's power: one multiplier l for its hops, by Newton's method for log l."""
    alpha, asked = whole.alpha, np.where(total > 0, total, 1.0)[..., None]
    hops = (alpha > 0).sum(axis=-1)
    log = 2 * np.log(np.where(hops[..., None] > 0, np.sqrt(alpha).sum(axis=-1, keepdims=True), 1.0) / asked)
    for _ in range(STEPS):
        p, falls = _shares(alpha, log)
        reached = p.sum(axis=-1, keepdims=True)
        step = np.log(np.divide(reached, asked, out=np.ones_like(asked), where=reached > 0))
        step = np.divide(step * reached, falls, out=np.zeros_like(falls), where=falls > 0)
        log = log + step
        if np.all(np.abs(step) <= 1e-15 * (1 + np.abs(log))):
            break
    p = _shares(alpha, log)[0]
    reached = p.sum(axis=-1, keepdims=True)
    p = p * np.divide(asked, reached, out=np.ones_like(asked), where=reached > 0)
    left = np.divide(p, p + alpha, out=np.ones_like(p), where=alpha > 0).prod(axis=-1)  # A / D
    below = whole.full - whole.signal * left
    sends = (total > 0) | (hops == 0)  # what needs no power is always there
    slope = np.exp(log[..., 0]) * left * whole.full / below**2
    # of no power: one hop begins with the slope 1 / (A alpha), several with none
    first = np.divide(1.0, whole.full * alpha.sum(axis=-1), out=np.zeros_like(left), where=hops == 1)
    return Split(
        np.where(sends[..., None], p, 0.0),
        np.where(sends, left / below, 0.0),
        np.where(hops == 0, 0.0, np.where(sends, slope, first)),
    )


def _shares(alpha: np.ndarray, log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """p_h(l), and -d sum P / d log l."""
    over = np.exp(-log)
    root = np.sqrt(alpha**2 + 4 * alpha * over)
    whole = root + alpha
    p = np.divide(2 * alpha * over, whole, out=np.zeros_like(whole), where=whole > 0)
    falls = np.divide(alpha * over, root, out=np.zeros_like(root), where=root > 0)
    return p, falls.sum(axis=-1, keepdims=True)


class Envelope(NamedTuple):
    """The concave envelope of j(P) on [0, cap]: a ray of this slope up to the power where it touches, then j itself."""

    whole: Whole
    touch: PathPowers
    ray: PathPowers

    def told(self, total: PathPowers) -> tuple[PathPowers, PathPowers]:
        """The envelope and its slope."""
        own = split(self.whole, total)
        on_ray = total < self.touch
        return np.where(on_ray, self.ray * total, own.information), np.where(on_ray, self.ray, own.slope)


def envelope(whole: Whole, cap: PathPowers) -> Envelope:
    """Where the ray touches: D (1 - P l) = t, by bisection in log l, since the left side falls with l."""
    alpha, hops = whole.alpha, (whole.alpha > 0).sum(axis=-1)
    largest = np.maximum(alpha.max(axis=-1), np.finfo(float).tiny)
    low, high = np.log(1e-30 / largest), np.log(1e30 / largest)
    for _ in range(120):
        middle = (low + high) / 2
        rises = _rise(whole, middle) >= whole.signal
        low, high = np.where(rises, middle, low), np.where(rises, high, middle)
    touch = np.where(hops > 1, _shares(alpha, low[..., None])[0].sum(axis=-1), 0.0)
    touch = np.minimum(touch, cap)
    there = split(whole, touch)
    ray = np.divide(there.information, touch, out=np.zeros_like(touch), where=touch > 0)
    return Envelope(whole, touch, ray)


def _rise(whole: Whole, log: PathPowers) -> PathPowers:
    """D (1 - P l)."""
    p = _shares(whole.alpha, log[..., None])[0]
    noise = np.divide(whole.alpha, p, out=np.zeros_like(p), where=p > 0)
    return np.asarray(whole.full * np.prod(1 + noise, axis=-1) * (1 - p.sum(axis=-1) * np.exp(log)))
