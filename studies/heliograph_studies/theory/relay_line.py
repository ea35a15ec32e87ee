"""Where relays stand between a sensor and a receiver, and how many there should be.

Over the whole way a hop has the noise rho, in units of the total power; over a part d of it rho d^e.
With shares q of the power the noise of the path is s K F - t with F = prod_h (1 + rho d_h^e / q_h) and K = kappa^hops.
Where lengths and shares are best together, d F / d d_h and d F / d q_h are each the same for all hops, and so d_h /
q_h is: q = d, and
  log F = sum_h log(1 + rho d_h^(e - 1)),   sum_h d_h = 1.
Each term is convex in d up to a length and concave beyond, so at the least at most one hop is of the longer kind: all
hops are equal, or all but one. That leaves a function of one number, which is searched.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from heliograph.numerics.check import check_count, scalar
from heliograph.numerics.types import Float

GRID = 400  # lengths of the short hops that are tried, evenly and on a logarithmic scale
SHORTEST = 1e-9  # of the way


class RelayLine(NamedTuple):
    """Relays on a line.

    lengths: of each hop, parts of the way, and the shares of the total power. noise: K F, as that of the path is
    s K F - t. even: the same for hops of equal length. direct: without a relay.
    """

    lengths: Float[np.ndarray, "H"]
    noise: float
    even: float
    direct: float

    @property
    def sites(self) -> Float[np.ndarray, "H-1"]:
        """Where the relays stand: parts of the way from the sensor."""
        return np.cumsum(self.lengths)[:-1]


def relay_line(rho: float, exponent: float, relays: int = 1, kappa: float = 1.0) -> RelayLine:
    """Best sites of so many relays, and the noise with them.

    rho: noise Var m / (E g^2 P) of one hop over the whole way with all the power; exponent e of the path loss, at least
    1; kappa of each hop. One relay stands best at the midpoint for rho <= 2^e (e / 2 - 1) only, beyond gradually nearer
    to one end: with e = 3 at x (1 - x) = 1 / rho, where the noise is rho, 1 + rho without it. The midpoint is better
    than no relay for rho < 4^(e - 1) - 2^e.

    Raises:
        ValueError: a negative rho, an exponent or kappa below 1.
    """
    for name, value, least in (("rho", rho, 0.0), ("path loss exponent", exponent, 1.0), ("kappa", kappa, 1.0)):
        scalar(name, value, least)
    hops = check_count("relays", relays, 0) + 1
    equal, best = np.full(hops, 1 / hops), _lengths(hops, _short(rho, exponent, hops))
    noise, even = (kappa**hops * float(np.exp(_log_noise(rho, exponent, d))) for d in (best, equal))
    return RelayLine(best if noise < even else equal, min(noise, even), even, kappa * (1 + rho))


def best_relays(rho: float, exponent: float, most: int, kappa: float = 1.0) -> list[RelayLine]:
    """Best lines of 0, 1, ..., `most` relays, the best of them first.

    Without fading (kappa = 1) and with e > 2 more relays are always better; kappa above 1 makes each one cost.

    Raises:
        ValueError: what `relay_line` refuses.
    """
    lines = [relay_line(rho, exponent, n, kappa) for n in range(check_count("most relays", most, 0) + 1)]
    return sorted(lines, key=lambda line: line.noise)


def _short(rho: float, exponent: float, hops: int) -> float:
    """Length of all hops but one that makes the noise least."""
    if hops == 1:
        return 1.0

    def noise(short: float) -> float:
        return _log_noise(rho, exponent, _lengths(hops, short))

    tried = np.unique(np.append(np.geomspace(SHORTEST, 1 / hops, GRID), np.linspace(SHORTEST, 1 / hops, GRID)))
    values = np.array([noise(x) for x in tried])
    at = int(np.argmin(values))
    low, high = tried[max(at - 1, 0)], tried[min(at + 1, len(tried) - 1)]
    search = minimize_scalar(noise, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    return float(search.x) if search.fun < values[at] else float(tried[at])


def _lengths(hops: int, short: float) -> Float[np.ndarray, "H"]:
    """All hops but one of this length."""
    return np.append(np.full(hops - 1, short), 1 - (hops - 1) * short)


def _log_noise(rho: float, exponent: float, lengths: Float[np.ndarray, "H"]) -> float:
    """log F with shares of the power that are the lengths."""
    return float(np.log1p(rho * lengths ** (exponent - 1)).sum())
