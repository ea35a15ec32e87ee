"""The best of several descents, each from powers that are even over some of the paths: once off, a path stays off."""

from collections.abc import Iterator

import numpy as np

from heliograph.numerics.types import Bool, Float, Int
from heliograph.planning.budget import Allowed
from heliograph.planning.descent import COARSE, Found, descend, lower_total, polish
from heliograph.planning.objective import Objective

Mask = Bool[np.ndarray, "time free"]
Powers = Float[np.ndarray, "time free"]

BISECTIONS = 60  # of a factor between 1e-12 and 1e12, on a logarithmic scale
ROUNDS = 6
EXACT = 1e-14  # relative change of the least power that is left


def is_convex(path: Int[np.ndarray, "free"]) -> bool:
    """Whether no path has two free hops: then j is concave in its power, and the error convex and falling in j."""
    return len(set(path.tolist())) == len(path)


def supports(path: Int[np.ndarray, "free"], steps: int, starts: int, seed: int) -> list[Mask]:
    """Which paths send at which step: all at first; every choice if `starts` allow, else drawn ones. One if convex."""
    whole = np.ones((steps, len(path)), dtype=bool)
    if is_convex(path):
        return [whole]
    own, column = np.unique(path, return_inverse=True)
    entries = steps * len(own)
    if entries < 63 and 2**entries - 1 <= starts:
        chosen: Iterator[np.ndarray] = (
            np.array([(number >> i) & 1 for i in range(entries)], dtype=bool) for number in range(2**entries - 2, 0, -1)
        )
    else:
        draws = np.random.default_rng(seed)
        chosen = (draws.uniform(size=entries) < draws.uniform(0.1, 0.9) for _ in range(starts - 1))
    rest = [one.reshape(steps, len(own))[:, column] for one in chosen if np.any(one)]
    return [whole, *rest]


def search(objective: Objective, limits: Allowed, starts: list[Powers]) -> Found:
    """The best of the descents from these powers."""
    found = [Found(start, np.inf) for start in starts]
    for weighing in objective.weighing.sharper():
        objective = objective._replace(weighing=weighing)
        found = [descend(objective, limits, one.powers, COARSE) for one in found]
    best = min(found, key=lambda one: one.error)
    return polish(objective, limits, descend(objective, limits, best.powers))


def least_power(objective: Objective, limits: Allowed, wanted: float, starts: list[Powers]) -> Found | None:
    """The least mean total power found that reaches the wanted error; None where no start can.

    Each start is raised until it does; a sequential quadratic programme lowers the total at that error. The best is
    mended on the budget itself: Newton's method for the total, whose price is the largest slope of the error.
    """
    nothing = np.zeros(starts[0].shape)
    if objective.value(nothing) <= wanted:
        return Found(nothing, 0.0)
    found = []
    for start in starts:
        raised = _raised(objective, limits, wanted, start)
        if raised is not None:
            found.append(lower_total(objective, limits, wanted, raised, COARSE))
    if not found:
        return None
    powers = lower_total(objective, limits, wanted, min(found, key=lambda p: float(p.mean(axis=0).sum())))
    for _ in range(ROUNDS):
        total = float(powers.mean(axis=0).sum())
        powers = polish(objective, limits._replace(total=total), Found(powers, objective.value(powers))).powers
        error, gradient = objective.value_and_gradient(powers)
        price = float(np.max(-gradient * len(powers)))
        grown = total + (error - wanted) / price
        if abs(grown - total) <= EXACT * total:
            break
        powers = np.minimum(powers * (grown / total), limits.peak)
    return Found(powers, float(powers.mean(axis=0).sum()))


def _raised(objective: Objective, limits: Allowed, wanted: float, start: Powers) -> Powers | None:
    """The start times the least factor that reaches the wanted error, as far as peaks and means allow."""

    def at(factor: float) -> Powers:
        grown: Powers = np.minimum(start * factor, limits.peak)
        mean = grown.mean(axis=0)
        return np.asarray(grown * np.divide(limits.each, mean, out=np.ones_like(mean), where=mean > limits.each))

    low, high = 1e-12, 1e12
    if objective.value(at(high)) > wanted:
        return None
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        low, high = (low, middle) if objective.value(at(middle)) <= wanted else (middle, high)
    return at(high)
