"""Relays between a sensor and a receiver on a line: where they stand, how many, and when none is best.

Over the whole way a hop has the noise rho, in units of the total power; over a part d of it rho d^e. With shares q of
the power the noise of the path is s K F - t with F = prod_h (1 + rho d_h^e / q_h) and K = kappa^hops. Where lengths and
shares are best together, d F / d d_h and d F / d q_h are each the same for all hops, and so d_h / q_h is: q = d, and
  log F = sum_h log(1 + rho d_h^(e - 1)),   sum_h d_h = 1.
Each term is convex in d up to a length and concave beyond, so at the least at most one hop is of the longer kind: all
hops are equal, or all but one. That leaves a function of one number, which is searched.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from heliograph.numerics.check import check_count, fail, scalar
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.paths.relaxation import split_power
from heliograph_studies.network_design.theory.splits import path_noise

GRID = 400  # lengths of the short hops that are tried, evenly and on a logarithmic scale
SHORTEST = 1e-9  # of the way

LARGE = 1e6  # a kappa of more is a hop of which nothing arrives


@readable
class RelayLine(NamedTuple):
    """Relays on a line.

    lengths: of each hop, parts of the way. shares: of the total power. noise: K F, as that of the path is s K F - t.
    even: the same for hops of equal length and power. direct: without a relay.
    """

    lengths: Float[np.ndarray, "H"]
    shares: Float[np.ndarray, "H"]
    noise: float
    even: float
    direct: float

    @property
    def sites(self) -> Float[np.ndarray, "H-1"]:
        """Where the relays stand: parts of the way from the sensor."""
        return np.cumsum(self.lengths)[:-1]

    @property
    def words(self) -> str:
        """Whether relays help, in a line."""
        count = len(self.lengths) - 1
        relays = {0: "no relay", 1: "one relay"}.get(count, f"{count} relays")
        return f"{relays}: noise {self.noise:.6g}, {self.even:.6g} with equal hops, {self.direct:.6g} without a relay"


def relay_line(
    rho: ArrayLike, exponent: ArrayLike, relays: int = 1, kappa: ArrayLike = 1.0, nearest: ArrayLike = 0.0
) -> RelayLine:
    """The best sites of so many relays, and the best powers with them.

    rho: noise Var m / (E g^2 P) of one hop over the whole way with all the power; exponent e of the path loss; kappa of
    each hop. No hop is shorter than `nearest`, a part of the way: there a power law would promise signals without end.
    One relay stands best at the midpoint for rho <= 2^e (e / 2 - 1) only, beyond gradually nearer to one end: with
    e = 3 at x (1 - x) = 1 / rho, where the noise is rho, 1 + rho without it. The midpoint is better than no relay for
    rho < 4^(e - 1) - 2^e.

    Raises:
        ValueError: a negative rho, kappa below 1, hops that are longer together than the way.
    """
    r, e = float(scalar("rho", rho, 0.0)), float(scalar("path loss exponent", exponent, 0.0))
    k, least = float(scalar("kappa", kappa, 1.0, LARGE)), float(scalar("nearest", nearest, 0.0, 1.0))
    hops = check_count("relays", relays, 0) + 1
    if hops * least > 1:
        raise fail("relays", f"hops of {least:g} of the way each", f"{hops} of them")
    shortest = max(least, SHORTEST) if hops > 1 else 1.0
    equal = np.full(hops, 1 / hops)
    even = path_noise(r * equal**e, 1.0)
    tried = [_lengths(hops, short) for short in (_short(r, e, hops, shortest), min(shortest, 1 / hops))]
    lengths = min((equal, *tried), key=lambda d: path_noise(r * d**e, 1.0))
    shares = split_power(r * lengths**e, 1.0) if r else lengths.copy()
    return RelayLine(lengths, shares, k**hops * path_noise(r * lengths**e, 1.0), k**hops * even, k * (1 + r))


def best_relays(
    rho: ArrayLike, exponent: ArrayLike, most: int, kappa: ArrayLike = 1.0, nearest: ArrayLike = 0.0
) -> tuple[RelayLine, ...]:
    """The best lines of 0, 1, ..., `most` relays, the best of them first.

    Without fading (kappa = 1) and with e > 2 more relays are always better; kappa above 1 makes each one cost.

    Raises:
        ValueError: what `relay_line` refuses.
    """
    nearest_ = float(scalar("nearest", nearest, 0.0, 1.0))
    counts = [n for n in range(check_count("most relays", most, 0) + 1) if (n + 1) * nearest_ <= 1]
    return tuple(sorted((relay_line(rho, exponent, n, kappa, nearest_) for n in counts), key=lambda line: line.noise))


def _short(rho: float, exponent: float, hops: int, least: float) -> float:
    """The length of all hops but one that makes the noise least."""
    if hops == 1 or least >= 1 / hops:
        return 1 / hops

    def noise(short: float) -> float:
        return float(np.log1p(rho * _lengths(hops, short) ** (exponent - 1)).sum())

    tried = np.unique(np.append(np.geomspace(least, 1 / hops, GRID), np.linspace(least, 1 / hops, GRID)))
    values = np.array([noise(x) for x in tried])
    at = int(np.argmin(values))
    low, high = tried[max(at - 1, 0)], tried[min(at + 1, len(tried) - 1)]
    search = minimize_scalar(noise, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    return float(search.x) if search.fun < values[at] else float(tried[at])


def _lengths(hops: int, short: float) -> Float[np.ndarray, "H"]:
    """All hops but one of this length."""
    return np.append(np.full(hops - 1, short), 1 - (hops - 1) * short)
