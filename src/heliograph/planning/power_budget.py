"""Power budgets: limits of what transmitters send, and linear gains maximised within them by a sort."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, SupportsFloat, cast

import numpy as np

from heliograph.numerics.check import fail, instance, scalar, table
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Bool, Float

MET_EXCESS = 1e-9  # relative excess over a limit that counts as met
NEAR_LIMIT = 1e-6  # relative: a power so near to its limit has reached it

Powers = Float[np.ndarray, "time free"]
PerTransmitter = float | dict[str, float] | None


@readable
class Budget(Module):
    """Limits of the power that transmitters send: in total, in each transmitter's mean, and at every step.

    Transmitters that are not free count towards the total.

    Args:
        total: largest mean power of all transmitters together; none unless given.
        per_transmitter: largest mean power over time of a transmitter: a number for all, or {name: number}.
        peak: largest power of a transmitter at any step: a number for all, or {name: number}.

    Raises:
        ValueError: no limit at all, a negative one.
    """

    total: float | None
    per_transmitter: PerTransmitter
    peak: PerTransmitter

    def __init__(
        self,
        total: "Float[ArrayLike, ''] | None" = None,
        per_transmitter: "Float[ArrayLike, ''] | Mapping[str, float] | None" = None,
        peak: "Float[ArrayLike, ''] | Mapping[str, float] | None" = None,
    ):
        """Check the limits of the total mean power, of each transmitter's mean and of its peak; None is no limit."""
        self.total = None if total is None else float(scalar("total power", total, 0.0))
        self.per_transmitter = _read_limit("power per transmitter", per_transmitter)
        self.peak = _read_limit("peak power", peak)
        if self.total is None and self.per_transmitter is None and self.peak is None:
            raise fail("budget", "a total, a limit per transmitter or a peak", "none")


def make_budget(value: object) -> Budget:
    """Return the value as a budget; a plain number is the limit of the total power."""
    if isinstance(value, Budget):
        return value
    try:
        number = float(cast(SupportsFloat, value))
    except (TypeError, ValueError):
        return instance("budget", value, Budget, "a number (the total power) or a Budget")
    return Budget(number)


def _read_limit(name: str, value: ArrayLike | Mapping[str, float] | None) -> PerTransmitter:
    """Return a checked limit of powers: a number for all transmitters, {name: number} for some, or None for none.

    Args:
        name: name of the limit, for messages.
        value: a number, {name: number} or None, as the user gives it.
    """
    if value is None:
        return None
    if isinstance(value, Mapping):
        named = table(name, value, "powers")
        return {key: float(scalar(f"{name} {key!r}", number, 0.0)) for key, number in named.items()}
    return float(scalar(name, value, 0.0))


class PowerLimits(NamedTuple):
    """Limits of the powers p >= 0 (time, free transmitter) that a budget allows; infinite where nothing limits.

    Args:
        peak: largest power of each transmitter at each step (time, free).
        mean: largest mean over time of each transmitter's power (free,).
        total: largest mean over time of the sum of all.
    """

    peak: Powers
    mean: Float[np.ndarray, "free"]
    total: float

    def find_best_powers(self, gain: Powers) -> Powers:
        """Return the allowed powers q (time, free) with the largest sum of gain * q.

        They are zero where the gain is not positive. Limits are nested (an entry, its column, all), so that entries
        are filled greedily, the largest gain first.
        """
        powers, steps = np.zeros_like(gain), len(gain)
        # What the limits of the total and of each transmitter leave, as sums over time.
        total_left, left = self.total * steps, self.mean * steps
        for entry in np.argsort(-gain, axis=None, kind="stable"):
            k, h = np.unravel_index(entry, gain.shape)  # step and transmitter
            if gain[k, h] <= 0 or total_left <= 0:
                break
            power = min(float(self.peak[k, h]), float(left[h]), total_left)
            if not np.isfinite(power):
                raise fail("budget", "one that limits every transmitter that helps", "no limit")
            powers[k, h] = power
            left[h] -= power
            total_left -= power
        return powers

    def find_even_powers(self, on: Bool[np.ndarray, "time free"]) -> Powers:
        """Return the largest allowed powers that are even: one level for all, or an entry's own limit if that is less.

        They are zero where not `on`. A limit of the mean is kept at every step.
        """
        limit = np.where(on, np.minimum(self.peak, self.mean), 0.0)
        total = self.total * len(on)
        if not np.isfinite(total):
            return limit
        # The level at which min(limit, level) sums to the total, if it ever does: entries in rising order of their
        # limits take what is left of the total in equal parts, or their limits.
        ordered = np.sort(limit.ravel())
        for i, least_limit in enumerate(ordered):
            level = total / (len(ordered) - i)
            if level <= least_limit:
                return np.minimum(limit, level)
            total -= least_limit
        return limit

    def clip_powers(self, powers: Powers) -> Powers:
        """Return the powers (steps, transmitters), cut at peaks and then scaled down to the limits of mean and total.

        It is for powers that rounding, or a solver's accuracy, puts slightly outside. `self.mean` limits each
        transmitter's mean over the steps, and `self.total` the sum of these means.
        """
        powers = np.clip(powers, 0.0, self.peak)
        mean = powers.mean(axis=0)
        factor = np.divide(self.mean, mean, out=np.ones_like(mean), where=mean > self.mean)  # 1 within the limit
        powers = powers * factor
        total = powers.mean(axis=0).sum()
        return powers * (self.total / total) if total > self.total else powers

    def find_price(self, powers: Powers, worth: Powers, is_least_power: bool) -> float:
        """Return the error that one more watt of the total takes away, sent where it helps and no other limit binds.

        Without a total it is one more watt of the transmitter that it helps most, whose own limit rises. A watt more at
        every step, sent at one step by one transmitter, is worth as many times a watt there as there are steps.

        Args:
            powers: what the free transmitters send (time, free).
            worth: the error that a watt more of each takes away at each step (time, free).
            is_least_power: whether the total itself is what was made small.
        """
        has_room = (powers < self.peak * (1 - NEAR_LIMIT)) & (powers.mean(axis=0) < self.mean * (1 - NEAR_LIMIT))
        if not is_least_power and not np.isfinite(self.total):
            has_room[:] = True
        return float(np.max(worth * len(worth), where=has_room, initial=0.0))

    def make_limit_rows(self) -> tuple[Float[np.ndarray, "limits entries"], Float[np.ndarray, "limits"]]:
        """Return (rows, bounds): the finite limits of means and total as rows @ powers.ravel() <= bounds.

        Each row is divided by its limit, so that its bound is 1, or 0 if nothing may be sent.
        """
        steps, count = self.peak.shape
        # One row for the mean of each transmitter over the steps, and a last one for the total.
        rows = np.concatenate([np.tile(np.eye(count), steps), np.ones((1, steps * count))]) / steps
        limits = np.append(self.mean, self.total)
        is_finite = np.isfinite(limits)
        rows, limits = rows[is_finite], limits[is_finite]
        # Do not divide by a limit of 0.
        unit = np.where(limits > 0, limits, 1.0)
        return rows / unit[:, None], limits / unit


