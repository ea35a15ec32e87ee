"""Designs of relays that filter what they hear: gains for the best receiver behind them, within a power limit."""

import numpy as np

from heliograph.filters.scheduled import ScheduledFilter
from heliograph.model.relays import RECEIVER, SENSOR, RelayNetwork
from heliograph.numerics.check import fail
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.budget import Budget, as_budget
from heliograph.planning.certificate import Certificate
from heliograph.planning.criterion import Error
from heliograph.planning.designed import BEST
from heliograph.planning.outcome import NetworkDesign
from heliograph.planning.repeated import COVERED
from heliograph.planning.state_power import of_sensor, steady_second
from heliograph.relays.design import given_design, relay_schedules
from heliograph.relays.periodic import periodic_behind_relays, periodic_given_design, periodic_own_error_design
from heliograph.relays.periodic_tuning import periodic_relays_for_best_receiver
from heliograph.relays.receiver import receiver_behind_relays
from heliograph.simulation.network import Network

Gains = dict[str, Float[np.ndarray, "slots n _"]]


def design_relays(
    relays: RelayNetwork, free: object, error: Error, budget: Budget | ArrayLike | None, wanted: object
) -> NetworkDesign:
    """Gains of all relays with which the best linear receiver has a small steady error, on average over the slots.

    The gains of a relay decide what it sends, so that they are what is free; `present` is where each relay minimises
    its own error. The budget's total is what all relays together may send in each slot. Found by one descent through
    the fixed point of all second moments.

    Raises:
        ValueError: another error than the steady trace, a wanted error, some relays free alone, limits of each.
    """
    if free is not None or wanted is not None:
        raise fail("design of relays that filter", "all relays free, and a budget or none", "free or wanted")
    if error.weight is not None or error.worst or error.steps > 1 or error.horizon is not None:
        raise fail("error of relays that filter", "the steady trace (slots are the steps)", "another")
    limits = None if budget is None else as_budget(budget)
    if limits is not None and (limits.total is None or limits.each is not None or limits.peak is not None):
        raise fail("budget of relays that filter", "a total for each slot", "other limits")
    gains = periodic_relays_for_best_receiver(relays, power_limit=None if limits is None else limits.total)
    own = periodic_own_error_design(relays).gains
    spread, before = (periodic_behind_relays(relays, each) for each in (gains, own))
    errors = [float(np.trace(each, axis1=1, axis2=2).mean()) for each in (spread, before)]
    slots, n = len(relays.slots), len(relays.states)
    silent = {RECEIVER: np.zeros((slots, n, relays.received[-1]))}
    sends = periodic_given_design(relays, gains | silent).power
    y = of_sensor(relays.sensor, steady_second(relays.plant))
    heard = [any(SENSOR in links for links in slot.values()) for slot in relays.slots]
    return NetworkDesign(
        powers={SENSOR: np.trace(y[:-1, :-1]) * np.array(heard, dtype=float), **sends},
        error=errors[0],
        present=errors[1],
        covariance=np.asarray(spread),
        sensitivity={name: float("nan") for name in sends},
        price=float("nan"),
        certificate=Certificate(False, errors[0], float("-inf"), float("nan"), 1, "error"),
        given=_running(relays, gains),
        asked=error,
        numbers=dict(gains),
    )


def _running(relays: RelayNetwork, gains: Gains) -> Network:
    """The relays with their gains over COVERED steps and more, and the best receiver behind them."""
    slots, n = len(relays.slots), len(relays.states)
    times = -(-COVERED // slots)
    over_time = {name: np.tile(gain, (times, 1, 1)) for name, gain in gains.items()}
    silent = {RECEIVER: np.zeros((times * slots, n, relays.received[-1]))}
    schedules = relay_schedules(relays, given_design(relays, over_time | silent))
    schedules.pop(RECEIVER)
    return Network.of_relays(relays, schedules, {BEST: ScheduledFilter(receiver_behind_relays(relays, over_time))})
