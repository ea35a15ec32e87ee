"""Independent paths of hops: what a receiver learns of each from the powers that its transmitters send.

A path tells c x + v over hops `received = g sent + m`, each of them amplifying what it hears to its power p. Its noise,
received over its mean gain less c x, is s K / F - t with s = E y^2, t = s - Var v, K the product of
kappa = E g^2 / (E g)^2 and F that of p / (p + alpha), alpha = Var m / E g^2. So it carries the information
  j = F / (s K - t F),   dj/dp_h = s K / (s K - t F)^2 dF/dp_h:
nothing is divided by a power, which may be zero.
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float, Int
from heliograph.planning.adjoint import Plants, adjoint, covariances

Powers = Float[np.ndarray, "time hop"]


@readable
class Paths(NamedTuple):
    """A linear plant heard over independent paths; every array has a leading time axis, a period or a horizon.

    rows: c of each path. second: s = E y^2; signal: t = s - Var v. path: to which path each hop belongs, in the order
    of the hops. kappa, alpha: of each hop. names: of the hops' transmitters.
    """

    plants: Plants
    rows: Float[np.ndarray, "time path n"]
    second: Float[np.ndarray, "time path"]
    signal: Float[np.ndarray, "time path"]
    path: Int[np.ndarray, "hop"]
    kappa: Float[np.ndarray, "time hop"]
    alpha: Float[np.ndarray, "time hop"]
    names: tuple[str, ...]


class Heard(NamedTuple):
    """Information of each path and its derivative by the power of each hop."""

    information: Float[np.ndarray, "time path"]
    slope: Powers


def fading(paths: Paths) -> Float[np.ndarray, "time path"]:
    """K, the product of kappa along each path."""
    return np.asarray(_along(paths, paths.kappa)[0].prod(axis=-1))


def _along(
    paths: Paths, each: Float[np.ndarray, "time hop"]
) -> tuple[Float[np.ndarray, "time path place"], Int[np.ndarray, "hop"]]:
    """Numbers of hops by path and place on it, 1 where a path has no more; and the place of each hop."""
    order = np.argsort(paths.path, kind="stable")
    counts = np.bincount(paths.path, minlength=paths.second.shape[1])
    place = np.empty_like(paths.path)
    place[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    result = np.ones((len(each), len(counts), max(1, int(counts.max(initial=1)))))
    result[:, paths.path, place] = each
    return result, place


def heard(paths: Paths, powers: Powers) -> Heard:
    """j of each path at each step, and dj/dp of each hop."""
    total = powers + paths.alpha
    passed = np.divide(powers, total, out=np.ones_like(powers), where=total > 0)  # a hop without noise: any power does
    along, place = _along(paths, passed)
    others = np.stack([np.delete(along, h, axis=-1).prod(axis=-1) for h in range(along.shape[-1])], axis=-1)
    whole, full = along.prod(axis=-1), paths.second * fading(paths)
    left = full - paths.signal * whole
    own = np.divide(paths.alpha, total**2, out=np.zeros_like(powers), where=total > 0)
    slope = (full / left**2)[:, paths.path] * others[:, paths.path, place] * own
    return Heard(whole / left, slope)


def informations(paths: Paths, each: Float[np.ndarray, "time path"]) -> Float[np.ndarray, "time n n"]:
    """J = sum_i j_i c_i' c_i."""
    return np.asarray(np.swapaxes(paths.rows, 1, 2) @ (each[:, :, None] * paths.rows))


def error_of(paths: Paths, powers: Powers) -> Float[np.ndarray, "time n n"]:
    """Error covariance of the best linear filter after each step."""
    return covariances(paths.plants, informations(paths, heard(paths, powers).information))


def sensitivities(
    paths: Paths,
    information: Float[np.ndarray, "time path"],
    p: Float[np.ndarray, "time n n"],
    weights: Float[np.ndarray, "time n n"],
) -> Float[np.ndarray, "time path"]:
    """-d cost / d j of each path: w_i = c_i P L P c_i'."""
    ahead = adjoint(paths.plants, informations(paths, information), p, weights)
    told = paths.rows @ p
    return np.asarray(np.sum((told @ ahead) * told, axis=-1))