def make_unlimited(steps: int, count: int) -> PowerLimits:
    """Return the limits of so many free transmitters over so many steps that exclude nothing."""
    return PowerLimits(np.full((steps, count), np.inf), np.full(count, np.inf), np.inf)


def make_power_limits(
    budget: Budget, names: Sequence[str], free: Bool[np.ndarray, "hop"], powers: Float[np.ndarray, "time hop"]
) -> PowerLimits:
    """Return the limits that the budget leaves to the free transmitters, while the others send their `powers`.

    Args:
        budget: limits of all transmitters: of the total mean power, of each one's mean, and of each one's peak.
        names: names of all transmitters, one for each hop, in the order of the hops.
        free: True for the transmitters whose powers are to be designed (hop,).
        powers: power that each transmitter sends at present (time, hop). The columns of free transmitters are ignored.

    Raises:
        ValueError: limits for transmitters that there are not, powers of the others above the budget.
    """
    mean_limit = _list_limits("per_transmitter", budget.per_transmitter, names)
    peak_limit = _list_limits("peak", budget.peak, names)
    total_limit = np.inf if budget.total is None else budget.total
    # Transmitters that are not free keep their powers: these must be within the limits themselves, and the mean of
    # their sum is subtracted from the total that the free ones may use.
    fixed = np.where(free, 0.0, powers)  # (time, hop)
    fixed_mean, fixed_peak = fixed.mean(axis=0), fixed.max(axis=0)
    for name, sent, limit in zip(names, fixed_mean, mean_limit, strict=True):
        _check_fixed_powers(f"power of {name!r}", sent, limit)
    for name, sent, limit in zip(names, fixed_peak, peak_limit, strict=True):
        _check_fixed_powers(f"peak of {name!r}", sent, limit)
    _check_fixed_powers("total", fixed_mean.sum(), total_limit)
    return PowerLimits(
        peak=np.tile(peak_limit[free], (len(powers), 1)),
        mean=mean_limit[free],
        total=max(total_limit - fixed_mean.sum(), 0.0),
    )


def _check_fixed_powers(what: str, power: float, limit: float) -> None:
    """Raise ValueError if transmitters that are not free already send more than a limit.

    A limit counts as met within the rounding MET_EXCESS.

    Args:
        what: the limit, in words.
        power: what these transmitters send.
        limit: the limit.
    """
    if power > limit * (1 + MET_EXCESS):
        expected = f"a {what} of at least {power:.6g}, which is sent by what is not free"
        raise fail("budget", expected, f"{limit:.6g}")


def _list_limits(kind: str, limit: PerTransmitter, names: Sequence[str]) -> Float[np.ndarray, "hop"]:
    """Return a limit for each transmitter in the order of `names`, infinite if it has none.

    Args:
        kind: name of the limit, for messages.
        limit: a number for all, {name: number} for some, or None.
        names: names of the transmitters.
    """
    if not isinstance(limit, dict):
        return np.full(len(names), np.inf if limit is None else limit)
    unknown = sorted(set(limit) - set(names))
    if unknown:
        raise fail(f"limit {kind!r} of the budget", f"names of transmitters {list(names)}", unknown)
    return np.array([limit.get(name, np.inf) for name in names])
