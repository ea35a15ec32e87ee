"""What no allocation can beat: the error of paths that carry the concave envelope of what they can."""

import numpy as np

from heliograph.numerics.types import Bool, Float
from heliograph.planning.budget import Allowed
from heliograph.planning.envelope import Whole, envelope
from heliograph.planning.objective import Objective
from heliograph.planning.paths import Heard, Paths, fading

DEAD = 1e150  # noise of a path in which a hop that is not free sends nothing

Powers = Float[np.ndarray, "time hop"]


def whole_paths(paths: Paths, free: Bool[np.ndarray, "hop"], held: Powers) -> Whole:
    """Paths by the power that their free hops send together."""
    full = paths.second * fading(paths)
    hops = [np.flatnonzero((paths.path == i) & free) for i in range(full.shape[1])]
    alpha = np.zeros((*full.shape, max(1, max(len(own) for own in hops))))
    for i, own in enumerate(hops):
        alpha[:, i, : len(own)] = paths.alpha[:, own]
    total = held + paths.alpha
    passed = np.divide(held, total, out=np.ones_like(held), where=total > 0)
    for h in np.flatnonzero(~free):
        i = paths.path[h]
        full[:, i] = np.where(passed[:, h] > 0, full[:, i] / np.maximum(passed[:, h], 1 / DEAD), DEAD)
    return Whole(np.minimum(full, DEAD), paths.signal, alpha)


def relaxed(
    paths: Paths, objective: Objective, limits: Allowed, free: Bool[np.ndarray, "hop"], held: Powers
) -> tuple[Objective, Allowed]:
    """The error by the power of whole paths, and what the budget allows them: never above that of any allocation.

    A path may send what its hops may together, and split it as it likes.
    """
    count, own = paths.second.shape[1], paths.path[free]
    peak, each = np.zeros((len(held), count)), np.zeros(count)
    np.add.at(peak.T, own, limits.peak.T)
    np.add.at(each, own, limits.each)
    cap = np.minimum(np.minimum(peak, each * len(held)), limits.total * len(held))
    bound = envelope(whole_paths(paths, free, held), cap)

    def tell(powers: Powers) -> Heard:
        return Heard(*bound.told(powers))

    return objective._replace(path=np.arange(count), tell=tell), limits._replace(peak=peak, each=each)
