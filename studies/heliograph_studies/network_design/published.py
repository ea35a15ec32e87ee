"""What two published designs leave to be saved: relays that filter in turn, and a relay for packets at the midpoint."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar

import heliograph as hg
from heliograph_studies.network_design import setting
from heliograph_studies.network_design.theory import feedback_limit

PLANT = hg.LinearPlant([[1.1, 0.2], [0.2, 0.8]], np.eye(2), [0.0, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 1.0]], 1.0)
CLOSE = 1e-4  # of the published error, to which it is reached


class Circuit(NamedTuple):
    """What designed relays save beside the published ones: error at their power, power at their error."""

    error_saved_percent: float
    power_saved_percent: float


def circuit() -> Circuit:
    """Relays designed for the best receiver behind them, not each for its own error, in the published network."""
    network = setting.circuit()
    as_published = hg.relays.periodic_local_error_design(network)
    power, published = as_published.total_power(), float(as_published.trace("receiver")[1:].sum())
    start = {name: np.zeros((2, 3, 1)) for name in setting.QUIET}
    for name, (slot, gains) in setting.QUIET.items():
        start[name][slot, :, 0] = gains

    def error(share: float) -> float:
        gains = hg.relays.periodic_relays_for_best_receiver(network, start, power_limit=share * power)
        start.update(gains)
        return float(np.trace(hg.relays.periodic_behind_relays(network, gains), axis1=1, axis2=2).sum())

    tried = [(1.0, error(1.0)), (2.0, error(0.5))]  # by 1 / share, in which the error is nearly a line
    while abs(tried[-1][1] / published - 1) > CLOSE:
        (a, low), (b, high) = tried[-2:]
        following = b + (published - high) * (b - a) / (high - low)
        tried.append((following, error(1 / following)))
    return Circuit(100 * (1 - tried[0][1] / published), 100 * (1 - 1 / tried[-1][0]))


def packets(times: float) -> dict[str, float]:
    """Mean power saved by a relay halfway where the error may be so many times that without losses, in percent.

    A packet over a length d with power p arrives with probability exp(-d^3 / p). `silent`: the relay sends only what
    came; `always`: it sends at each step. Bounded is the mean error of the filter that knows of losses, of which
    packets with arrival q leave what a path of noise D = 1 / q does.
    """

    def error(arrival: float) -> float:
        predicted = feedback_limit(PLANT, SENSOR, [hg.hop(1.0, 1 / arrival - 1)], 1.0).predicted
        return np.inf if predicted is None else float(np.trace(predicted))

    lowest = 1 - 1 / float(np.max(np.abs(np.linalg.eigvals(PLANT.matrix)))) ** 2
    target = times * error(1.0)
    arrival = brentq(lambda q: min(error(q), 1e6) - target, lowest + 1e-6, 1.0, xtol=1e-12)
    loss = -np.log(arrival)

    def silent(share: float) -> float:
        return float(0.125 / (share * loss) + np.exp(-share * loss) * 0.125 / ((1 - share) * loss))

    least = minimize_scalar(silent, bounds=(1e-3, 1 - 1e-3), method="bounded", options={"xatol": 1e-10}).fun
    return {"arrival": float(arrival), "silent": 100 * float(1 - least * loss), "always": 50.0}
