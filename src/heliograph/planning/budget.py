"""Power budgets: what transmitters may send, and the best allocation within them for a linear cost, by a sort."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, SupportsFloat, cast

import numpy as np

from heliograph.numerics.check import fail, instance, scalar, table
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Bool, Float

MET = 1e-9  # relative excess over a limit that counts as met


@readable
class Budget(Module):
    """Limits of power: of all transmitters together, of each one's mean over time, of each one at every step.

    `each` and `peak` are one number for every transmitter or numbers by name. Transmitters that are not free count
    towards the total.

    Raises:
        ValueError: no limit at all, a negative one.
    """

    total: float | None
    each: float | dict[str, float] | None
    peak: float | dict[str, float] | None

    def __init__(
        self,
        total: ArrayLike | None = None,
        each: ArrayLike | Mapping[str, float] | None = None,
        peak: ArrayLike | Mapping[str, float] | None = None,
    ):
        self.total = None if total is None else float(scalar("total power", total, 0.0))
        self.each, self.peak = _limits("power of each", each), _limits("peak power", peak)
        if self.total is None and self.each is None and self.peak is None:
            raise fail("budget", "a total, a limit of each transmitter or a peak", "none")


def as_budget(value: object) -> Budget:
    """A budget; a number is that of the total power."""
    if isinstance(value, Budget):
        return value
    try:
        number = float(cast(SupportsFloat, value))
    except (TypeError, ValueError):
        return instance("budget", value, Budget, "a number (the total power) or a Budget")
    return Budget(number)


def _limits(name: str, value: ArrayLike | Mapping[str, float] | None) -> float | dict[str, float] | None:
    if value is None:
        return None
    if isinstance(value, Mapping):
        named = table(name, value, "powers")
        return {key: float(scalar(f"{name} {key!r}", one, 0.0)) for key, one in named.items()}
    return float(scalar(name, value, 0.0))


class Allowed(NamedTuple):
    """The powers p >= 0 (time, free transmitter) that a budget allows: a polytope.

    peak: of each entry; each: of the mean over time of each column; total: of the mean over time of their sum.
    """

    peak: Float[np.ndarray, "time free"]
    each: Float[np.ndarray, "free"]
    total: float

    def most(self, gain: Float[np.ndarray, "time free"]) -> Float[np.ndarray, "time free"]:
        """The allowed q with the largest gain.q, zero where there is none: limits are nested, so a sort."""
        result, steps = np.zeros_like(gain), len(gain)
        left, each = self.total * steps, self.each * steps
        for flat in np.argsort(-gain, axis=None, kind="stable"):
            k, h = np.unravel_index(flat, gain.shape)
            if gain[k, h] <= 0 or left <= 0:
                break
            if not np.isfinite(one := min(float(self.peak[k, h]), float(each[h]), left)):
                raise fail("budget", "one that limits every transmitter that helps", "no limit")
            result[k, h] = one
            each[h] -= one
            left -= one
        return result

    def even(self, on: Bool[np.ndarray, "time free"]) -> Float[np.ndarray, "time free"]:
        """The largest allowed powers that are equal wherever `on` and no narrower limit holds."""
        limit = np.where(on, np.minimum(self.peak, self.each), 0.0)  # a limit of the mean, kept at every step
        if not np.isfinite(self.total):
            return limit
        level = _level(limit.ravel(), self.total * len(on))
        return np.minimum(limit, level)

    def fits(self, p: Float[np.ndarray, "time free"]) -> bool:
        """Whether p is allowed."""
        room = 1 + MET
        return bool(
            np.all(p >= 0)
            and np.all(p <= self.peak * room)
            and np.all(p.mean(axis=0) <= self.each * room)
            and p.mean(axis=0).sum() <= self.total * room
        )


def _level(limit: Float[np.ndarray, "k"], total: float) -> float:
    """The level at which numbers min(limit, level) sum to the total, infinite if they never do."""
    ordered = np.sort(limit)
    for i, one in enumerate(ordered):
        level = total / (len(ordered) - i)
        if level <= one:
            return float(level)
        total -= one
    return float("inf")


def allowed(
    budget: Budget, names: Sequence[str], free: Bool[np.ndarray, "hop"], powers: Float[np.ndarray, "time hop"]
) -> Allowed:
    """What the budget leaves to the free transmitters, the others sending their `powers`.

    Raises:
        ValueError: limits for transmitters that there are not, powers of the others above the budget.
    """
    each, peak = (_of_names(what, names) for what in (("each", budget.each), ("peak", budget.peak)))
    held = np.where(free, 0.0, powers)
    mean, total = held.mean(axis=0), np.inf if budget.total is None else budget.total
    needed = [(f"power of {name!r}", one, most) for name, one, most in zip(names, mean, each, strict=True)]
    needed += [(f"peak of {name!r}", one, most) for name, one, most in zip(names, held.max(axis=0), peak, strict=True)]
    for what, one, limit in (*needed, ("total", mean.sum(), total)):
        if one > limit * (1 + MET):
            expected = f"a {what} of at least {one:.6g}, which is sent by what is not free"
            raise fail("budget", expected, f"{limit:.6g}")
    return Allowed(np.tile(peak[free], (len(powers), 1)), each[free], max(total - mean.sum(), 0.0))


def _of_names(what: tuple[str, float | dict[str, float] | None], names: Sequence[str]) -> Float[np.ndarray, "hop"]:
    name, limit = what
    if not isinstance(limit, dict):
        return np.full(len(names), np.inf if limit is None else limit)
    unknown = sorted(set(limit) - set(names))
    if unknown:
        raise fail(f"limit {name!r} of the budget", f"names of transmitters {list(names)}", unknown)
    return np.array([limit.get(one, np.inf) for one in names])
