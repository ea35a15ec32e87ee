"""Climbs of a log-likelihood, from several starts side by side: where they are, and which go to the same top."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float

NOISE = 1e-13  # rounding of a log-likelihood, as a share of its size
JOINING_DISTANCE = 0.1  # standard errors between two climbs to one top, and of either from it
LEAST_BEND = 0.5  # of the information between two such climbs, that the likelihood bends by at least
UNEXPLAINED_GAIN = 0.1  # of the gain between two such climbs, that their slopes may leave unexplained
NEIGHBOUR_DISTANCE = 1.0  # between logarithms or logits of two such climbs, whatever the information says

# Log-likelihood l, its gradient and its Gauss-Newton information (near the Hessian of -l) at a point of each climb; and
# the function that returns them at such points.
Evaluated = tuple[Float[np.ndarray, " climbs"], Float[np.ndarray, "climbs p"], Float[np.ndarray, "climbs p p"]]
Evaluate = Callable[[Float[np.ndarray, "climbs p"]], Evaluated]


class OpenEnds(NamedTuple):
    """Which unconstrained coordinates have an end of their number's domain at infinity.

    A variance of 0 is at minus infinity of its logarithm, probabilities of 0 and 1 are at both ends of their logit.

    Args:
        low: coordinates with an end at minus infinity (p,).
        high: coordinates with an end at infinity (p,).
        single: coordinates of a number of their own on an interval, whose end can be tried alone (p,); not those of a
            covariance or of probabilities that sum to 1.
    """

    low: Bool[np.ndarray, " p"]
    high: Bool[np.ndarray, " p"]
    single: Bool[np.ndarray, " p"]

    @staticmethod
    def unbounded(count: int) -> "OpenEnds":
        """Return the domains of so many real numbers, without ends."""
        none = np.zeros(count, dtype=bool)
        return OpenEnds(none, none, none)

    @property
    def free(self) -> Bool[np.ndarray, " p"]:
        """Coordinates that are real numbers (no logarithm or logit): they end nowhere, and their scale is unknown."""
        return np.asarray(~(self.low | self.high))


class ClimbEnds(NamedTuple):
    """Where some climbs (searches side by side) end.

    Args:
        x: point of each climb (climbs, p).
        total: log-likelihood there (climbs,).
        gradient: its derivatives (climbs, p).
        converged: whether the climb came to a maximum (climbs,).
        remaining: what a full step would still gain, in nats (climbs,).
        steps: number of steps that were taken.
    """

    x: Float[np.ndarray, "climbs p"]
    total: Float[np.ndarray, " climbs"]
    gradient: Float[np.ndarray, "climbs p"]
    converged: Bool[np.ndarray, " climbs"]
    remaining: Float[np.ndarray, " climbs"]
    steps: int

    @property
    def order(self) -> np.ndarray:
        """Numbers of the climbs from the highest log-likelihood to the lowest; NaN is last."""
        return np.argsort(-np.nan_to_num(self.total, nan=-np.inf), kind="stable")


class Climbs(NamedTuple):
    """Climbs (searches side by side) between two steps.

    Args:
        x: point of each climb (climbs, p).
        total: log-likelihood l there (climbs,).
        gradient: g, its derivatives (climbs, p).
        information: I, the Gauss-Newton information (climbs, p, p).
        model: B, a model of minus the Hessian of l (climbs, p, p).
        radius: of the trust region, in standard errors (climbs,).
        remaining: what a full step would gain, g' I^-1 g / 2, in nats (climbs,).
        done: climbs that go no further (climbs,).
        converged: climbs that came to a maximum (climbs,).
        joined: number of the climb to the same top that each climb joined, its own number if none (climbs,).
    """

    x: np.ndarray
    total: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    model: np.ndarray
    radius: np.ndarray
    remaining: np.ndarray
    done: np.ndarray
    converged: np.ndarray
    joined: np.ndarray

    def ends(self, steps: int) -> ClimbEnds:
        """Return where the climbs are after `steps` steps; one that joined another is where that one is."""
        climb = self.joined
        for _ in range(len(climb)):  # a climb may join one that joins a third
            climb = climb[climb]
        x = self.x[climb]
        total = self.total[climb]
        gradient = self.gradient[climb]
        return ClimbEnds(x, total, gradient, self.converged[climb], self.remaining[climb], steps)


def join_climbs(state: Climbs, moving: np.ndarray, domains: OpenEnds) -> Climbs:
    """Return the state in which each climb a is ended that goes to the same top as a higher climb b.

    A climb is a search for a maximum of the log-likelihood l; several run side by side, and two to one top cost twice
    as much. Both are within JOINING_DISTANCE standard errors of a top and of each other, by the information I of
    either, and less than NEIGHBOUR_DISTANCE apart in every logarithm and logit. Between them, along d = x_b - x_a, l is
    concave: l_b - l_a is (g_a + g_b)' d / 2 as of a quadratic with gradients g, and (g_a - g_b)' d >= LEAST_BEND d' I
    d.

    The result differs in `joined` (the number of b for each a that ends, else as before) and in `done`.
    UNEXPLAINED_GAIN (0.1) is the share of the gain that the quadratic may leave unexplained, NOISE the rounding of l.

    Args:
        state: the climbs: points x, values l (`total`), gradients g, information I; `remaining`, what a full step would
            gain, g' I^-1 g / 2; and which have ended (`done`) or `joined` another.
        moving: coordinates that move (climbs, p).
        domains: `free` is True for coordinates that are plain real numbers, not logarithms or logits.
    """
    climbs = np.arange(len(state.x))
    g = np.nan_to_num(state.gradient)
    d = state.x[None, :] - state.x[:, None]  # [a, b]: from climb a to climb b, (a, b, p)
    # d' I d: the greater of the two values by the information of a and of b; `squared` [c, a, b] uses I of climb c.
    squared = np.einsum("abi,cij,abj->cab", d, np.nan_to_num(state.information), d)
    distance = np.maximum(squared[climbs, climbs, :], squared[climbs, :, climbs].T)
    # [a, b]: l_b - l_a; the same if l were quadratic; and the fall of the slope, (g_a - g_b)' d.
    gain = state.total[None] - state.total[:, None]
    gain_of_quadratic = np.einsum("abi,abi->ab", d, g[:, None] + g[None]) / 2
    slope_fall = np.einsum("abi,abi->ab", d, g[:, None] - g[None])
    near_top = (2 * state.remaining < JOINING_DISTANCE**2) & (state.joined == climbs)  # 2 * remaining: distance squared
    neighbours = np.all(domains.free | (np.abs(d) < NEIGHBOUR_DISTANCE), axis=2)
    neighbours &= np.all(moving[:, None] == moving[None], axis=2)
    is_quadratic = np.abs(gain - gain_of_quadratic) <= UNEXPLAINED_GAIN * gain + NOISE * np.abs(state.total)
    no_saddle = is_quadratic & (slope_fall >= LEAST_BEND * distance)
    same_top = near_top[:, None] & near_top[None] & neighbours & (distance < JOINING_DISTANCE**2) & no_saddle
    # [a, b] is true where b goes on: the higher one, of two that are as high the first.
    is_higher = same_top & ((gain > 0) | ((gain == 0) & (climbs[None] < climbs[:, None])))
    joins = ~state.done & np.any(is_higher, axis=1)
    best = np.argmax(np.where(is_higher, state.total[None], -np.inf), axis=1)
    return state._replace(joined=np.where(joins, best, state.joined), done=state.done | joins)
