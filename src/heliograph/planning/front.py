"""The least error over the total power: what a budget buys, and below what no budget comes."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.planning.task import Task
from heliograph.simulation.network import Network

SPAN, POINTS = 10.0, 9  # of the budgets that are tried about one: down and up by this factor, so many


@readable
class Front(NamedTuple):
    """Errors found, and bounds below which none is, at total powers in rising order; shapes (points,).

    No error is above that of less power: what less power reaches, more reaches too.
    """

    totals: Float[np.ndarray, "points"]
    errors: Float[np.ndarray, "points"]
    bounds: Float[np.ndarray, "points"]


def error_over_power(
    network: Network, task: Task, totals: Sequence[float], advance: Callable[[str], None] = lambda what: None
) -> Front:
    """The least error that is found at each of these total powers.

    Raises:
        ValueError: totals that are not positive, what `design` refuses.
    """
    instance("network", network, Network, "a Network")
    instance("task", task, Task, "a Task")
    powers = np.unique(array("budgets of the front", totals, (None,)))
    if not len(powers) or powers[0] <= 0:
        raise fail("budgets of the front", "positive numbers", list(totals))
    found = []
    for total in powers:
        advance(f"the best for a power of {total:.4g}")
        found.append(task.at(float(total)).solve(network))
    errors = np.minimum.accumulate([one.error for one in found])
    return Front(
        powers, errors, np.array([min(one.certificate.bound, e) for one, e in zip(found, errors, strict=True)])
    )


def about(total: float) -> list[float]:
    """Budgets on both sides of one."""
    return [float(one) for one in total * np.geomspace(1 / SPAN, SPAN, POINTS)]
