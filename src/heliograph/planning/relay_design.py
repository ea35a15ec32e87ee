"""Designs of relays that filter: gains for the best receiver behind them, within a limit of power."""

import numpy as np

from heliograph.filters.linear.scheduled import ScheduledFilter
from heliograph.model.relays import RECEIVER, SENSOR, RelayNetwork
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.planning.budget import as_budget
from heliograph.planning.moments import measurement_moment, steady_moment
from heliograph.planning.problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.realised import BEST, COVERED
from heliograph.relays.design import given_design, relay_schedules
from heliograph.relays.periodic import periodic_behind_relays, periodic_given_design, periodic_own_error_design
from heliograph.relays.periodic_tuning import periodic_relays_for_best_receiver
from heliograph.relays.receiver import receiver_behind_relays
from heliograph.simulation.network import Network

Gains = dict[str, Float[np.ndarray, "slots n _"]]


def design_relays(problem: DesignProblem, relays: RelayNetwork) -> PowerDesign:
    """Gains of all relays with which the best linear receiver has a small steady error, on average over the slots.

    The gains of a relay decide what it sends, so that they are what is free; `present` is where each relay minimises
    its local error. The budget's total is what all relays together may send in each slot. Found by one descent through
    the fixed point of all second moments.

    Raises:
        ValueError: another error than the steady trace, a target error, some relays free alone, limits of single ones.
    """
    if problem.free is not None or problem.target_error is not None:
        raise fail("design of relays that filter", "all relays free, and a budget or none", "free or target_error")
    error = problem.criterion
    if error.weight is not None or error.worst or error.steps > 1 or error.horizon is not None:
        raise fail("error of relays that filter", "the steady trace (slots are the steps)", "another")
    limits = None if problem.budget is None else as_budget(problem.budget)
    if limits is not None and (limits.total is None or limits.per_transmitter is not None or limits.peak is not None):
        raise fail("budget of relays that filter", "a total for each slot", "other limits")
    # Errors of the designed gains, and of those that minimise each relay's error.
    gains = periodic_relays_for_best_receiver(relays, power_limit=None if limits is None else limits.total)
    local = periodic_own_error_design(relays).gains
    spread, before = (periodic_behind_relays(relays, design) for design in (gains, local))
    value, present = (float(np.trace(design, axis1=1, axis2=2).mean()) for design in (spread, before))
    # What relays and sensor send.
    slots, n = len(relays.slots), len(relays.states)
    silent = {RECEIVER: np.zeros((slots, n, relays.received[-1]))}
    sends = periodic_given_design(relays, gains | silent).power
    y = measurement_moment(relays.sensor, steady_moment(relays.plant))
    sensed = [any(SENSOR in links for links in slot.values()) for slot in relays.slots]
    return PowerDesign(
        problem=problem,
        powers={SENSOR: np.trace(y[:-1, :-1]) * np.array(sensed, dtype=float), **sends},
        error=value,
        certificate=Certificate(False, value, float("-inf"), float("nan"), 1, "error"),
        present=present,
        covariance=np.asarray(spread),
        sensitivity={name: float("nan") for name in sends},
        price=float("nan"),
        numbers=dict(gains),
        realised=_running(relays, gains),
    )


def _running(relays: RelayNetwork, gains: Gains) -> Network:
    """Relays with their gains over COVERED steps and more, and the best receiver behind them."""
    slots, n = len(relays.slots), len(relays.states)
    times = -(-COVERED // slots)
    over_time = {name: np.tile(gain, (times, 1, 1)) for name, gain in gains.items()}
    silent = {RECEIVER: np.zeros((times * slots, n, relays.received[-1]))}
    schedules = relay_schedules(relays, given_design(relays, over_time | silent))
    schedules.pop(RECEIVER)
    return Network.of_relays(relays, schedules, {BEST: ScheduledFilter(receiver_behind_relays(relays, over_time))})
